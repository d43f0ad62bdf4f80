"""What all pipelines have in common: the protocol `Pipeline`, and the steps that are the same for each.

In goes a plan (which days, from what), out comes a published run: statistics of days, tables, products, and a
report. `pipeline.py` has the protocol and is the file to open first; `reprocessing.py` carries it out step by
step, `planning.py` says what there is to do, `publication.py` stages tables and registers outcomes. Nothing
here knows a single pipeline: those stand in the folders beside this one and import from here.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
