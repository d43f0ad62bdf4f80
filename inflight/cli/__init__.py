"""The command line ``inflight``, the top layer. `main` is its entry point.

In goes a command line; out come a table or one JSON object on standard output, and an exit code. Open `app`
first: it lists the verbs. One module holds one group of them; each verb is a function of a `Command` (common
options, progress, output, errors) and its own options. Everything heavy is imported inside the verb that
needs it, so that ``inflight --help`` answers at once.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
