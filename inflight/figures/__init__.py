"""Figures and pages: pure functions from results and arrays to Bokeh figures and HTML.

In go records of `inflight.diagnosis`, `inflight.mission_fit` and `inflight.residual`, calibration tables,
and arrays of aggregates, never raw samples; out come Bokeh figures and text without scripts, which reports
and the web page share. Open ``text.py`` first: a `Section` is a heading, text and figures; ``page.py``
writes sections as one file. Then the module of the thing that is drawn. ``style.py`` has colours, bars and
names.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
