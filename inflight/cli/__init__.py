"""The command line ``inflight``, the top layer. `main` is its entry point.

One module holds one group of verbs. Everything heavy is imported inside the verb that needs it, so
that ``inflight --help`` answers at once.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
