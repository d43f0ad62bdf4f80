"""Design of a residual: which terms it may have, and their columns.

Takes native rows of a comparison and the effects of a model or library; makes terms and candidates
(`terms`), and their design matrices on bins, outliers left out (`columns`). Nothing is fitted here. Open
`terms.py` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
