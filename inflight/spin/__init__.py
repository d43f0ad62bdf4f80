"""Spinning spacecraft: phase, spin fits, the parameters that the spin tells apart, folding."""
