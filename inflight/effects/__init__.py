"""Effects: one physical cause of disagreement each. A file with one class is a plug-in.

An effect states what it *adds to the reading* of a sensor. Time dependence belongs to the model,
never to an effect.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
