"""Figures: pure functions from arrays and Datasets to Bokeh figures, shared by reports and pages.

They draw aggregates, never raw samples.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
