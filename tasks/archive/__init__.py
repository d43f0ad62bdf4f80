"""From delivered files to the archive, and from the archive to samples of a day.

`ingest` takes day files into level-1 datasets ``l1/<instrument>``; `simulate` writes the day files of a
simulated mission. `needs_of` lists the series that a model's samples are made from, `ArchiveIndex` the
archived days that hold them, and `load_samples` reads and aligns a day. Open `inputs.py` first, then
`samples.py`; `channels.py` gives every channel of a mission at the cadence of the search, `ingestion.py` and
`simulated_deliveries.py` handle files.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
