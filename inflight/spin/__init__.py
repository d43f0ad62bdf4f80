"""Calibration from the spin of the spacecraft: phase, spin fits, the eight spin-related parameters."""
