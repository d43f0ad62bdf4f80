"""Effects: one physical cause of disagreement each. A file with one class is a plug-in.

An effect states what it *adds to the reading* of a sensor. Time dependence belongs to the model,
never to an effect.
"""

from inflight.effects.base import AXES, Effect, Parameter
from inflight.effects.registry import effect_class, known_effects

__all__ = ["AXES", "Effect", "Parameter", "effect_class", "known_effects"]
