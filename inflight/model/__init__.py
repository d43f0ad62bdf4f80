"""A model: an ordered set of effects with time dependence and few values. It says *what*."""

from inflight.model.model import Model, ModelEffect, make_effect
from inflight.model.time_dependence import TimedValue

__all__ = ["Model", "ModelEffect", "TimedValue", "make_effect"]
