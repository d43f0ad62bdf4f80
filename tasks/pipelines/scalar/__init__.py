"""A vector sensor calibrated against a scalar instrument, by days, windows, months or one span.

In go the samples of both sensors, out come nine parameters in tables and the calibrated field. `pipeline.py`
is the file to open first: it names what is made of a day (`day.py`), of all days (`tables.py`),
and the product (`product.py`). `compare.py` measures the residual, `compare_page.py` and `sections.py` show
it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
