"""The whole-mission fit: a vector sensor against a scalar instrument, everything fitted to all days at once.

In go the samples of both sensors and of the currents, torquers and temperatures around them; out come one
model whose scale factors follow a trend, some twenty tables, and products made with that model. `pipeline.py`
is the file to open first; `day.py` makes the statistics of a day, `fit.py` and `tables.py` make the tables,
`report.py` with the two modules of sections shows them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
