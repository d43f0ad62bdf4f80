"""Temperature, day and night, and cross-talk in the fit of all days.

Takes the days' wide equations, their auxiliary columns and the continuous fit; makes:

- the coil's temperature (`fit_coil_lag`): its coefficients, its lag, and its rivals. The auxiliary columns
  are the residual's derivatives by the temperature's rate. A lag is bilinear: its column is the rate's
  times the coefficients, so that a few passes settle it together with everything that the model fits.
- the field of day and night (`fit_day_night_jointly`), fitted together with everything else, trends
  included: what a panel's current explains by day is not counted twice, and the error contains it. Without
  it the angles of each day's own fit vary with the local time, with a period of 260.5 days (Yin 2010,
  section 4.3).
- cross-talk: what one unit of an ignored cause does to everything else. With the nine alone, a cause goes
  into them as far as they can imitate it (`nine_parameter_cross_talk`; Yin 2010, section 4.2). With
  everything fitted together (`joint_cross_talk`), C the covariance, leaving out a parameter j of size c
  moves parameter i by
  ``-C_ij / C_jj c``, which is the same least squares written with the inverse.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NINE_PARAMETER_NAMES, NINE_PARAMETER_UNITS, NormalEquations
from inflight.effects import DayNight, DayNightSeries
from inflight.errors import CalibrationError
from inflight.lsq import (
    RESIDUAL,
    SOLVER_SETTINGS,
    ClusteredFit,
    correlation_of,
    fit_white,
    jackknife,
    posterior_covariance,
    retained_fraction,
)
from inflight.mission_fit.continuous import MissionFit, daily_parameters, fit_with_auxiliary, shift_columns
from inflight.mission_fit.crosstalk import DISPLAY_UNITS, CrossTalkTable, IgnoredCause, cross_talk
from inflight.mission_fit.daily_equations import (
    holds_day_night,
    prior_sigma_of,
    reference_of,
    temperature_entry,
    with_auxiliary_columns,
)
from inflight.mission_fit.day_night import LEAST_RETAINED, SERIES, SWITCHED, DayNightField
from inflight.mission_fit.temperature import (
    KINDS,
    NONE,
    PRIOR,
    CoilFit,
    TemperatureChoice,
    coefficients_of,
    coil_columns_of,
)
from inflight.model import Model


@dataclass(frozen=True, kw_only=True)
class CauseSettings:
    """How causes are fitted to all days and held out.

    Attributes
    ----------
    passes : int
        Passes of the lag; it settles in two, three where the coefficients were not known.
    settled : float
        Of a lag, in its sigmas; assumed.
    lag_unit_s : float
        One unit of the lag's column, s; assumed.
    follows : float
        Sigmas that one of the axes must follow the temperature by for a lag to be determined: a level of
        0.3 %.
    folds : int
        Sections of the span that are held out; assumed.
    sections : int
        Sections by which scores are compared; assumed.
    bias : float
        The bias of the thesis' example, nT (Yin 2010, section 4.2).
    parts : int
        Parts of the span of the jackknife; assumed.
    """

    passes: int = 4
    settled: float = 1e-2
    lag_unit_s: float = 10.0
    follows: float = 3.0
    folds: int = 5
    sections: int = 40
    bias: float = 0.4
    parts: int = 10


CAUSE_SETTINGS = CauseSettings()


def fit_coil_lag(
    equations: NormalEquations,
    auxiliary: Sequence[xr.Dataset | None],
    found: MissionFit,
    model: Model,
    lag: float,
) -> CoilFit:
    """Fit the coil's temperature with its lag, together with everything else of the model.

    Parameters
    ----------
    equations : NormalEquations
        Wide ones of the days.
    auxiliary : sequence of Dataset or None
        As `inflight.mission_fit.daily_equations.split_auxiliary` makes them, one a day.
    found : MissionFit
        The fit of all days; its trends and the weights of its days hold.
    model : Model
        The one the equations were made with: its sigmas are what is known of the coefficients. Of the lag
        nothing is but an hour.
    lag : float
        With which the channel was aligned, s; the fit finds the change against it, to first order.

    Returns
    -------
    CoilFit
        Its `fit` counts days as clusters; the covariance is that of days correlated in time.

    Raises
    ------
    CalibrationError
        When data may not move how the sensor follows a temperature, or its rate is known on no day.
    """
    entry = temperature_entry(model)
    if entry is None:
        raise CalibrationError(
            "the model has no effect 'temperature' of the vector sensor that data may move",
            remedy="give linear and quadratic of one a sigma",
        )
    channel = entry.effect.channels[0]
    rates, own = coil_columns_of(channel, KINDS[2:]), coil_columns_of(entry.name, KINDS[:2])
    wide, night = _with_day_night_columns(equations, auxiliary, rates, model)
    sigma = np.concatenate([prior_sigma_of(model), [_PRIOR[SWITCHED]] * len(night), [PRIOR[2]]])
    fit, change = found.fit, 0.0
    for _ in range(CAUSE_SETTINGS.passes):
        value, before = np.array([fit.value[fit.index(name)][0] for name in own]), change
        linear = _with_lag(wide, rates, own, value, change)
        fit = fit_with_auxiliary(linear, equations, found, sigma)
        change = float(fit.value[-1])
        if abs(change - before) <= CAUSE_SETTINGS.settled * fit.sigma[-1]:
            break
    places = [fit.index(name).start for name in (*own, "lag")]
    columns = [linear.columns.index(name) for name in (*own, "lag")]
    whole = fit.value[places] + np.append(np.zeros(len(own)), lag)
    determined = fit.determined[places].copy()
    follows = np.abs(whole[:3]) > CAUSE_SETTINGS.follows * fit.sigma[places][:3]
    determined[-1] &= bool(follows.any()) and fit.sigma[places[-1]] < 0.5 * PRIOR[2]
    return CoilFit(
        channel,
        reference_of(entry),
        ClusteredFit(
            whole,
            fit.covariance[np.ix_(places, places)],
            retained_fraction(linear.total[:-1, :-1])[columns],
            determined,
            fit.rms**2,
            len(linear),
            float(linear.count.sum()),
        ),
    )


def _with_lag(
    equations: NormalEquations, rates: Sequence[str], own: Sequence[str], value: Floats, change: float
) -> NormalEquations:
    """Return the equations with one column ``lag`` for those of the rates, linear about values and lag.

    With C the coefficients' columns, R those of the rates, c the coefficients (c0 the reference's) and d the
    lag's change, the residual is ``y + C (c - c0) + d R c``: about c1 and d1 its columns are ``C + d1 R`` and
    ``R c1``, and what is constant, ``d1 R (c0 - c1)``, belongs to y.
    """
    names, scale = equations.columns, equations.scale
    of_rate = [names.index(name) for name in rates]
    of_coefficient = [names.index(name) for name in own]
    kept = [place for place in range(len(names)) if place not in set(of_rate)]
    weights = np.zeros((len(kept) + 2, len(scale)))
    weights[np.arange(len(kept)), kept] = 1.0
    for rate, column in zip(of_rate, of_coefficient, strict=True):
        weights[kept.index(column), rate] = change * scale[column] / scale[rate]
    weights[-2, of_rate] = CAUSE_SETTINGS.lag_unit_s * value / scale[of_rate]
    weights[-1, -1] = 1.0
    common = equations.reference
    assert common is not None
    each = np.broadcast_to(weights, (len(common), *weights.shape)).copy()
    each[:, -1, of_rate] = change * (common[:, of_coefficient] - value) / scale[of_rate]
    reference = np.concatenate([common[:, kept], np.zeros((len(common), 2))], axis=1)
    units = np.concatenate([scale[kept], [CAUSE_SETTINGS.lag_unit_s, 1.0]])
    return equations.combine([*(names[place] for place in kept), "lag", RESIDUAL], each, units, reference)


def compare_temperatures_jointly(
    equations: NormalEquations,
    auxiliary: Sequence[xr.Dataset | None],
    found: MissionFit,
    model: Model,
    channels: Sequence[str],
) -> TemperatureChoice:
    """Judge temperatures, and none, by what they leave of parts of the span that were not fitted.

    The nine parameters are each day's own, alike for all rivals; whatever else the model lets data move is
    fitted anew with each rival. The coefficients have a prior of 0 (`PRIOR`).

    Parameters
    ----------
    equations, auxiliary, found, model
        As `fit_coil_lag`.
    channels : sequence of str
        With all their columns: the model's own, and auxiliary ones.

    Raises
    ------
    CalibrationError
        When no day has all of them, or there are too few days.
    """
    entry = temperature_entry(model)
    own = "" if entry is None else entry.effect.channels[0]
    held = [] if entry is None else coil_columns_of(entry.name, KINDS[:2])
    columns = {
        name: (held if name == own else coil_columns_of(name, KINDS[:2])) + coil_columns_of(name, KINDS[2:])
        for name in channels
    }
    added = [column for names in columns.values() for column in names if column not in held]
    wide, night = _with_day_night_columns(equations, auxiliary, added, model)
    # The residual is that of the fit of all days, without the temperature coefficients of the model.
    fitted = dict(zip(found.fit.trends, found.fit.at(wide.middle)[0].T, strict=True))
    zero = np.zeros(len(wide))
    values = [zero if name in held else fitted.get(name, zero) for name in wide.columns]
    nine = wide.columns[:9]
    rest = wide.at(np.stack(values, axis=1)).marginalise(nine, cut=SOLVER_SETTINGS.weak_cut, least_kept=0.0)
    others = [name for name in [*equations.columns[9:], *night] if name not in held]
    known = dict(zip(equations.columns, prior_sigma_of(model).tolist(), strict=True))
    known |= dict.fromkeys(night, _PRIOR[SWITCHED])
    prior = np.array([known[name] for name in others])
    squares: dict[str, Floats] = {}
    sections = np.array_split(np.arange(len(wide)), min(CAUSE_SETTINGS.sections, len(wide)))
    if len(sections) < 2 * CAUSE_SETTINGS.folds:
        raise CalibrationError(
            f"{len(sections)} days for {CAUSE_SETTINGS.folds} parts to hold out",
            remedy=f"use {2 * CAUSE_SETTINGS.folds} days or more",
        )
    rows = np.array([wide.count[part].sum() for part in sections])
    for name in (NONE, *channels):
        own_columns = columns.get(name, [])
        gram = rest.select([*others, *own_columns]).in_units
        merged = np.array([gram[part].sum(axis=0) for part in sections])
        squares[name] = _held_out(merged, rows, prior, bool(own_columns)) / rows
    return TemperatureChoice.of_squares(squares, rows)


def _held_out(gram: Floats, rows: Floats, prior: Floats, temperature: bool) -> Floats:
    """Return the sum of squares of each section at the fit of the other folds; (section,) nT^2."""
    out = np.empty(len(gram))
    for part in np.array_split(np.arange(len(gram)), CAUSE_SETTINGS.folds):
        total = np.delete(gram, part, axis=0).sum(axis=0)
        change = np.append(_solve_columns(total, float(np.delete(rows, part).sum()), prior, temperature), 1.0)
        out[part] = np.einsum("i,bij,j->b", change, gram[part], change)
    return out


def _solve_columns(gram: Floats, rows: float, prior: Floats, temperature: bool) -> Floats:
    """Return the values of all columns: the others', and the twelve of one temperature with its lag."""
    count, unknown = prior.size, np.zeros(7)
    sigma = np.concatenate([prior, np.repeat(PRIOR, [3, 3, 1])]) if temperature else prior
    value = np.zeros(count)
    for _ in range(CAUSE_SETTINGS.passes):
        basis = np.zeros((len(gram), sigma.size + 1))
        basis[:count, :count], basis[-1, -1] = np.eye(count), 1.0
        if temperature:
            coefficients, slopes = coefficients_of(unknown)
            basis[count:-1, count:-1], basis[count:-1, -1] = slopes, coefficients - slopes @ unknown
        value, _ = fit_white(basis.T @ gram @ basis, rows, sigma)
        unknown = value[count:]
    return np.concatenate([value[:count], coefficients_of(unknown)[0]]) if temperature else value


