"""What a model leaves of a comparison, measured: size, noise, spectrum, lines, and what the residual follows.

In go residuals (nT, at equal steps with gaps as NaN), the direction of the field, and coordinates; out come
sizes and noise floors (``noise.py``), power densities (``spectrum.py``), lines with known periods named
(``lines.py``), the waveform of what repeats (``waveform.py``), and dependences on any coordinate with errors
between blocks (``dependence.py``, open this first); ``channel_steps.py`` finds steps of housekeeping.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
