"""Calibration from the spin: phase, spin fits, and what the tones at the spin period tell of a magnetometer."""