#: What is known of the fields beforehand, nT.
_PRIOR = {
    SWITCHED: float(np.max(DayNight.vector.sigma)),
    SERIES: float(np.max(DayNightSeries.amplitude.sigma)),
}


@dataclass(frozen=True)
class JointDayNight:
    """A field of day and night, fitted together with everything else.

    Attributes
    ----------
    field : DayNightField
    found : MissionFit
        The fit with it.
    equations : NormalEquations
        With its columns, of the days whose orbit is known.
    """

    field: DayNightField
    found: MissionFit
    equations: NormalEquations

    def daily(self) -> xr.Dataset:
        """Return each day's nine parameters and time shift with the field known; see `daily_parameters`."""
        return daily_parameters(self.equations, self.found, shift_columns(self.found.model))


def fit_day_night_jointly(
    equations: NormalEquations,
    auxiliary: Sequence[xr.Dataset | None],
    found: MissionFit,
    model: Model,
    form: str = SWITCHED,
) -> JointDayNight:
    """Fit the field in one of its forms, `SWITCHED` or `SERIES`, together with everything of the model.

    Parameters
    ----------
    equations, auxiliary, found, model
        As `inflight.mission_fit.joint_effects.fit_coil_lag`.
    form : str

    Raises
    ------
    CalibrationError
        When the orbit is known on no day, the model has such a field itself, or none of it is determined.
    """
    if holds_day_night(model):
        raise CalibrationError(
            "the model has a field of day and night itself: the table 'trend' tells it",
            remedy="leave it out of the model to have it fitted beside",
        )
    names = day_night_columns(auxiliary, form)
    if not names:
        raise CalibrationError(
            "the mission delivers no positions", remedy="state a channel of kind 'position'"
        )
    wide = with_auxiliary_columns(equations, auxiliary, names)
    sigma = np.append(prior_sigma_of(model), [_PRIOR[form]] * len(names))
    fit = fit_with_auxiliary(wide, equations, found, sigma)
    places = np.array([fit.index(name).start for name in names])
    columns = np.array([wide.columns.index(name) for name in names])
    retained = retained_fraction(wide.total[:-1, :-1])[columns]
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
    return JointDayNight(field, replace(found, fit=fit), wide)


