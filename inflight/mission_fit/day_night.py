"""The field that day and night switch on a spacecraft: what of it can be determined, and how it is fitted.

Takes normal equations with its columns; makes a `DayNightField`, and the nine parameters of each block
with and without it. Two forms (Yin 2010, section 4.3). *Switched*: a vector times `sunlit`, 1 in the Sun
and 0 in the shadow. *Series*: ``a_0 + sum of a_k cos(2 pi k (t - t0) / T)``, t0 nearest the Sun, T the
orbit. A square wave of duty D and height 1 has a_0 = D and a_k = 2 sin(pi k D) / (pi k): the two forms
agree as k grows.

A constant field at the sensor is an offset to a scalar calibration, so a_0 is never determined together
with it; the rest is only as far as the nine parameters cannot imitate it. That part is `retained`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NINE_PARAMETER_NAMES, NINE_PARAMETER_UNITS, NormalEquations, field_columns
from inflight.effects import AXES, MAX_HARMONIC, DayNight, DayNightSeries, order_names
from inflight.errors import CalibrationError, SamplesError
from inflight.frames import EARTH_RADIUS
from inflight.lsq import SOLVER_SETTINGS, gram_inverse, marginalise, solve_clusters
from inflight.mission_fit.crosstalk import DISPLAY_UNITS

#: The parameters' names are those of the effects `day_night` and `day_night_series`.
SWITCHED, SERIES = "day_night.vector", "day_night_series.amplitude"

#: A column of which all others leave less than this part has no value of its own: the rms of that part is
#: then below a hundredth of the column's.
LEAST_RETAINED = 1e-4

#: Arrays of a fitted field.
_ARRAYS = ("value", "sigma", "covariance", "retained", "determined")

Flags = npt.NDArray[np.bool_]

# Columns.


def switched_columns(direction: Floats, sunlit: Floats, axes: Sequence[str] = AXES) -> dict[str, Floats]:
    """Return the columns of a field that is there in the Sun; nT per nT, (time,) each.

    Parameters
    ----------
    direction : ndarray, shape (time, 3)
        Unit vectors of the field, sensor axes.
    sunlit : ndarray, shape (time,)
        1 in the Sun, 0 in the shadow, between them in penumbra; NaN where it is not known.
    axes : sequence of str
        Components that are fitted; the thesis takes x and z.
    """
    return field_columns(SWITCHED, direction, sunlit, axes)


def series_columns(
    direction: Floats, sun_phase: Floats, order: int = 4, axes: Sequence[str] = AXES, constant: bool = False
) -> dict[str, Floats]:
    """Return the columns of the cosine series; nT per nT, (time,) each.

    Parameters
    ----------
    direction : ndarray, shape (time, 3)
        Unit vectors of the field, sensor axes.
    sun_phase : ndarray, shape (time,)
        Along the orbit from the point nearest the Sun, deg.
    order : int
        Largest k.
    axes : sequence of str
        Components.
    constant : bool
        Also a_0, named c<axis>0; only to see that it is an offset.

    Raises
    ------
    SamplesError
        When the order is below 1 or above 12.
    """
    if not 1 <= order <= MAX_HARMONIC:
        raise SamplesError(
            f"order {order} of a day/night series", remedy=f"take 1 to {MAX_HARMONIC}, or the switched form"
        )
    phase, found = np.deg2rad(sun_phase), {}
    for k in range(0 if constant else 1, order + 1):
        for name, column in field_columns("", direction, np.cos(k * phase), axes).items():
            found[f"{SERIES}[c{name[1]}{k}]"] = column
    return found


# The fit.


@dataclass(frozen=True)
class DayNightField:
    """A day/night field, as the residual shows it: of the vector sensor less that of the scalar sensor.

    Attributes
    ----------
    columns : tuple of str
        ``day_night.vector[z]`` or ``day_night_series.amplitude[cz1]``.
    value, sigma : ndarray, shape (column,)
        nT; an undetermined one has value 0 and an infinite sigma.
    covariance : ndarray, shape (column, column)
        nT^2, by the jackknife over blocks, with Student's factor for few of them; 0 for undetermined ones.
    retained : ndarray, shape (column,)
        Part of each column's square that neither the nine parameters nor its companions explain.
    determined : ndarray of bool, shape (column,)
    blocks : int
    before, after : float
        Rms residual of the nine parameters without and with the field, nT.
    """

    columns: tuple[str, ...]
    value: Floats
    sigma: Floats
    covariance: Floats
    retained: Floats
    determined: Flags
    blocks: int
    before: float
    after: float

    @property
    def values(self) -> dict[str, float]:
        """Value by column, nT."""
        return dict(zip(self.columns, self.value.tolist(), strict=True))

    @classmethod
    def of_table(cls, table: xr.Dataset) -> DayNightField:
        """Return the field that a table was made of."""
        attributes = table.attrs
        return cls(
            columns=tuple(map(str, table["parameter"].values)),
            blocks=int(attributes["blocks"]),
            before=float(attributes["before_nT"]),
            after=float(attributes["after_nT"]),
            **{name: table[name].values for name in _ARRAYS},
        )

    def table(self) -> xr.Dataset:
        """Return the table.

        Returns
        -------
        xarray.Dataset
            dims parameter, other: `value`, `sigma`, `covariance`, `retained`, `determined`, `units`;
            attributes `at` ("difference"), `blocks`, `before_nT`, `after_nT`.
        """
        each = ("parameter",)
        return xr.Dataset(
            {
                "value": (each, self.value),
                "sigma": (each, self.sigma),
                "covariance": (("parameter", "other"), self.covariance),
                "retained": (each, self.retained),
                "determined": (each, self.determined),
                "units": (each, np.full(len(self.columns), "nT", dtype="U8")),
            },
            coords={"parameter": list(self.columns), "other": list(self.columns)},
            attrs={
                "at": "difference",
                "blocks": self.blocks,
                "before_nT": self.before,
                "after_nT": self.after,
            },
        )

    def entry(self, sensor: str) -> dict[str, Any]:
        """Return the field as an effect of a model, to be listed behind the ``vector_sensor``.

        Components that were not fitted, or not determined, are 0 with the effect's own wide sigma.

        Parameters
        ----------
        sensor : str
            The vector instrument.
        """
        name, _, parameter = (SERIES if self._is_series else SWITCHED).partition(".")
        found: dict[str, Any] = {"effect": name, "sensor": sensor}
        axes: tuple[str, ...] = AXES
        if self._is_series:
            order = max(int(one.removesuffix("]").partition("[c")[2][1:]) for one in self.columns)
            found["order"], axes = order, order_names(order, sines=False)
        of_effect = DayNightSeries.amplitude if self._is_series else DayNight.vector
        fitted = {
            one.partition("[")[2].removesuffix("]"): (float(value), float(sigma))
            for one, value, sigma in zip(self.columns, self.value, self.sigma, strict=True)
            if np.isfinite(sigma)
        }
        both = {axis: fitted.get(axis, (0.0, float(np.max(of_effect.sigma)))) for axis in axes}
        found[parameter] = {
            "time": "constant",
            "unit": "nT",
            "value": {axis: value for axis, (value, _) in both.items()},
            "sigma": {axis: sigma for axis, (_, sigma) in both.items()},
            "free": False,
        }
        return found

    @property
    def _is_series(self) -> bool:
        return self.columns[0].startswith(SERIES)

    def series(self, sun_phase: Floats) -> tuple[Floats, Floats]:
        """Return the series' field and its sigma along the orbit; (phase, axis) nT each, mean left out.

        Parameters
        ----------
        sun_phase : ndarray, shape (phase,)
            deg.
        """
        basis = np.zeros((sun_phase.size, 3, len(self.columns)))
        for place, name in enumerate(self.columns):
            if name.startswith(SERIES):
                component = name.removeprefix(f"{SERIES}[c").removesuffix("]")
                axis, k = component[0], int(component[1:])
                basis[:, AXES.index(axis), place] = np.cos(k * np.deg2rad(sun_phase))
        variance = np.einsum("pai,ij,paj->pa", basis, self.covariance, basis)
        return basis @ self.value, np.sqrt(np.clip(variance, 0.0, None))


def fit_day_night(
    equations: NormalEquations, marginalised: Sequence[str] = NINE_PARAMETER_NAMES, each_block: bool = True
) -> DayNightField:
    """Fit the day/night columns of normal equations together with the nine parameters.

    Parameters
    ----------
    equations : NormalEquations
        With the nine columns and those of `switched_columns` or `series_columns`.
    marginalised : sequence of str
        What is fitted with them.
    each_block : bool
        A calibration of its own for each block (days), or one for all (orbits of a day).

    Raises
    ------
    CalibrationError
        When there are too few blocks for an uncertainty, no day/night column, or none is determined.
    """
    names = [name for name in equations.columns if name.startswith((SWITCHED, SERIES))]
    if not names:
        raise CalibrationError(
            f"no day/night column among {equations.columns}",
            remedy="form the equations with `switched_columns` or `series_columns`",
        )
    both = equations.select([*names, *marginalised])
    groups = None if each_block else [range(len(both))]
    rest = both.marginalise(marginalised, groups, cut=SOLVER_SETTINGS.weak_cut, least_kept=0.0)
    own = both.index(names)
    retained, determined = _retained(rest.total[:-1, :-1], both.total[own, own])
    if not determined.any():
        raise CalibrationError(
            "no part of the day/night field is told from the nine parameters: is there any night?",
            remedy="take days at other local times",
        )
    free = [name for name, is_determined in zip(names, determined, strict=True) if is_determined]
    parts = rest.select(free) if each_block else both.select([*free, *marginalised])
    # Gram matrices of [free columns | others fitted with them | residual]. The field observed is the
    # residual with the other sign: a column is what the field adds to the correction.
    grams, rows = parts.rows(parts.names), parts.count
    sign = np.append(np.ones(grams.shape[1] - 1), -1.0)
    found = solve_clusters(grams * np.outer(sign, sign), rows)
    place, count = np.flatnonzero(determined), len(free)
    value, covariance = np.zeros(len(names)), np.zeros((len(names), len(names)))
    value[place] = found.value[:count]
    covariance[np.ix_(place, place)] = found.covariance[:count, :count]
    sigma = np.where(determined, np.sqrt(np.diag(covariance)), np.inf)
    total = grams.sum(axis=0)
    alone = marginalise(total, np.arange(count, len(total) - 1), np.array([len(total) - 1]))[0, 0]
    change = np.append(found.value, 1.0)
    squares = (alone, change @ total @ change)
    before, after = (float(np.sqrt(max(square, 0.0) / float(rows.sum()))) for square in squares)
    return DayNightField(
        tuple(names), value, sigma, covariance, retained, determined, found.clusters, before, after
    )


def _retained(matrix: Floats, size: Floats) -> tuple[Floats, Flags]:
    """Return the retained part of each column and whether it is determined, the worst dropped one by one."""
    retained, determined = np.zeros(size.size), np.ones(size.size, dtype=bool)
    while determined.any():
        free = np.flatnonzero(determined)
        own = np.diag(matrix)[free] > LEAST_RETAINED * size[free]
        part = np.zeros(free.size)
        part[own] = 1.0 / np.diag(gram_inverse(matrix[np.ix_(free[own], free[own])])) / size[free[own]]
        retained[free] = np.clip(part, 0.0, 1.0)
        worst = int(np.argmin(part))
        if part[worst] >= LEAST_RETAINED:
            break
        determined[free[worst]] = False
    return retained, determined


def block_parameters(
    equations: NormalEquations, prior_sigma: Floats, given: Mapping[str, float] | None = None
) -> xr.Dataset:
    """Return the nine parameters of each block by itself, a day/night field being given or ignored.

    Parameters
    ----------
    equations : NormalEquations
        With the nine columns, expressed at their calibration.
    prior_sigma : ndarray, shape (9,)
        What is known beforehand, physical units.
    given : mapping of str to float, optional
        Values of other columns, nT; those left out are ignored.

    Returns
    -------
    xarray.Dataset
        dims block, parameter: `value` (change against the reference) and `sigma`, in ppm, arcsec and nT
        (`units`); `start`, `end` (block) TT2000.
    """
    start = equations.first_reference.copy()
    for name, value in (given or {}).items():
        start[equations.index([name])[0]] = value
    nine = equations.at(start).select(NINE_PARAMETER_NAMES)
    factor = np.array([DISPLAY_UNITS[NINE_PARAMETER_UNITS[name]][0] for name in NINE_PARAMETER_NAMES])
    values, sigmas = np.empty((len(nine), 9)), np.empty((len(nine), 9))
    for index in range(len(nine)):
        one = nine.of_blocks(slice(index, index + 1))
        found, covariance = one.physical(one.solve(prior_sigma))
        values[index] = (found - one.first_reference) * factor
        sigmas[index] = np.sqrt(np.diag(covariance)) * factor
    row = ("block", "parameter")
    units = np.array(
        [DISPLAY_UNITS[NINE_PARAMETER_UNITS[name]][1] for name in NINE_PARAMETER_NAMES], dtype="U8"
    )
    return xr.Dataset(
        {
            "value": (row, values),
            "sigma": (row, sigmas),
            "units": ("parameter", units),
            "start": ("block", nine.start, {"units": "ns", "scale": "TT2000"}),
            "end": ("block", nine.end, {"units": "ns", "scale": "TT2000"}),
        },
        coords={"parameter": list(NINE_PARAMETER_NAMES)},
    )


#: km^3/s^2.
_GM = 398600.4418


def orbit_period(altitude: float) -> float:
    """Return the period of a circular orbit, s; `altitude` in km above the mean radius 6371 km."""
    return float(2.0 * np.pi * np.sqrt((EARTH_RADIUS + altitude) ** 3 / _GM))


def orbit_plane_sun(local_time: Floats, declination: Floats, inclination: float) -> Floats:
    """Return the angle between the Sun and the orbit's plane (beta), deg.

    ``sin beta = sin i cos d sin(15 (LT - 12)) + cos i sin d``: the product of orbit normal and Sun.

    Parameters
    ----------
    local_time : ndarray
        Of the ascending node, h, apparent solar.
    declination : ndarray
        Of the Sun, deg.
    inclination : float
        deg.
    """
    hour, sun, tilt = np.deg2rad(15.0 * (local_time - 12.0)), np.deg2rad(declination), np.deg2rad(inclination)
    sine = np.sin(tilt) * np.cos(sun) * np.sin(hour) + np.cos(tilt) * np.sin(sun)
    return np.asarray(np.rad2deg(np.arcsin(np.clip(sine, -1.0, 1.0))))


def sunlit_duty(altitude: float, beta: Floats) -> Floats:
    """Return which part of a circular orbit lies in the Sun; (...) in (0.5, 1].

    A spherical Earth throws a cylinder of shadow; half the night's arc has the cosine
    ``sqrt(r^2 - R^2) / (r cos beta)``, and there is no night when that exceeds 1.

    Parameters
    ----------
    altitude : float
        km above the mean radius.
    beta : ndarray
        Angle between Sun and orbit plane, deg.
    """
    radius = EARTH_RADIUS + altitude
    cosine = np.sqrt(radius**2 - EARTH_RADIUS**2) / (radius * np.cos(np.deg2rad(beta)))
    return np.asarray(1.0 - np.arccos(np.clip(cosine, -1.0, 1.0)) / np.pi)
