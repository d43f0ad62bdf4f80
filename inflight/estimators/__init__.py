"""Estimators of what a mission's effects are: pure functions from arrays to values with uncertainties."""
