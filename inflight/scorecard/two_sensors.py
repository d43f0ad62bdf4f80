"""Figures of two sensors on a boom and the states of a spacecraft (Venus Express, Table 1).

The six states of the table, along y and z chosen, are read in simulated solar wind that is known, as in the
paper's training phase; `inflight.dual.train` is told neither how many there are nor when they change.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from inflight.dual import Readings, Training, train
from inflight.scorecard.figure import RECOVERED, Estimate, PublishedFigure
from inflight.scorecard.scene import SimulatedDays
from inflight.simulate.dual import six_states
from inflight.simulate.spinning import SPACECRAFT_PRESETS, solar_wind
from inflight.time import SECOND

SECTION = "two-sensors"
#: Table 1: B_out - B_in, and what is added to the outboard and to the inboard reading, x, nT.
OUT_LESS_IN = (-9.39, -6.71, -4.05, 0.5, 2.89, 2.72)
ADDED_OUTBOARD = (-6.18, -6.12, -1.68, 0.5, 2.49, 3.63)
ADDED_INBOARD = (-15.57, -12.83, -5.73, 1.0, 5.38, 6.35)
#: Seconds of a stay in a state, how often each is visited, and noise of a sensor, nT.
_STAY, _VISITS, _NOISE = 500, 4, 0.02


def summed_columns(scene: SimulatedDays) -> tuple[float, ...]:
    """Return the first two columns' sums, nT."""
    return tuple((np.array(OUT_LESS_IN) + np.array(ADDED_OUTBOARD)).tolist())


def _training(scene: SimulatedDays) -> Training:
    random = np.random.default_rng(31)
    state = np.concatenate([random.permutation(6) for _ in range(_VISITS)]).repeat(_STAY)
    seconds = np.arange(state.size, dtype=np.float64)
    ambient = solar_wind(seconds, 31, 0, SPACECRAFT_PRESETS["themis"])
    inboard, outboard = (
        ambient + stray[state] + _NOISE * random.normal(size=ambient.shape) for stray in six_states()
    )
    return train(Readings((seconds * SECOND).astype(np.int64), inboard, outboard), ambient=ambient)


def _of_states(value: np.ndarray, covariance: np.ndarray, training: Training) -> Estimate:
    """Return x of six states, nearest to the table's differences; NaN where not six were found."""
    if np.count_nonzero(training.observed) != len(OUT_LESS_IN):
        return Estimate.of(np.full(6, np.nan), np.ones(6))
    inboard, outboard = six_states()
    away = np.linalg.norm(training.centre[:, None] - (inboard - outboard), axis=2)
    nearest = np.argmin(away, axis=0)
    return Estimate.of(value[nearest, 0], np.sqrt(covariance[nearest, 0, 0]))


def differences(scene: SimulatedDays) -> Estimate:
    """Return B_out - B_in along x of the states that were found, in the table's order, nT."""
    training = scene.cached(_training)
    return _of_states(-training.centre, training.centre_covariance, training)


def corrections(scene: SimulatedDays) -> Estimate:
    """Return what is added to the outboard reading along x in the same states, nT."""
    training = scene.cached(_training)
    return _of_states(-training.correction, training.covariance, training)


derived = partial(PublishedFigure, section=SECTION, basis="derived")
recovered = partial(PublishedFigure, section=SECTION, basis="recovered_from_injection", why=RECOVERED)

_SOURCE = "Venus Express paper, table 1"

FIGURES = (
    derived(
        id="states.inboard",
        what="correction of the inboard sensor in six states: outboard correction and difference",
        unit="nT",
        source=_SOURCE,
        published=ADDED_INBOARD,
        # All three columns are rounded to 0.01 nT; binary fractions.
        tolerance=0.015 + 1e-9,
        why="B_amb = B_in + c_in = B_out + c_out: the columns are B_out - B_in and what is added.",
        obtain=summed_columns,
    ),
    recovered(
        id="states.differences-recovered",
        what="B_out - B_in along x of six states found in readings, each four times for 500 s",
        unit="nT",
        source=_SOURCE,
        published=OUT_LESS_IN,
        # Half of the last printed digit; 0.02 nT of noise in 2000 s tell 0.001 nT.
        tolerance=0.005,
        obtain=differences,
        nominal=(0.0,) * 6,
    ),
    recovered(
        id="states.corrections-recovered",
        what="correction added to the outboard sensor in the same states, the ambient field known",
        unit="nT",
        source=_SOURCE,
        published=ADDED_OUTBOARD,
        tolerance=0.005,
        obtain=corrections,
        nominal=(0.0,) * 6,
    ),
)
