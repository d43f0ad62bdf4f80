"""Calibration from the spin: phase, spin fits, and what tones at the spin period tell of a magnetometer."""
