"""From delivered files to the archive, and from the archive to samples of a day.

`ingest` takes day files into level-1 datasets ``l1/<instrument>``; `simulate` and its like write made-up
deliveries. `needs_of` says what a model's samples are made from, `ArchiveIndex` which archived days those
are, and `load_samples` reads and aligns a day. Open `inputs` first, then `samples`; `channels` gives every
channel of a mission at the cadence of the search.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
