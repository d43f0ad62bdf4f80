"""Scale factors that follow the temperature of the feedback coil, with the lag of what is recorded.

The factor of an axis is ``1 - linear dT - quadratic dT^2``, with dT the temperature at ``t - lag`` less a
reference (Yin 2010, section 2.4 step 4). The corrected residual answers to the coefficients by ``-s dT`` and
``-s dT^2``, s being the column of the axis' scale factor, and to a change d of the lag by
``+d (linear s T' + quadratic s 2 dT T')``: columns of the temperature's rate whose coefficients are the lag's
change times the others. All of it is algebra of Gram matrices that hold these columns; to first order a
delay and a time constant are one. Where samples are at hand the columns are formed again at the lag found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from scipy import stats

from inflight.arrays import Floats
from inflight.calibration.equations import NormalEquations
from inflight.effects.base import AXES
from inflight.effects.rates import slope
from inflight.errors import CalibrationError
from inflight.estimators.absorption import left
from inflight.estimators.clusters import ClusteredFit, solve_clusters
from inflight.estimators.rows import NINE, block_equations, joined, nine_columns, places
from inflight.estimators.trend_equations import at_one_reference
from inflight.time import GAP, SECOND, Int64

#: Kinds of columns of a temperature, three axes each: what the coefficient, and its lag, answer to.
KINDS = ("linear", "quadratic", "rate", "quadratic_rate")
#: What is known beforehand of each: 1/K, 1/K^2, and of the lag, s.
PRIOR = (1e-4, 1e-6, 3600.0)
#: Turns of the fit; lags of samples are settled to this part of their sigma, in so many formations.
_TURNS, _SETTLED, _FORMATIONS = 12, 0.1, 8
#: Chance that a lag is told of a temperature that nothing follows.
FALSE_ALARM = 0.01
#: Rows of a fit: three of each coefficient, and the lag.
_LAG = 6


@dataclass(frozen=True)
class CoilBlock:
    """Samples of one block: a day, or a part of one whose noise is its own.

    Attributes
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000, rising.
    field : ndarray, shape (time, 3)
        Corrected field, nT, sensor axes.
    residual : ndarray, shape (time,)
        dB, nT, corrected for all that is known but the temperature; NaN where missing.
    temperature : mapping of str to ndarray, shape (time,)
        degC by name of the channel; NaN where missing.
    """

    stamps: Int64
    field: Floats
    residual: Floats
    temperature: dict[str, Floats]


@dataclass(frozen=True)
class CoilFit:
    """Coefficients of one temperature and its lag.

    Attributes
    ----------
    channel : str
    reference : float
        degC, where dT is 0.
    fit : ClusteredFit
        Linear x, y, z (1/K), quadratic x, y, z (1/K^2), lag (s): `value` is the whole, not the change.
    """

    channel: str
    reference: float
    fit: ClusteredFit

    @classmethod
    def of_table(cls, table: xr.Dataset) -> CoilFit:
        """Return the fit that a table was made of; what only the fit knew of its rows is NaN."""
        held = {name: table[name].values for name in ("value", "covariance", "retained", "determined")}
        fit = ClusteredFit(variance=float("nan"), clusters=0, rows=float("nan"), **held)
        return cls(str(table.attrs["channel"]), float(table.attrs["reference_degC"]), fit)

    @property
    def linear(self) -> Floats:
        """1/K; (3,)."""
        return self.fit.value[:3]

    @property
    def quadratic(self) -> Floats:
        """1/K^2; (3,)."""
        return self.fit.value[3:_LAG]

    @property
    def lag(self) -> tuple[float, float]:
        """By how much the recorded temperature leads the one that acts, and its standard deviation, s."""
        return float(self.fit.value[_LAG]), float(self.fit.sigma[_LAG])

    def told(self) -> str:
        """Say it in a sentence."""
        parts = [
            f"{axis} {1e6 * value:.3f} +- {1e6 * sigma:.3f}"
            for axis, value, sigma in zip(AXES, self.linear, self.fit.sigma, strict=False)
        ]
        lag = (
            f"lag {self.lag[0]:.1f} +- {self.lag[1]:.1f} s"
            if self.fit.determined[_LAG]
            else "lag NOT DETERMINED"
        )
        return f"{self.channel}: {', '.join(parts)} ppm/K; {lag}"

    def table(self) -> xr.Dataset:
        """Return the values: dims parameter, other."""
        names = [f"{kind}[{axis}]" for kind in KINDS[:2] for axis in AXES] + ["lag"]
        units = ["1/K"] * 3 + ["1/K2"] * 3 + ["s"]
        return xr.Dataset(
            {
                "value": ("parameter", self.fit.value),
                "sigma": ("parameter", self.fit.sigma),
                "covariance": (("parameter", "other"), self.fit.covariance),
                "determined": ("parameter", self.fit.determined),
                "retained": ("parameter", self.fit.retained),
                "units": ("parameter", np.array(units)),
            },
            coords={"parameter": names, "other": names},
            attrs={"channel": self.channel, "reference_degC": self.reference, "told": self.told()},
        )


def coil_columns(
    channel: str, field: Floats, stamps: Int64, temperature: Floats, lag: float, reference: float
) -> dict[str, Floats]:
    """Return the columns of a temperature: ``channel.kind[axis]`` for every one of `KINDS`, (time,).

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        nT, sensor axes.
    stamps : ndarray of int64, shape (time,)
        TT2000.
    temperature : ndarray, shape (time,)
        degC; rows whose temperature a lag ago is not known are NaN.
    lag : float
        s, where the columns are formed.
    reference : float
        degC.
    """
    change = _delayed(stamps, temperature, lag) - reference
    rate = slope(change, stamps)
    parts = (-change, -(change**2), rate, 2.0 * change * rate)
    nine = nine_columns(field)
    return {
        f"{channel}.{kind}[{axis}]": part * nine[name]
        for kind, part in zip(KINDS, parts, strict=True)
        for axis, name in zip(AXES, NINE[:3], strict=True)
    }


def _delayed(stamps: Int64, temperature: Floats, lag: float) -> Floats:
    """Return the temperature a lag ago, NaN within gaps and beyond the ends; (time,)."""
    known, out = np.flatnonzero(np.isfinite(temperature)), np.full(stamps.size, np.nan)
    if known.size < 2:
        return out
    seconds = (stamps - stamps[0]) / SECOND
    base, at = seconds[known], seconds - lag
    apart = np.diff(base)
    after = np.clip(np.searchsorted(base, at), 1, base.size - 1)
    inside = (at >= base[0]) & (at <= base[-1]) & (apart[after - 1] <= GAP * np.median(apart))
    out[inside] = np.interp(at[inside], base, temperature[known])
    return out


def coil_equations(
    block: CoilBlock, lag: dict[str, float], reference: float, *, robust: bool = True
) -> NormalEquations:
    """Return a block's normal equations: the nine, and the columns of every temperature at its lag.

    Raises
    ------
    CalibrationError
        When fewer rows are usable than there are columns.
    """
    columns = nine_columns(block.field)
    for channel, values in block.temperature.items():
        columns |= coil_columns(channel, block.field, block.stamps, values, lag.get(channel, 0.0), reference)
    span = int(block.stamps[0]), int(block.stamps[-1]) + 1
    return block_equations(columns, block.residual, span, robust=robust)


def fit_coil(
    equations: NormalEquations,
    channel: str,
    *,
    lag: float = 0.0,
    reference: float = 20.0,
    each: Sequence[str] = NINE,
    prior: tuple[float, float, float] = PRIOR,
) -> CoilFit:
    """Fit one temperature to wide normal equations, its lag to first order about the one they hold.

    Parameters
    ----------
    equations : NormalEquations
        Of five blocks or more, with the columns of `coil_columns` at `lag` and `reference`.
    channel : str
        Name before the columns.
    lag, reference : float
        s and degC of these columns.
    each : sequence of str
        Columns that are free in every block. The nine must be where they wander from block to block; a
        temperature that only differs between blocks is then not seen, and its sigma says so.
    prior : tuple of float
        What is known beforehand, see `PRIOR`. Without a temperature dependence nothing tells a lag.

    Raises
    ------
    CalibrationError
        A column is missing, or there are too few blocks.
    """
    gram, count = left_of_each(equations, channel, each)
    return solved(gram, count, channel, lag, reference, prior)


def left_of_each(equations: NormalEquations, channel: str, each: Sequence[str]) -> tuple[Floats, Floats]:
    """Return [12 columns | residual] of the blocks less what their own columns explain, physical units."""
    data = at_one_reference(equations).dataset
    own = [f"{channel}.{kind}[{axis}]" for kind in KINDS for axis in AXES]
    kept = np.append(places(equations, own), data.sizes["column"] - 1)
    absorbed = places(equations, list(each))
    gram = data["gram"].values
    gram = left(gram, absorbed, kept) if absorbed.size else gram[:, kept[:, None], kept[None, :]]
    size = data["scale"].values[kept]
    return np.asarray(gram / np.outer(size, size)), np.asarray(data["count"].values)


def coefficients_of(value: Floats) -> tuple[Floats, Floats]:
    """Return the 12 coefficients of 7 unknowns (linear, quadratic, change of lag), and (12, 7) slopes."""
    linear, quadratic, change = value[:3], value[3:_LAG], value[_LAG]
    found = np.concatenate([value[:_LAG], change * linear, change * quadratic])
    slopes = np.zeros((12, 7))
    slopes[:_LAG, :_LAG] = np.eye(_LAG)
    slopes[_LAG:, :_LAG] = change * np.eye(_LAG)
    slopes[_LAG:, _LAG] = value[:_LAG]
    return found, slopes


def solved(
    gram: Floats,
    count: Floats,
    channel: str,
    lag: float,
    reference: float,
    prior: tuple[float, float, float],
) -> CoilFit:
    """Gauss-Newton on the unknowns, with a prior of 0 for the coefficients and for the change of the lag."""
    sigma = np.repeat(prior, [3, 3, 1])
    value = _without_lag(gram, count, sigma)
    for _ in range(_TURNS):
        fit = solve_clusters(_turned(gram, value), count, sigma)
        change, value = fit.value - value, fit.value
        if np.all(np.abs(change) <= 1e-3 * fit.sigma):
            break
    whole = value + np.append(np.zeros(_LAG), lag)
    told = fit.determined & (fit.sigma < 0.5 * sigma)
    told[_LAG] &= _depends(gram, value, fit)
    return CoilFit(
        channel,
        reference,
        ClusteredFit(whole, fit.covariance, fit.retained, told, fit.variance, fit.clusters, fit.rows),
    )


def _depends(gram: Floats, value: Floats, fit: ClusteredFit) -> bool:
    """Return whether any axis follows the temperature beyond chance: else its lag is that of noise.

    What counts is ``linear + r quadratic``, r being the slope of dT^2 on dT in the data: with a reference off
    the temperatures neither of the two is told by itself.
    """
    total = gram.sum(axis=0)
    turn = np.zeros((3, 7))
    for axis in range(3):
        turn[axis, [axis, axis + 3]] = 1.0, total[axis, axis + 3] / max(total[axis, axis], 1e-300)
    sigma = np.sqrt(np.diag(turn @ fit.covariance @ turn.T))
    chance = 2.0 * stats.t.sf(np.abs(turn @ value) / np.maximum(sigma, 1e-300), fit.clusters - 1)
    return bool(3.0 * chance.min() < FALSE_ALARM)


def _without_lag(gram: Floats, count: Floats, sigma: Floats) -> Floats:
    """Return the unknowns with no change of the lag."""
    turn = np.zeros((13, 7))
    turn[:_LAG, :_LAG], turn[-1, -1] = np.eye(_LAG), -1.0
    start = solve_clusters(turn.T @ gram @ turn, count, sigma[:_LAG])
    return np.append(start.value, 0.0)


def _turned(gram: Floats, value: Floats) -> Floats:
    """Return Gram matrices of [slopes | residual], linear about the values; (block, 8, 8).

    Their solution is the unknowns themselves, not a change of them, so that a prior holds them at 0.
    """
    found, slopes = coefficients_of(value)
    found = found - slopes @ value
    turn = np.zeros((13, 8))
    turn[:-1, :-1], turn[:-1, -1], turn[-1, -1] = slopes, -found, -1.0
    return np.asarray(turn.T @ gram @ turn)


def fit_coil_samples(
    blocks: Sequence[CoilBlock],
    channel: str,
    *,
    lag: float = 0.0,
    reference: float = 20.0,
    each: Sequence[str] = NINE,
    prior: tuple[float, float, float] = PRIOR,
) -> CoilFit:
    """Fit one temperature to samples: columns are formed anew at each lag, until it stands still.

    Parameters
    ----------
    blocks : sequence of CoilBlock
        Five or more; those without enough rows are left out.
    channel, lag, reference, each, prior
        As for `fit_coil`; `lag` is where the search starts.

    Raises
    ------
    CalibrationError
        Fewer than five blocks have rows, or a lag that does not settle.
    """
    at = lag
    for _ in range(_FORMATIONS):
        fit = fit_coil(
            _formed(blocks, channel, at, reference),
            channel,
            lag=at,
            reference=reference,
            each=each,
            prior=prior,
        )
        change = fit.lag[0] - at
        if not fit.fit.determined[_LAG] or abs(change) <= _SETTLED * fit.lag[1]:
            return fit
        at = fit.lag[0]
    raise CalibrationError(
        f"the lag of '{channel}' does not settle: {at:.0f} s after {_FORMATIONS} turns",
        remedy="start nearer to it, or take a longer span",
    )


def _formed(blocks: Sequence[CoilBlock], channel: str, lag: float, reference: float) -> NormalEquations:
    made = []
    for block in blocks:
        own = replace(block, temperature={channel: block.temperature[channel]})
        try:
            made.append(coil_equations(own, {channel: lag}, reference))
        except CalibrationError:
            continue
    return joined(made)