def _with_day_night_columns(
    equations: NormalEquations, auxiliary: Sequence[xr.Dataset | None], names: Sequence[str], model: Model
) -> tuple[NormalEquations, list[str]]:
    """Return equations with columns of temperatures, and the names of those of day and night before them.

    A temperature follows the light, and a field that switches with it does what a lag does: what it may be
    belongs to the lag's error. None where the model holds such a field, or no day knows its orbit too.
    """
    night = [] if holds_day_night(model) else day_night_columns(auxiliary)
    if night:
        try:
            return with_auxiliary_columns(equations, auxiliary, [*night, *names]), night
        except CalibrationError:
            pass
    return with_auxiliary_columns(equations, auxiliary, names), []


def day_night_columns(auxiliary: Sequence[xr.Dataset | None], form: str = SWITCHED) -> list[str]:
    """Return the columns of a field of day and night in one of its forms; none without positions."""
    known = {str(name) for part in auxiliary if part is not None for name in part["beside"].values}
    return sorted(name for name in known if name.startswith(form))


#: How much of a cause is asked about, by its unit: 10 ms, 1 ppm/K, ...
SIZES = {
    "s": 0.01,
    "s^2": 0.01,
    "1": 1e-6,
    "deg": 1.0 / 3600.0,
    "1/K": 1e-6,
    "1/K^2": 1e-8,
    "1/nT": 1e-12,
    "1/nT^2": 1e-16,
}


