"""The command line ``inflight``, the top layer. `main` is its entry point.

One module holds one group of verbs. Everything heavy is imported inside the verb that needs it, so
that ``inflight --help`` answers at once.
"""

from inflight.cli.app import main

__all__ = ["main"]
