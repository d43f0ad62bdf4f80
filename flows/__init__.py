"""Prefect flows: they chain the steps of :mod:`inflight.tasks` and hold no numerics."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
