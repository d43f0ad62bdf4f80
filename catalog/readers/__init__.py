"""Readers: a delivered file of any supported format becomes rows of one instrument, rows become days.

In go a file and the options of the mission YAML; out comes a `RawTable` (`read_file`), and of its rows
days for the archive (`split_days`, `assemble_day`). A format is one module with a function `open_source`
that gives a `Source` of named variables (`source`): `raw.FORMATS` lists them. Open `raw` first.
`check_reader` holds a reader to its contract; ``docs/templates/reader.py`` is one to copy.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
