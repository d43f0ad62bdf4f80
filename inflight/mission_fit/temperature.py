"""Scale factors that follow the temperature of the feedback coil, with the lag of what is recorded.

Takes samples, or normal equations with the columns of temperatures; makes coefficients and lag, the rivals
of a temperature judged on blocks that were not fitted, and the loop of a daily parameter.

The factor of an axis is ``1 - linear dT - quadratic dT^2``, with dT the temperature at ``t - lag`` less a
reference (Yin 2010, section 2.4 step 4). The corrected residual changes with the coefficients by ``-s dT``
and ``-s dT^2``, s being the column of the axis' scale factor, and with a change d of the lag by
``+d (linear s T' + quadratic s 2 dT T')``: columns of the temperature's rate whose coefficients are the lag's
change times the others. All of it is algebra of Gram matrices that hold these columns; to first order a
delay and a time constant are one. Where samples are at hand the columns are formed again at the lag found.

*Loops.* A parameter that lags behind the temperature, or follows it with play, has two values at one
temperature (Yin 2010, ch. 4). The area between the branches is its measure: 0 for any function of the
temperature alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import scipy
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import (
    NINE_PARAMETER_NAMES,
    NormalEquations,
    block_equations,
    concat_equations,
    nine_columns,
)
from inflight.effects import AXES, time_derivative
from inflight.errors import CalibrationError
from inflight.lsq import SOLVER_SETTINGS, ClusteredFit, jackknife, mean_of_clusters, solve_clusters
from inflight.time import GAP, SECOND, Int64


@dataclass(frozen=True, kw_only=True)
class TemperatureSettings:
    """How lags settle, rivals tie and loops are binned.

    Attributes
    ----------
    false_alarm : float
        Chance that a lag is reported of a temperature that nothing follows.
    passes : int
        Passes of the fit; assumed.
    settled : float
        Lags of samples are settled to this part of their sigma; assumed.
    formations : int
        Times at most that columns are formed at a new lag; assumed.
    tie : float
        A rival is no worse than the best while it is within so many sigmas of it: a level of 5 %.
    around : float
        Days on either side that determine whether the temperature rises; assumed.
    fewest_around : int
        The fewest of them; assumed.
    bins : int
        Bins of a loop; assumed.
    blocks : int
        Blocks of time of its jackknife; assumed.
    fewest_days : int
        Fewest days of a bin of a branch; assumed.
    fewest_bins : int
        Fewest bins that both branches fill; assumed.
    reach : tuple[float, float]
        Quantiles of the temperature that the bins reach to: branches do not overlap beyond; assumed.
    """

    false_alarm: float = 0.01
    passes: int = 12
    settled: float = 0.1
    formations: int = 8
    tie: float = 2.0
    around: float = 4.0
    fewest_around: int = 4
    bins: int = 8
    blocks: int = 20
    fewest_days: int = 3
    fewest_bins: int = 3
    reach: tuple[float, float] = (0.03, 0.97)


TEMPERATURE_SETTINGS = TemperatureSettings()


#: Kinds of columns of a temperature, three axes each: of the coefficients, then of their lag.
KINDS = ("linear", "quadratic", "rate", "quadratic_rate")

#: What is known beforehand of each: 1/K, 1/K^2, and of the lag, s.
PRIOR = (1e-4, 1e-6, 3600.0)

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

    def summary(self) -> str:
        """Return coefficients and lag as a sentence."""
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
            attrs={"channel": self.channel, "reference_degC": self.reference, "told": self.summary()},
        )


def coil_columns_of(key: str, kinds: Sequence[str] = KINDS) -> list[str]:
    """Return the names of a temperature's columns or coefficients: ``key.kind[axis]``."""
    return [f"{key}.{kind}[{axis}]" for kind in kinds for axis in AXES]


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
        degC; rows whose temperature a lag ago is not known, within gaps and beyond the ends, are NaN.
    lag : float
        s, where the columns are formed.
    reference : float
        degC.
    """
    known, delayed = np.flatnonzero(np.isfinite(temperature)), np.full(stamps.size, np.nan)
    if known.size >= 2:
        seconds = (stamps - stamps[0]) / SECOND
        base, at = seconds[known], seconds - lag
        apart = np.diff(base)
        after = np.clip(np.searchsorted(base, at), 1, base.size - 1)
        inside = (at >= base[0]) & (at <= base[-1]) & (apart[after - 1] <= GAP * np.median(apart))
        delayed[inside] = np.interp(at[inside], base, temperature[known])
    change = delayed - reference
    rate = time_derivative(change, stamps)
    parts = (-change, -(change**2), rate, 2.0 * change * rate)
    nine = nine_columns(field)
    scale_factors = [nine[name] for name in NINE_PARAMETER_NAMES[:3]]
    columns = [part * one for part in parts for one in scale_factors]
    return dict(zip(coil_columns_of(channel), columns, strict=True))


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
    each: Sequence[str] = NINE_PARAMETER_NAMES,
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
        Columns that are free in every block. The nine must be where they change from block to block; a
        temperature that only differs between blocks is then not determined, and its sigma shows it.
    prior : tuple of float
        What is known beforehand, see `PRIOR`. Without a temperature dependence there is no lag.

    Raises
    ------
    CalibrationError
        A column is missing, or there are too few blocks.
    """
    gram, count = residual_grams(equations, channel, each)
    return solve_coil(gram, count, channel, lag, reference, prior)


