"""What is left of a comparison after the model, measured: size, noise, spectrum, lines, what it follows.

In go residuals (in nT, at equal steps with gaps), the direction of the field, and coordinates; out come sizes
and noise floors (`noise`), power densities (`spectrum`), lines with known periods named (`lines`), the
waveform of what repeats (`waveform`), and dependences on any coordinate with errors between blocks and words
(`dependence`); `channel_steps` finds steps and levels of housekeeping. Open `dependence` first.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
