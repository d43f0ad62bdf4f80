"""A web server of releases: HAPI 3.2, read-only.

In goes a workspace or a release's folder; out come its released products, by time and parameter, as clients
of HAPI read them (hapiclient, SPEDAS, Autoplot). Open ``hapi.py`` first: it reads a request and answers it.
``datasets.py`` says what is served and describes it, ``records.py`` turns samples into CSV and binary
records, ``times.py`` reads and writes the standard's times, ``server.py`` listens.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
