"""Storage: the mission archive, calibration tables, level-2 products and releases of one workspace."""