def residual_grams(equations: NormalEquations, channel: str, each: Sequence[str]) -> tuple[Floats, Floats]:
    """Return [12 columns | residual] of the blocks less what their own columns explain, physical units."""
    common = equations.at_one_reference().select([*coil_columns_of(channel), *each])
    rest = common.marginalise(each, cut=SOLVER_SETTINGS.weak_cut, least_kept=0.0) if each else common
    return rest.in_units, rest.count


def coefficients_of(value: Floats) -> tuple[Floats, Floats]:
    """Return the 12 coefficients of 7 unknowns (linear, quadratic, change of lag), and (12, 7) slopes."""
    linear, quadratic, change = value[:3], value[3:_LAG], value[_LAG]
    found = np.concatenate([value[:_LAG], change * linear, change * quadratic])
    slopes = np.zeros((12, 7))
    slopes[:_LAG, :_LAG] = np.eye(_LAG)
    slopes[_LAG:, :_LAG] = change * np.eye(_LAG)
    slopes[_LAG:, _LAG] = value[:_LAG]
    return found, slopes


def solve_coil(
    gram: Floats,
    count: Floats,
    channel: str,
    lag: float,
    reference: float,
    prior: tuple[float, float, float],
) -> CoilFit:
    """Gauss-Newton on the unknowns, with a prior of 0 for the coefficients and for the change of the lag."""
    sigma = np.repeat(prior, [3, 3, 1])
    # The first pass keeps the lag.
    basis = np.zeros((13, 7))
    basis[:_LAG, :_LAG], basis[-1, -1] = np.eye(_LAG), -1.0
    value = np.append(solve_clusters(basis.T @ gram @ basis, count, sigma[:_LAG]).value, 0.0)
    for _ in range(TEMPERATURE_SETTINGS.passes):
        # Linear about the values. The solution is the unknowns themselves, not a change of them, so that
        # a prior holds them at 0.
        coefficients, slopes = coefficients_of(value)
        basis = np.zeros((13, 8))
        basis[:-1, :-1], basis[:-1, -1], basis[-1, -1] = slopes, slopes @ value - coefficients, -1.0
        fit = solve_clusters(np.asarray(basis.T @ gram @ basis), count, sigma)
        change, value = fit.value - value, fit.value
        if np.all(np.abs(change) <= 1e-3 * fit.sigma):
            break
    whole = value + np.append(np.zeros(_LAG), lag)
    determined = fit.determined & (fit.sigma < 0.5 * sigma)
    determined[_LAG] &= _follows_temperature(gram, value, fit)
    return CoilFit(
        channel,
        reference,
        ClusteredFit(whole, fit.covariance, fit.retained, determined, fit.variance, fit.clusters, fit.rows),
    )


def _follows_temperature(gram: Floats, value: Floats, fit: ClusteredFit) -> bool:
    """Return whether any axis follows the temperature beyond chance: else its lag is that of noise.

    What counts is ``linear + r quadratic``, r being the slope of dT^2 on dT in the data: with a reference off
    the temperatures neither of the two is determined by itself.
    """
    total = gram.sum(axis=0)
    weights = np.zeros((3, 7))
    for axis in range(3):
        weights[axis, [axis, axis + 3]] = 1.0, total[axis, axis + 3] / max(total[axis, axis], 1e-300)
    sigma = np.sqrt(np.diag(weights @ fit.covariance @ weights.T))
    chance = 2.0 * scipy.stats.t.sf(np.abs(weights @ value) / np.maximum(sigma, 1e-300), fit.clusters - 1)
    return bool(3.0 * chance.min() < TEMPERATURE_SETTINGS.false_alarm)


