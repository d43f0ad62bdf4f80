"""A model: an ordered set of effects with time dependence and few values. It says *what*."""

from inflight.model.entries import ModelEffect, make_effect
from inflight.model.model import Model
from inflight.model.timed import TimedValue

__all__ = ["Model", "ModelEffect", "TimedValue", "make_effect"]
