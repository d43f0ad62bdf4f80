"""What products and models tell of a mission: compare, diagnose, revise.

In go a catalog and a mission; out come the residual before and after (`compare`), the missing effect with
its rivals (`diagnose`), and new versions of a model (`Workbench`). `gram_pass` looks at every day
once; all else is algebra on what it stored. Open `comparing` or `diagnosis` first, then `revise`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