def ignored_causes(columns: Sequence[str], units: Mapping[str, str], model: Model) -> list[IgnoredCause]:
    """Return columns as causes of a size that people ask about; of a scalar bias 0.4 nT.

    Parameters
    ----------
    columns : sequence of str
        Of the equations.
    units : mapping of str to str
        Of columns; nT where none is given.
    model : Model
        Its effects say which cause is a bias of the scalar sensor.
    """
    biases = {f"{entry.name}.bias" for entry in model.effects if entry.effect.name == "scalar_bias"}
    found = []
    for name in columns:
        unit = units.get(name, "nT")
        size = CAUSE_SETTINGS.bias if name in biases else SIZES.get(unit, 1.0)
        found.append(IgnoredCause(name, size, unit))
    return found


def nine_parameter_cross_talk(
    equations: NormalEquations, units: Mapping[str, str], model: Model
) -> CrossTalkTable:
    """Return what every other column, ignored, does to the nine parameters fitted alone.

    Parameters
    ----------
    equations : NormalEquations
        Of days, the model's columns and any auxiliary ones.
    units, model
        As `ignored_causes`.
    """
    nine = equations.columns[:9]
    causes = ignored_causes(equations.columns[9:], units, model)
    if not causes:
        raise CalibrationError(
            "the model has nothing but the nine parameters that data may move",
            remedy="give an effect a sigma in the model's file",
        )
    own_units = dict(zip(nine, (NINE_PARAMETER_UNITS[name] for name in NINE_PARAMETER_NAMES), strict=True))
    return cross_talk(equations.filled, causes, nine, own_units)


