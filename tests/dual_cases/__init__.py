"""Random two-sensor cases and the score of what a correction does to them: ``python -m tests.dual_cases``."""
