"""From a residual to the missing effect: candidates, their evidence, rounds, a verdict.

``library`` and ``candidates`` say what may be missing; ``columns``, ``coarse``, ``gram`` and ``series``
make the evidence of a block; ``evidence``, ``scoring``, ``flips`` and ``search`` judge it by algebra
alone; ``rounds``, ``refine``, ``second`` and ``changes`` take and drop; ``findings``, ``unknown``,
``verdict`` and ``words`` say what it means.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
