"""Ways of calibrating: each is a `Pipeline`; nothing else depends on which one a comparison has.

In goes an archive of days and a mission, out come statistics of days, calibration tables, level-2 products
and reports of them. `registry.py` is the file to open first: the table of pipelines, `pipeline_of`, and the
verb `reprocess`. What all have in common stands in `base` (the protocol in `base/pipeline.py`), each pipeline
in a folder of its own: `scalar` (a day at a time), `mission_fit` (all days at once), `spin`, `two_sensor`
(a correction by the spacecraft's states), `intercalibration` (two sensors that are calibrated apart),
`zero_level` (offsets from natural fluctuations).
`check_pipeline` tests one of your own.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
