"""The corrections that are tried on readings: gradiometers of every form, states, and both together."""

from __future__ import annotations

from functools import partial

from inflight.arrays import Floats
from inflight.dual.bands import gradiometer_correction
from inflight.dual.gradiometer import FORMS, LEAK_SIGMA, Gradiometer, fit_forms
from inflight.dual.harm import Corrector
from inflight.dual.readings import Readings
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
    """
    forms = [form for form in FORMS if form != "dipole" or positions is not None]
    try:
        gradiometers = fit_forms(readings, forms, positions, leak_sigma)
    except CalibrationError:
        return {}
    return {name: partial(gradiometer_correction, one) for name, one in gradiometers.items()}
