"""Prefect flows: they chain the steps of :mod:`inflight.tasks` and hold no numerics."""
