"""Effects: one physical cause of disagreement each. A file with one class is a plug-in.

An effect states what it *adds to the reading* of a sensor. Time dependence belongs to the model,
never to an effect.
"""

from inflight.effects.base import AXES, Effect, Parameter
from inflight.effects.families import family_of
from inflight.effects.registry import effect_class, known_effects
from inflight.effects.sources import EffectSource

__all__ = ["AXES", "Effect", "EffectSource", "Parameter", "effect_class", "family_of", "known_effects"]
