"""Compare products with measurements, find the missing effect, revise the model.

In go a catalog and a mission with its archive; out come the residual before and after calibration
(`compare`), a `Diagnosis` with rivals and values (`diagnose`) and its page (`report`), and new versions of a
model (`Workbench`). Open ``diagnosis.py`` first: `make_pass` reads every day once into Gram blocks
(``gram_pass.py``), and all that follows is algebra on these; then ``revise.py``. ``comparing.py`` writes the
page of `compare`; its sections are made by each pipeline's ``compare.py``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
