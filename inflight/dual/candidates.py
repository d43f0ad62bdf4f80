"""The corrections that are tried on readings: gradiometers of every form, states, and both together."""

from __future__ import annotations

from functools import partial

from inflight.arrays import Floats
from inflight.dual.bands import gradiometer_correction
from inflight.dual.combined import combined_correction
from inflight.dual.correction import Correction
from inflight.dual.gradiometer import FORMS, LEAK_SIGMA, Gradiometer, fit_forms
from inflight.dual.harm import Corrector
from inflight.dual.processing import process
from inflight.dual.readings import Readings
from inflight.dual.training import Training, train
from inflight.errors import CalibrationError


def every_candidate(
    readings: Readings, positions: Floats | None = None, leak_sigma: float = LEAK_SIGMA
) -> dict[str, Corrector]:
    """Fit every correction to readings; those that cannot be fitted are left out.

    Parameters
    ----------
    readings : Readings
    positions, leak_sigma
        See `gradiometer.fit_forms`.

    Returns
    -------
    dict
        By name: the forms of the gradiometer, ``states`` and ``combined``.
    """
    forms = [form for form in FORMS if form != "dipole" or positions is not None]
    try:
        gradiometers = fit_forms(readings, forms, positions, leak_sigma)
    except CalibrationError:
        return {}
    found: dict[str, Corrector] = {
        name: partial(gradiometer_correction, one) for name, one in gradiometers.items()
    }
    try:
        training = train(readings)
    except CalibrationError:
        return found
    if len(training) > 1:
        found["states"] = partial(process, training=training)
        found["combined"] = partial(_combined, training=training, gradiometer=gradiometers["matrix"])
    return found


def _combined(readings: Readings, training: Training, gradiometer: Gradiometer) -> Correction:
    return combined_correction(readings, training, process(readings, training), gradiometer)
