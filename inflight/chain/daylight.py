"""The field of day and night in the fit of all days, and what the daily parameters are once it is known.

It is fitted beside everything else of the model, trends included: what a panel's current explains, which is
there by day too, is not told twice, and its error says so. Without it the angles of each day's own fit
wander with the local time, with a period of 260.5 days (Yin 2010, section 4.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from inflight.calibration import NormalEquations
from inflight.calibration.solution import retained_fraction
from inflight.chain.beside import holds_day_night, joined_with
from inflight.chain.continuous import Continuous
from inflight.chain.daily import daily_parameters, shift_columns
from inflight.chain.fitting import fitted_beside
from inflight.chain.wide import terms_of
from inflight.effects.periodic import DayNightSeries
from inflight.effects.sunlight import DayNight
from inflight.errors import CalibrationError
from inflight.estimators.day_night import LEAST_RETAINED, SERIES, SWITCHED, DayNightField
from inflight.model import Model

#: What is known of the fields beforehand, nT.
_PRIOR = {
    SWITCHED: float(np.max(DayNight.vector.sigma)),
    SERIES: float(np.max(DayNightSeries.amplitude.sigma)),
}


@dataclass(frozen=True)
class Daylight:
    """A field of day and night beside all else.

    Attributes
    ----------
    field : DayNightField
    found : Continuous
        The fit with it.
    equations : NormalEquations
        With its columns, of the days whose orbit is known.
    """

    field: DayNightField
    found: Continuous
    equations: NormalEquations

    def daily(self) -> xr.Dataset:
        """Return each day's nine parameters and time shift with the field known; see `daily_parameters`."""
        return daily_parameters(self.equations, self.found, shift_columns(self.found.model))


def fit_daylight(
    equations: NormalEquations,
    strips: Sequence[xr.Dataset | None],
    found: Continuous,
    model: Model,
    form: str = SWITCHED,
) -> Daylight:
    """Fit the field in one of its forms, `SWITCHED` or `SERIES`, beside everything of the model.

    Parameters
    ----------
    equations, strips, found, model
        As `inflight.chain.temperature.fit_coil_lag`.
    form : str

    Raises
    ------
    CalibrationError
        When no day knows its orbit, the model has such a field itself, or nothing of it is told.
    """
    if holds_day_night(model):
        raise CalibrationError(
            "the model has a field of day and night itself: the table 'trend' tells it",
            remedy="leave it out of the model to have it fitted beside",
        )
    names = sorted({str(one) for strip in strips if strip is not None for one in strip["beside"].values})
    names = [name for name in names if name.startswith(form)]
    if not names:
        raise CalibrationError(
            "the mission delivers no positions", remedy="state a channel of kind 'position'"
        )
    wide = joined_with(equations, strips, names)
    sigma = np.array([one for term in terms_of(model) for one in term.sigma] + [_PRIOR[form]] * len(names))
    fit = fitted_beside(wide, equations, found, sigma)
    places = np.array([fit.place(name).start for name in names])
    columns = np.array([wide.columns.index(name) for name in names])
    retained = retained_fraction(wide.dataset["gram"].values.sum(axis=0)[:-1, :-1])[columns]
    determined = fit.determined[places] & (retained > LEAST_RETAINED)
    if not determined.any():
        raise CalibrationError(
            "no part of the day/night field is told from all else", remedy="take days at other local times"
        )
    both = np.ix_(determined, determined)
    covariance = np.zeros((len(names), len(names)))
    covariance[both] = fit.covariance[np.ix_(places, places)][both]
    field = DayNightField(
        tuple(names),
        np.where(determined, fit.value[places], 0.0),
        np.where(determined, fit.sigma[places], np.inf),
        covariance,
        retained,
        determined,
        len(wide),
        found.fit.rms,
        fit.rms,
    )
    return Daylight(field, replace(found, fit=fit), wide)
