"""Figures of the spin show what the results hold."""

import numpy as np
from bokeh.embed import file_html
from bokeh.resources import INLINE
from farrell_cases import record, sensors

from docs.figures.spin_fits import phase_figure, phasor_figure, slope_figure, zero_figure
from inflight.spin import calibrate_farrell, fit_spins, phase_from_pulses
from inflight.time import SECOND


def test_the_figures_of_a_record_are_drawn_with_its_numbers():
    stamps, readings, phase, _ = record(0, sensors(), [3.0, -2.5, 3.0])
    fits = fit_spins(stamps, readings, phase)
    found = calibrate_farrell(fits, window=0.01)
    drift = found.intercepts.against(np.zeros(2))
    times = np.arange(300) * 3.0
    times[150:] += 0.4
    pulses = phase_from_pulses((times * SECOND).astype(np.int64), stamps)
    drawn = [slope_figure(fits, found), phasor_figure(fits, found), zero_figure(drift), phase_figure(pulses)]
    text = "".join(file_html(one, INLINE, "spin") for one in drawn)
    for part in ("sensor 1: ", "Tilt of sensor 3", "nT a day", "jump of the phase"):
        assert part in text
