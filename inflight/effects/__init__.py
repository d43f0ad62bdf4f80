"""Effects: one physical cause of disagreement between sensors each, a class in a file.

In go samples (`inflight.samples`), values of the effect's parameters, and a sensor; out comes the field the
cause adds there, nT, or a reading with or without it. An effect knows no time dependence: that is the
model's. Open `base` first (`Effect`, `Parameter`), then any effect; `registry` finds classes by name,
`user_effects` reads a user's own files, `check_effect` (`conformance`) holds a class to all this.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
