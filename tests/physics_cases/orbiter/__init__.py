"""A second simulator: another spacecraft a seed, sharing no code with the project's effects or simulator.

It knows nothing of `inflight.effects`, `inflight.model`, `inflight.calibration`, `inflight.simulate`, so
that what a diagnosis finds is found in somebody else's physics.
"""