def joint_cross_talk(equations: NormalEquations, units: Mapping[str, str], model: Model) -> xr.Dataset:
    """Return what each parameter, ignored, does to all others that are fitted together.

    Parameters
    ----------
    equations : NormalEquations
        Of days, the model's columns alone; what is known beforehand of them holds them.
    units, model
        As `ignored_causes`.

    Returns
    -------
    xarray.Dataset
        dims ignored, parameter: `value` and `sigma`, from leaving out tenths of the span, in `units`
        (parameter); `correlation` of both errors; `size`, `size_units` (ignored). NaN where both are one.

    Raises
    ------
    CalibrationError
        When there is no block.
    """
    filled = equations.filled
    if not len(filled):
        raise CalibrationError("no day tells anything", remedy="see the failed days of the run")
    scale = filled.scale[:-1]
    prior, names = prior_sigma_of(model) / scale, filled.columns
    causes = ignored_causes(names, units, model)
    shown = [DISPLAY_UNITS.get(units.get(name, ""), (1.0, units.get(name, ""))) for name in names]
    factor = scale * np.array([one for one, _ in shown])
    size = np.array([one.size for one in causes]) / scale
    total, count = filled.total, float(filled.count.sum())
    parts = np.array_split(np.arange(len(filled)), min(CAUSE_SETTINGS.parts, len(filled)))
    whole = _covariance(total, count, prior)
    value = _shifts(whole) * np.outer(size, factor)
    error = np.full_like(value, np.nan)
    if len(parts) > 1:
        rest = zip(filled.sums(parts), (float(filled.count[part].sum()) for part in parts), strict=True)
        without = np.array([_shifts(_covariance(total - one, count - rows, prior)) for one, rows in rest])
        error = jackknife(without) * np.outer(size, factor)
    both = ("ignored", "parameter")
    return xr.Dataset(
        {
            "value": (both, value),
            "sigma": (both, error),
            "correlation": (both, correlation_of(whole)),
            "units": ("parameter", np.array([unit for _, unit in shown], dtype="U16")),
            "size": ("ignored", np.array([one.size for one in causes])),
            "size_units": ("ignored", np.array([one.unit for one in causes], dtype="U16")),
        },
        coords={"ignored": names, "parameter": names},
        attrs={"blocks": len(filled)},
    )


def _covariance(gram: Floats, count: float, prior: Floats) -> Floats:
    """Return the covariance of all columns, scaled, for white residuals; 0 for what is fixed."""
    return posterior_covariance(gram[:-1, :-1], prior, fit_white(gram, count, prior)[1])


def _shifts(covariance: Floats) -> Floats:
    """Return by how much parameters (second) move for one scaled unit of an ignored one (first)."""
    own = np.diag(covariance)
    found = -covariance / np.where(own > 0, own, np.inf)[:, None]
    np.fill_diagonal(found, np.nan)
    return np.asarray(found)
