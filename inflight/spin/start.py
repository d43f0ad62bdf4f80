"""Tones of a record from pass to pass: where offsets are as large as the field, spins are averaged first."""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.spin.block_sums import SERIES
from inflight.spin.equation import TwelveParameters
from inflight.spin.harmonics import (
    SpinTones,
    check_turning,
    corrected_tones,
    small_step,
    spin_tones,
)
from inflight.spin.layout import Layout
from inflight.time import Int64

#: Above this part of the field an offset bends the modulus too much for one linear step.
_LARGE = 0.2
#: The part of the sub-intervals with the least axial field, in which elevations say least.
_LOW = 0.25


def first_tones(
    readings: Floats, phase: Floats, stamps: Int64, layout: Layout, present: TwelveParameters
) -> SpinTones:
    """Return tones at the present parameters, the offsets guessed anew where they are large.

    Averaged over whole spins a steady field leaves the offsets alone in the spin plane, linear in them.

    Raises
    ------
    CalibrationError
        Nothing usable, or the field does not turn with the phase.
    """
    tones = spin_tones(readings, phase, stamps, layout, present)
    hidden = {"not turning with the phase"}
    kept = np.isfinite(tones.mean).all(axis=1)
    for name, hit in tones.excluded:
        if name not in hidden:
            kept &= ~hit
    if kept.any():
        axial = np.where(kept, tones.largest_axial, np.inf)
        low = axial <= np.quantile(axial[kept], _LOW)
        mean = np.median(tones.mean[low], axis=0)
        cross = np.median(np.hypot(*tones.tones[low, :2, SERIES.index("x")].T))
        if np.hypot(*mean) > _LARGE * cross:
            plane = np.linalg.solve(present.matrix(), np.array([mean[0], mean[1], 0.0]))
            moved = {f"offset[{at + 1}]": present.offset[at] + float(plane[at]) for at in range(2)}
            tones = spin_tones(readings, phase, stamps, layout, present.changed(moved))
    check_turning(tones, readings, phase, layout)
    return tones


def next_tones(
    readings: Floats,
    phase: Floats,
    stamps: Int64,
    layout: Layout,
    before: SpinTones,
    parameters: TwelveParameters,
) -> SpinTones:
    """Return tones at new parameters: all of them, or after a small step those of Bz and modulus alone."""
    if small_step(before, parameters):
        return corrected_tones(readings, phase, layout, before, parameters)
    return spin_tones(readings, phase, stamps, layout, parameters)
