"""States where states explain the difference, the gradiometer for what is left.

A state's field at the outboard sensor is told by the outboard steps of its own units, each with what the
ambient field did at that moment, and by the gradiometer's matrix, which all units have fitted together but
which is not quite that of any of them. Both are estimates with covariances, and are averaged by them. What
the difference does beside its state, such as a current that follows the load, goes through the matrix; so
does everything while the state is not known.
"""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.dual.bands import quadratic, without_noise
from inflight.dual.correction import Correction
from inflight.dual.gradiometer import Gradiometer
from inflight.dual.readings import Readings
from inflight.dual.training import Training


def combined_correction(
    readings: Readings, training: Training, states: Correction, gradiometer: Gradiometer
) -> Correction:
    """Return the correction of both methods together.

    Parameters
    ----------
    readings : Readings
    training : Training
        The states with their places in the difference and their outboard fields.
    states : Correction
        By states, of these readings and from this training: which state each sample is in.
    gradiometer : Gradiometer

    Returns
    -------
    Correction
        Relative to the training's reference state, unless the training knows the constant part.
    """
    good = readings.good
    field = np.full((len(readings), 3), np.nan)
    covariance = np.full((len(readings), 3, 3), np.nan)
    if good.any():
        value, spread = state_fields(training, gradiometer)
        place = state_places(training, states.state)[good]
        stray = gradiometer.stray(readings)[good]
        # What leaks of the mean ambient field is as constant as an offset.
        stray += np.median(readings.difference[good] - stray, axis=0)
        base, reference = _reference(training)
        here = np.where(place[:, None] >= 0, training.centre[place], base)
        kept, variance = without_noise(stray - here, gradiometer.noise)
        matrix = gradiometer.matrix
        field[good] = np.where(place[:, None] >= 0, value[place], reference) + kept @ matrix.T
        noise = matrix @ gradiometer.noise @ matrix.T
        error = variance[:, None, None] * noise + quadratic(gradiometer.covariance, kept)
        covariance[good] = error + np.where(place[:, None, None] >= 0, spread[place], 0.0)
    return Correction(
        field,
        covariance,
        states.state,
        states.probability,
        states.flag,
        "combined",
        reason="states, and the gradiometer for what is left",
        constant_known=training.constant_known,
    )


def state_fields(training: Training, gradiometer: Gradiometer) -> tuple[Floats, Floats]:
    """Return the outboard field of each state by both methods together, and its covariance.

    Returns
    -------
    value : ndarray, shape (state, axis)
        nT.
    covariance : ndarray, shape (state, axis, axis)
        nT^2.
    """
    base, reference = _reference(training)
    away = training.centre - base
    matrix = gradiometer.matrix
    noise = matrix @ (gradiometer.noise + training.scatter**2 * np.eye(3)) @ matrix.T
    count = np.maximum(training.segments, 1)[:, None, None]
    scaled = reference + away @ matrix.T
    spread = quadratic(gradiometer.covariance, away) + noise / count
    total = spread + training.covariance
    gain = np.einsum("sij,sjk->sik", spread, np.linalg.pinv(total, hermitian=True))
    value = scaled + np.einsum("sij,sj->si", gain, training.correction - scaled)
    covariance = spread - gain @ spread
    at_zero = training.number == training.reference
    # Zero by definition, whatever the matrix.
    value[at_zero], covariance[at_zero] = training.correction[at_zero], training.covariance[at_zero]
    return value, 0.5 * (covariance + np.swapaxes(covariance, 1, 2))


def state_places(training: Training, state: np.ndarray) -> np.ndarray:
    """Return the row of the training's tables of each state's number; -1 where it is unknown."""
    order = np.argsort(training.number)
    found = np.clip(np.searchsorted(training.number[order], state), 0, max(len(training) - 1, 0))
    place = order[found]
    return np.asarray(np.where(training.number[place] == state, place, -1))


def _reference(training: Training) -> tuple[Floats, Floats]:
    """Return difference and outboard field of the state that the others are told from."""
    own = int(np.argmax(training.seconds))
    if training.reference >= 0:
        own = int(np.flatnonzero(training.number == training.reference)[0])
    return training.centre[own], training.correction[own]