def fit_coil_samples(
    blocks: Sequence[CoilBlock],
    channel: str,
    *,
    lag: float = 0.0,
    reference: float = 20.0,
    each: Sequence[str] = NINE_PARAMETER_NAMES,
    prior: tuple[float, float, float] = PRIOR,
) -> CoilFit:
    """Fit one temperature to samples: columns are formed anew at each lag, until it settles.

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
    for _ in range(TEMPERATURE_SETTINGS.formations):
        equations = []
        for block in blocks:
            own = replace(block, temperature={channel: block.temperature[channel]})
            with suppress(CalibrationError):
                equations.append(coil_equations(own, {channel: at}, reference))
        fit = fit_coil(
            concat_equations(equations), channel, lag=at, reference=reference, each=each, prior=prior
        )
        change = fit.lag[0] - at
        if not fit.fit.determined[_LAG] or abs(change) <= TEMPERATURE_SETTINGS.settled * fit.lag[1]:
            return fit
        at = fit.lag[0]
    raise CalibrationError(
        f"the lag of '{channel}' does not settle: {at:.0f} s after {TEMPERATURE_SETTINGS.formations} turns",
        remedy="start nearer to it, or take a longer span",
    )


@dataclass(frozen=True)
class TemperatureRival:
    """A temperature judged on blocks that were not fitted; `score` is the rms left, nT."""

    channel: str
    score: float
    behind: float
    behind_sigma: float

    @property
    def ties(self) -> bool:
        """True when held-out blocks do not separate it from the best."""
        return self.behind <= TEMPERATURE_SETTINGS.tie * self.behind_sigma


@dataclass(frozen=True)
class TemperatureChoice:
    """Temperatures, and none, on held-out blocks; the best first."""

    rivals: tuple[TemperatureRival, ...]

    @classmethod
    def of_table(cls, table: xr.Dataset) -> TemperatureChoice:
        """Return the choice that a table was made of."""
        rows = zip(
            *(table[name].values.tolist() for name in ("channel", "value", "behind", "sigma")), strict=True
        )
        return cls(tuple(TemperatureRival(*row) for row in rows))

    @classmethod
    def of_squares(cls, squares: Mapping[str, Floats], count: Floats) -> TemperatureChoice:
        """Return the choice by held-out mean squares of each rival, (block,) nT^2, `count` rows each."""
        mean = {name: float(np.average(one, weights=count)) for name, one in squares.items()}
        best, block, rivals = min(mean, key=lambda name: mean[name]), np.arange(len(count)), []
        for name in sorted(mean, key=lambda name: mean[name]):
            behind, sigma = mean_of_clusters(squares[name] - squares[best], count, block)
            rivals.append(TemperatureRival(name, float(np.sqrt(mean[name])), behind, sigma))
        return cls(tuple(rivals))

    def summary(self) -> str:
        """Return which rival is best, and which are tied with it, as a sentence."""
        best, *others = self.rivals
        ties = [one.channel for one in others if one.ties]
        worse = [
            f"{one.channel} ({one.behind / one.behind_sigma:.1f} sigma)" for one in others if not one.ties
        ]
        text = f"{best.channel} leaves least of held-out blocks"
        text += f"; tied with it: {', '.join(ties)}" if ties else ""
        return text + (f"; worse: {', '.join(worse)}" if worse else "")

    def table(self) -> xr.Dataset:
        """Return the scores: dim channel."""
        rows = self.rivals
        return xr.Dataset(
            {
                "value": ("channel", np.array([one.score for one in rows]), {"units": "nT"}),
                "behind": ("channel", np.array([one.behind for one in rows]), {"units": "nT2"}),
                "sigma": ("channel", np.array([one.behind_sigma for one in rows]), {"units": "nT2"}),
                "tied": ("channel", np.array([one.ties for one in rows])),
            },
            coords={"channel": [one.channel for one in rows]},
            attrs={"told": self.summary()},
        )


#: The rival that has no temperature at all.
NONE = "none"


def compare_temperatures(
    equations: NormalEquations,
    channels: Sequence[str],
    *,
    folds: int = 5,
    each: Sequence[str] = NINE_PARAMETER_NAMES,
    prior: tuple[float, float, float] = PRIOR,
) -> TemperatureChoice:
    """Judge temperatures, and none, by what they leave of contiguous blocks that were not fitted.

    Parameters
    ----------
    equations : NormalEquations
        With the columns of every channel, each at a lag of its own.
    channels : sequence of str
    folds : int
        Contiguous parts of the span.
    each, prior
        As for `fit_coil`; the columns of `each` are fitted in held-out blocks too, alike for all rivals.

    Raises
    ------
    CalibrationError
        When training blocks are fewer than five.
    """
    squares: dict[str, Floats] = {}
    for channel in channels:
        gram, rows = residual_grams(equations, channel, each)
        squares.setdefault(NONE, gram[:, -1, -1] / rows)
        squares[channel] = _held_out(gram, rows, channel, folds, prior) / rows
    return TemperatureChoice.of_squares(squares, equations.count)


def _held_out(
    gram: Floats, count: Floats, channel: str, folds: int, prior: tuple[float, float, float]
) -> Floats:
    """Return the sum of squares of each block at the fit of the other folds; (block,) nT^2."""
    out = np.empty(len(gram))
    for part in np.array_split(np.arange(len(gram)), folds):
        rest = np.delete(np.arange(len(gram)), part)
        fit = solve_coil(gram[rest], count[rest], channel, 0.0, 0.0, prior).fit
        at = np.append(coefficients_of(fit.value)[0], 1.0)
        out[part] = np.einsum("i,bij,j->b", at, gram[part], at)
    return out


@dataclass(frozen=True)
class HysteresisLoop:
    """Means of a parameter in bins of temperature on both branches.

    Attributes
    ----------
    centre : ndarray, shape (bin,)
        Middle of the bins, degC.
    rising, falling : ndarray, shape (bin,)
        Mean value of each branch, moved to the middle of the bin; NaN where it has too few days.
    sigma_rising, sigma_falling : ndarray, shape (bin,)
    area, sigma : float
        Integral of (rising - falling) over the temperature, unit of the parameter times K; its standard
        deviation from a jackknife over blocks of time.
    correlation : float
        Of the parameter with the temperature.
    days : tuple of int
        On the rising and on the falling branch.
    unit : str
    """

    centre: Floats
    rising: Floats
    falling: Floats
    sigma_rising: Floats
    sigma_falling: Floats
    area: float
    sigma: float
    correlation: float
    days: tuple[int, int]
    unit: str

    @property
    def is_open(self) -> bool:
        """True when the area is three sigma."""
        return abs(self.area) > 3.0 * self.sigma

    def table(self) -> xr.Dataset:
        """Return the area, and the branches along bin."""
        branch = ("bin", "branch")
        return xr.Dataset(
            {
                "value": ("parameter", np.array([self.area])),
                "sigma": ("parameter", np.array([self.sigma])),
                "units": ("parameter", np.array([f"{self.unit} K"])),
                "mean": (branch, np.stack([self.rising, self.falling], axis=1)),
                "sigma_mean": (branch, np.stack([self.sigma_rising, self.sigma_falling], axis=1)),
                "temperature": ("bin", self.centre, {"units": "degC"}),
            },
            coords={"parameter": ["loop_area"], "branch": ["rising", "falling"]},
            attrs={"correlation": self.correlation},
        )


def rate_of(mjd: Floats, temperature: Floats) -> Floats:
    """Return the slope of the temperature around each day, K/d; NaN where too few days are near (day,)."""
    known = np.isfinite(temperature)
    low = np.searchsorted(mjd, mjd - TEMPERATURE_SETTINGS.around)
    high = np.searchsorted(mjd, mjd + TEMPERATURE_SETTINGS.around, side="right")
    sums = {}
    away = np.where(known, mjd - mjd[0], 0.0)
    warm = np.where(known, temperature - np.nanmean(temperature), 0.0)
    for name, series in {"1": known * 1.0, "t": away, "T": warm, "tt": away**2, "tT": away * warm}.items():
        total = np.concatenate([[0.0], np.cumsum(series)])
        sums[name] = total[high] - total[low]
    count = np.maximum(sums["1"], 1.0)
    spread = sums["tt"] - sums["t"] ** 2 / count
    shared = sums["tT"] - sums["t"] * sums["T"] / count
    slope = np.divide(shared, spread, out=np.full_like(spread, np.nan), where=spread > 1e-6)
    return np.where(sums["1"] >= TEMPERATURE_SETTINGS.fewest_around, slope, np.nan)


def hysteresis_loop(mjd: Floats, temperature: Floats, value: Floats, unit: str = "") -> HysteresisLoop:
    """Return the loop of a daily parameter against temperature.

    A parabola of the temperature is subtracted before bins are made, and added at their middles: days of
    the two branches lie differently within a bin.

    Parameters
    ----------
    mjd, temperature, value : ndarray, shape (day,)
        Middles of days (rising), their mean temperature (degC) and the parameter; NaN in gaps.

    Raises
    ------
    CalibrationError
        When the branches share fewer than three bins.
    """
    rate = rate_of(mjd, temperature)
    use = np.isfinite(rate) & np.isfinite(value) & np.isfinite(temperature) & (rate != 0)
    if use.sum() < 2 * TEMPERATURE_SETTINGS.fewest_bins * TEMPERATURE_SETTINGS.fewest_days:
        raise CalibrationError(f"{int(use.sum())} days make no loop", remedy="use a longer span")
    warm, up = temperature[use], rate[use] > 0
    curve = np.polynomial.Polynomial.fit(warm, value[use], 2)
    low, high = (float(edge) for edge in np.quantile(warm, TEMPERATURE_SETTINGS.reach))
    edges = np.linspace(low, high, TEMPERATURE_SETTINGS.bins + 1)
    # Counts and sums in cells of (block of time, rising bins then falling bins).
    place, blocks, cells = (
        np.digitize(warm, edges) - 1,
        TEMPERATURE_SETTINGS.blocks,
        2 * TEMPERATURE_SETTINGS.bins,
    )
    inside = (place >= 0) & (place < TEMPERATURE_SETTINGS.bins)
    cell = (
        np.where(up, place, place + TEMPERATURE_SETTINGS.bins)
        + np.arange(warm.size) * blocks // warm.size * cells
    )
    count, total = (
        np.bincount(cell[inside], weights=weights, minlength=blocks * cells).reshape(blocks, cells)
        for weights in (np.ones(int(inside.sum())), (value[use] - curve(warm))[inside])
    )
    enough = count.sum(axis=0) >= TEMPERATURE_SETTINGS.fewest_days
    common = enough.reshape(2, TEMPERATURE_SETTINGS.bins).all(axis=0)
    if common.sum() < TEMPERATURE_SETTINGS.fewest_bins:
        raise CalibrationError(
            f"rising and falling temperature share {int(common.sum())} bins of {TEMPERATURE_SETTINGS.bins}",
            remedy="use a span with whole cycles of temperature",
        )
    mean = _means(total.sum(axis=0), count.sum(axis=0))
    without = _means(total.sum(axis=0) - total, count.sum(axis=0) - count)
    width, centre = (high - low) / TEMPERATURE_SETTINGS.bins, 0.5 * (edges[1:] + edges[:-1])
    sigma = np.where(enough, jackknife(without), np.nan)
    shown = np.where(enough, mean, np.nan)
    return HysteresisLoop(
        centre,
        shown[: TEMPERATURE_SETTINGS.bins] + curve(centre),
        shown[TEMPERATURE_SETTINGS.bins :] + curve(centre),
        sigma[: TEMPERATURE_SETTINGS.bins],
        sigma[TEMPERATURE_SETTINGS.bins :],
        float(_area(mean[None], common, width)[0]),
        float(jackknife(_area(without, common, width)[:, None])[0]),
        float(np.corrcoef(warm, value[use])[0, 1]),
        (int(up.sum()), int((~up).sum())),
        unit,
    )


def _means(total: Floats, count: Floats) -> Floats:
    return np.asarray(total / np.maximum(count, 1.0))


def _area(means: Floats, common: np.ndarray, width: float) -> Floats:
    """Return the areas of loops (loop, branch * bin) over the bins that both branches have; (loop,)."""
    apart = means[:, : TEMPERATURE_SETTINGS.bins] - means[:, TEMPERATURE_SETTINGS.bins :]
    return np.asarray(apart[:, common].sum(axis=1) * width)
