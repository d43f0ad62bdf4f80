"""What noise of a channel or the field does to values of effects that follow it: errors in variables.

Takes the last state of a search and the coarse series; makes estimates without the attenuation
(`without_attenuation`), and what the noise would do at a faster cadence.

A column is made of readings c = c0 + e, and noise of them is noise of the column: X = X0 + D, with D the same
operator (a rate, a response, a product) of e. Least squares of y = -X0 b then has, for noise that is
independent of everything else,

    E[X'X] = X0'X0 + v N,    E[X'y] = -X0'X0 b,    so that    b_ls = (G - v N) b / G = (1 - v M) b,

with G = X'X, v the variance of e, v N = E[D'D] and M = inv(G) N: values are too small. The moment-corrected
estimate inv(1 - v M) b_ls is consistent (Fuller, Measurement Error Models, 1987, section 2.2). N comes from
the columns of one draw of noise, for any operator (as in simulation extrapolation, Cook and Stefanski 1994).

*The clock.* Its column is dF/dt by differences of fourth order, (8 (F(+1) - F(-1)) - (F(+2) - F(-2))) / 12 h:
noise of variance v in each reading makes 130/144 v/h^2 of it. Of a field that swings by 800 nT in six hours,
(dF/dt)^2 is 0.0271 (nT/s)^2; read every 10 s with noise of 0.3 nT it seems 0.0279, and a shift of -7 s comes
out as -7 x 0.0271 / 0.0279 = -6.80 s. Noise is also in the residual, but a central difference has no weight
on its own sample: it adds nothing to X'y.

*How large the noise is.* Two instruments read the field. The residual r holds the noise of the vector sensor,
the other's, and nothing of the field: in fourth differences, which leave nothing slow, the covariance of |B|
and r is 70 times the variance of the noise of |B|, whatever the field does. A channel is read once. Its own
fourth differences bound its noise, by their median: steps in it are few, but what really fluctuates from row
to row looks like noise. What tells them apart is the residual, again. Where noise is in a column, the effect
it would have, X b, is in the residual where the channel itself is quick: with z the column of the channel's
fourth differences times b,

    E[z'r] = v b'(E[Z'D] / v - Z'X M) b,

while an effect that truly follows what is quick leaves nothing there. Between nothing and the bound the
variance is known as well as that says, else as the mean of both. What is not known of it is in the errors.

*Whether it is white.* Noise that is independent from row to row takes far less off in means of three rows: of
a rate an eighth. Freed values of rows and of means then agree. Where they do not, what looks like noise is
something else (instruments that average the field differently), the values stay as they are, and are told to
be no better known than means of rows say.

*One value, whatever the cadence of the search.* Values that are told are those of the samples' own rows,
freed of what noise among these takes off (`of_samples`): the search's bins decide what is there, not how
large it is. A rate in bins of 10 s is a difference of means, and too small for what is quicker: values made
from it are too large. Columns made from samples and then averaged have no such error. In means of three and
ten samples they give the same values, but for chance, which blocks tell: both are fitted to the same data,
and the scatter of their difference is that of what each block moves it by. Errors reach as far as values that
differ by more than that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.design import Term, design_matrix
from inflight.diagnosis.refine import LAG_SETTINGS, FormTrials, can_add_columns, peak_of, term_at_lag
from inflight.diagnosis.residual import DiagnosisData, Native, derived_channels, remaining_residual
from inflight.diagnosis.scoring import Index
from inflight.diagnosis.search import Option, Search
from inflight.diagnosis.series import Series
from inflight.diagnosis.stepwise import (
    SELECTION_SETTINGS,
    BlockwiseFit,
    Estimate,
    estimate,
    estimate_in,
)
from inflight.diagnosis.wide_bins import Means, gram_of_means, has_means, mean_columns
from inflight.frames import GEOMETRY
from inflight.lsq import MAD_TO_SIGMA, GramBlocks, bartlett_covariance, solve_scaled
from inflight.samples import parse_channel, slow_response
from inflight.time import SECOND

#: Weights of a fourth difference, and the sum of their squares: what white noise becomes in it.
_FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
_GAIN = float(_FOURTH @ _FOURTH)
_FIELD = "field"

#: Lags that are compared.
_LAGS = 9


@dataclass(frozen=True, kw_only=True)
class AttenuationSettings:
    """When noise of what an effect follows matters.

    Attributes
    ----------
    least : float
        A value moves when it does so by this part of its sigma; assumed.
    most : float
        Part of a column's square that may be noise: of more, what is taken off is but a bound; assumed.
    native : float
        An estimate from the samples themselves stands where noise moves it by no more of its sigmas; assumed.
    times, agree : int, float
        Freed values in means of so many rows differ from those of the rows by no more of their sigmas.
    known : float
        The variance is known by the residual when it is so many of its sigmas from nothing.
    seed : int
        Of the noise that is drawn.
    own_times : tuple of int
        Samples of the means whose values are held against those of the samples.
    own_apart : float
        They differ when they do so by more than so many sigmas of the difference.
    own_rows : int
        Means for every column at least: fewer say nothing; assumed.
    """

    least: float = 0.1
    most: float = 0.5
    native: float = 0.5
    times: int = 3
    agree: float = 2.0
    known: float = 3.0
    seed: int = 0
    own_times: tuple[int, ...] = (3, 10)
    own_apart: float = 3.0
    own_rows: int = 20


ATTENUATION_SETTINGS = AttenuationSettings()


class Variance(NamedTuple):
    """Variance of a row's noise, and its standard deviation; units of what is read, squared."""

    value: float
    sigma: float


@dataclass(frozen=True, kw_only=True)
class Freed:
    """An effect's estimate without the attenuation.

    Attributes
    ----------
    estimate : Estimate
    part : float
        Largest part of a value that the noise took.
    source : str
        What is noisy: a channel, or ``field``.
    variance : Variance
        Of its noise.
    at_native : float
        By how many of its sigmas noise moves a value of the estimate from the samples themselves, were it
        white among them: the faster they are, the more noise a rate has.
    taken : bool
        Noise was taken off the values; else they are as they were, and what it may do is in their errors.
    lag_error_s : float
        By how much noise moves the lag that leaves least, s: a slower response has less of it.
    """

    estimate: Estimate
    part: float
    source: str
    variance: Variance
    at_native: float = 0.0
    taken: bool = True
    lag_error_s: float = 0.0


def without_attenuation(
    search: Search, data: DiagnosisData, native: Native | None = None
) -> dict[str, Freed]:
    """Return estimates without the attenuation by noise, by the names of effects it matters for.

    Parameters
    ----------
    native : Native, optional
        What was taken at the samples' own cadence.
    """
    series = data.series
    if series.row_filter is not None or not can_add_columns(search, data):
        return {}
    wide: _Wide | None = None
    drawn = _drawn_columns(search, data)
    if drawn is None:
        return {}
    residual: Floats | None = None
    out: dict[str, Freed] = {}
    for source in drawn.sources:
        bound = drawn.bound(source)
        # Most channels have so little noise that the most there can be does not matter.
        if not bound > 0 or not _freed(drawn, source, Variance(bound, 0.0), native):
            continue
        wide = wide or _Wide.of(drawn)
        residual = remaining_residual(search, data) if residual is None else residual
        variance = drawn.of_field(residual) if source == _FIELD else drawn.of_channel(source, bound, residual)
        for name, freed in _freed(drawn, source, variance, native, wide).items():
            option = next(one for one in search.accepted if one.name == name)
            freed = replace(freed, lag_error_s=_lag_error(drawn, option, source, variance))  # noqa: PLW2901
            # Of two noisy factors the one that takes more is told.
            if name not in out or freed.part > out[name].part:
                out[name] = freed
    return out


def _drawn_columns(search: Search, data: DiagnosisData) -> _Columns | None:
    """Return the columns of what was taken, to be drawn with noise; None without any.

    Changes that are functions of the block have the columns of what changes; only whole terms are drawn.
    """
    known = {term.key for term in search.library.all_terms}
    keys = dict.fromkeys(key for one in search.accepted for key in one.terms if key in known)
    return _Columns(search, data, [search.library.by_key[key] for key in keys]) if keys else None


def _freed(
    drawn: _Columns,
    source: str,
    variance: Variance,
    native: Native | None,
    wide: _Wide | None = None,
) -> dict[str, Freed]:
    """Return the effects whose values noise of a source moves, without what it does."""
    out, search, settings = {}, drawn.search, ATTENUATION_SETTINGS
    square = drawn.products(source)
    here, there, slow = _moments(search, drawn, square, variance), None, None
    if wide is not None:
        slow = _moments(search, drawn, wide.products(drawn, source), variance, wide.grams)
    if native is not None:
        own, cadence_s = native.search, native.cadence_s
        times = drawn.data.series.step_s / cadence_s
        rows = float(own.raw.count.sum()) / max(float(search.raw.count.sum()), 1.0)
        faster = Variance(variance.value * times, 0.0)
        there = _moments(own, drawn, drawn.products(source, cadence_s) * rows, faster)
    for option in search.accepted:
        if not set(option.columns) <= set(drawn.names) or not square[drawn.places(option.columns)].any():
            continue
        found = estimate(search, option)
        at_native = 0.0
        if native is not None and there is not None:
            told = estimate(native.search, option)
            off = np.abs(there.of(option).value - told.value)
            at_native = float(np.max(off / np.maximum(told.sigma, 1e-300)))
        freed, taken = here.of(option), not here.is_bound
        change = np.abs(freed.value - found.value)
        freed = freed if taken else found.with_error(change)
        if slow is not None and np.any(
            np.abs(freed.value - (apart := slow.of(option)).value) > settings.agree * apart.sigma
        ):
            freed = found.with_error(np.hypot(apart.value - found.value, apart.sigma))
            change, taken = np.abs(apart.value - found.value), False
        if np.any(change > settings.least * found.sigma) or at_native > settings.least:
            part = float(np.max(change / np.maximum(np.abs(freed.value), 1e-300)))
            out[option.name] = Freed(
                estimate=freed,
                part=part,
                source=source,
                variance=variance,
                at_native=at_native,
                taken=taken,
            )
    return out


class Told(NamedTuple):
    """Values that are told of an effect, and what noise took off them."""

    estimate: Estimate
    freed: Freed | None = None


def of_samples(search: Search, data: DiagnosisData, freed: Mapping[str, Freed]) -> dict[str, Told]:
    """Return values by the names of effects, with what they depend on the width of bins in their errors.

    Parameters
    ----------
    search : Search
        What was taken, on Gram blocks of the samples.
    data : DiagnosisData
        Of the samples: its series has them all.
    freed : mapping of str to Freed
        Estimates of the samples without what noise takes off them.
    """
    settings = ATTENUATION_SETTINGS
    out = {
        one.name: Told(free.estimate, free)
        if (free := freed.get(one.name)) is not None
        else Told(estimate(search, one))
        for one in search.accepted
    }
    if not search.accepted or not has_means(search, data):
        return out
    means = [Means.of(data.series, times) for times in settings.own_times]
    scales, columns = mean_columns(search, data, search.accepted, means)
    noisy = {one.name: freed[one.name] for one in search.accepted if one.name in freed}
    noisy = {name: one for name, one in noisy.items() if one.taken}
    drawn = _drawn_columns(search, data) if noisy else None
    # The variance is that of the source, whichever effect it matters for.
    variances = {one.source: one.variance for one in noisy.values()}
    raw = search.forms["raw"]
    rows_fit = _fit_of(search, raw)
    rows_gain = _gains(search, drawn, variances) if drawn is not None else {}
    for mean, some in zip(means, columns, strict=True):
        if int((mean.weight > 0).sum()) < settings.own_rows * len(scales):
            continue
        wide = _Wide(mean, gram_of_means(search, data, "raw", mean, scales, some))
        means_fit = _fit_of(search, wide.grams)
        means_gain = _gains(search, drawn, variances, wide) if drawn is not None else {}
        for option in search.accepted:
            source = noisy[option.name].source if option.name in noisy else ""
            value, moved = _influences(search, option, raw, rows_fit, rows_gain.get(source))
            other, moved_too = _influences(search, option, wide.grams, means_fit, means_gain.get(source))
            scatter = np.diag(bartlett_covariance(moved - moved_too, SELECTION_SETTINGS.bartlett))
            away = np.abs(value - other)
            beyond = away > settings.own_apart * np.sqrt(np.clip(scatter, 0.0, None))
            told = out[option.name].estimate
            reached = replace(told, value=told.value + np.where(beyond, away, 0.0))
            out[option.name] = out[option.name]._replace(estimate=told.covering(reached))
    return out


def _gains(
    search: Search, drawn: _Columns, variances: Mapping[str, Variance], wide: _Wide | None = None
) -> dict[str, Floats]:
    """Return what frees the model's values, in rows or in their means, of the noise of each source."""
    out: dict[str, Floats] = {}
    for source, variance in variances.items():
        square = drawn.products(source) if wide is None else wide.products(drawn, source)
        out[source] = _moments(search, drawn, square, variance, wide.grams if wide else None).gain
    return out


def _fit_of(search: Search, grams: GramBlocks) -> BlockwiseFit:
    """Return the fit of everything in the model to the residual of the search."""
    return BlockwiseFit.of(grams, search.present_in(grams), grams.residuals[search.residual])


def _influences(
    search: Search, option: Option, grams: GramBlocks, fit: BlockwiseFit, gain: Floats | None
) -> tuple[Floats, Floats]:
    """Return values of an effect and what each block moves them by; (column,), (block, column), physical.

    Parameters
    ----------
    fit : BlockwiseFit
        Of the model's columns in these Gram blocks.
    gain : ndarray, shape (column, column), optional
        What frees the model's values of the attenuation.
    """
    present = search.present_in(grams)
    value, moved = fit.value, fit.moved
    if gain is not None:
        value, moved = gain @ value, moved @ gain.T
    columns = grams.index(option.columns)
    own = np.array([int(np.flatnonzero(present.columns == column)[0]) for column in columns])
    return value[own] * grams.scale[columns], moved[:, own] * grams.scale[columns]


@dataclass(frozen=True, kw_only=True)
class _Moments:
    """The model's values without the attenuation; scaled units.

    Attributes
    ----------
    value, slope : ndarray, shape (column,)
        And their change with the variance.
    gain : ndarray, shape (column, column)
        What frees them.
    is_bound : bool
        There is more noise than moments can take off: what they take off is no more than a part of it.
    """

    search: Search
    grams: GramBlocks
    variance: Variance
    value: Floats
    slope: Floats
    gain: Floats
    is_bound: bool = False

    def of(self, option: Option) -> Estimate:
        """Return the estimate of an effect."""
        found, grams = estimate_in(self.search, option, self.grams), self.grams
        columns, present = grams.index(option.columns), self.search.present_in(grams).columns
        own = np.array([int(np.flatnonzero(present == column)[0]) for column in columns])
        scale = grams.scale[columns]
        inner = self.gain[np.ix_(own, own)] * scale[:, None] / scale[None, :]
        covariance = inner @ found.covariance @ inner.T
        sigma = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
        made = replace(found, value=self.value[own] * scale, covariance=covariance, sigma=sigma)
        return made.with_error(np.abs(self.slope[own] * scale) * self.variance.sigma)


def _moments(
    search: Search,
    drawn: _Columns,
    square: Floats,
    variance: Variance,
    grams: GramBlocks | None = None,
) -> _Moments:
    """Return the model's values without the attenuation.

    Parameters
    ----------
    square : ndarray, shape (drawn column, drawn column)
        Products of the columns of noise of unit variance.
    grams : GramBlocks, optional
        Of the model's columns; the raw form of the search when absent.
    """
    grams = search.forms["raw"] if grams is None else grams
    present, y = search.present_in(grams), grams.residuals[search.residual]
    total = grams.rows(present.columns, np.append(present.columns, y)).sum(axis=0)
    gram = total[:, :-1] + np.diag(present.precision)
    names = [grams.names[place] for place in present.columns]
    own = [place for place, name in enumerate(names) if name in drawn.names]
    at = drawn.places([names[place] for place in own])
    noise = np.zeros_like(gram)
    noise[np.ix_(own, own)] = square[np.ix_(at, at)]
    part = solve_scaled(gram, noise)
    largest = float(np.max(np.linalg.eigvals(part).real, initial=0.0)) * variance.value
    too_much = largest > ATTENUATION_SETTINGS.most
    taken = variance.value * (ATTENUATION_SETTINGS.most / largest if too_much else 1.0)
    gain = np.asarray(np.linalg.inv(np.eye(len(part)) - taken * part), dtype=np.float64)
    value = gain @ -solve_scaled(gram, total[:, -1])
    return _Moments(
        search=search,
        grams=grams,
        variance=variance,
        value=value,
        slope=gain @ part @ value,
        gain=gain,
        is_bound=too_much,
    )


@dataclass(frozen=True)
class _Wide:
    """Means of rows, and the Gram blocks of the model's columns in them."""

    mean: Means
    grams: GramBlocks

    @classmethod
    def of(cls, drawn: _Columns) -> _Wide | None:
        """Return those of the rows that columns are drawn on; None where the series has no means."""
        search, data = drawn.search, drawn.data
        if not has_means(search, data):
            return None
        mean = Means.of(data.series, ATTENUATION_SETTINGS.times)
        scales, (columns,) = mean_columns(search, data, search.accepted, [mean])
        return cls(mean, gram_of_means(search, data, "raw", mean, scales, columns))

    def products(self, drawn: _Columns, source: str) -> Floats:
        """Return products of the means of columns of noise of unit variance; (column, column)."""
        noise = drawn.of_noise(source)
        means = self.mean(noise.reshape(len(drawn.weight), -1, noise.shape[1]))
        flat = (means * np.sqrt(self.mean.weight)[:, None, None]).reshape(-1, noise.shape[1])
        return np.asarray(flat.T @ flat)


def _lag_error(drawn: _Columns, option: Option, source: str, variance: Variance) -> float:
    """Return by how much noise moves the lag that explains most, s; 0 of an effect without a lag of its own.

    Of a response the noise is less the slower it is. What each lag explains is taken without it.
    """
    search, data = drawn.search, drawn.data
    plain = len(option.terms) == 1 and option.change is None and option.lag_s > 0
    if not plain or source == _FIELD or option.channels != (source,):
        return 0.0
    term = search.library.by_key[option.terms[0]]
    trials = FormTrials(search, data, option)
    own = drawn.places(option.columns)
    square = drawn.products(source)[np.ix_(own, own)] * variance.value
    noise, step = drawn.noise(source, 1.0, data.series)[:, 0], data.series.step_s
    usual = float(np.var(slow_response(noise, step, option.lag_s)))
    lags = option.lag_s * np.geomspace(1.0 / LAG_SETTINGS.around, LAG_SETTINGS.around, _LAGS)
    found = []
    for place, lag in enumerate(lags):
        columns = trials.columns(term_at_lag(data, term, f"noise {place}", float(lag)))
        part = float(np.var(slow_response(noise, step, float(lag)))) / usual
        gram, right = columns @ columns.T, columns @ trials.rest
        found.append([float(right @ solve_scaled(gram - some, right)) for some in (0.0, square * part)])
    plain_best, best = (peak_of(np.log(lags), one) for one in np.array(found).T)
    return float(option.lag_s * abs(np.exp(best - plain_best) - 1.0))


class _Columns:
    """Columns of some terms on the series, as they are and of noise that is drawn; (row, column)."""

    def __init__(self, search: Search, data: DiagnosisData, terms: Sequence[Term]) -> None:
        self.search, self.data, self.terms = search, data, terms
        self.names = [name for term in terms for name in term.columns]
        self.weight = data.series["weight"]
        self.channels = {name for term in terms for name in term.channels}
        self.plain = self._made(data.series)
        self._products: dict[tuple[str, float], Floats] = {}

    @property
    def sources(self) -> list[str]:
        """What may be noisy: the field, in a comparison with a scalar sensor, and recorded channels."""
        names = {part.channel for name in self.channels for part in parse_channel(name).parts}
        recorded = sorted(name for name in names - set(GEOMETRY) if name in self.data.series.channels)
        scalar = self.data.mission.comparisons[self.data.model.comparison].kind == "scalar"
        return [_FIELD, *recorded] if scalar else recorded

    def places(self, names: Sequence[str]) -> Index:
        """Return the places of columns."""
        return np.array([self.names.index(name) for name in names], dtype=np.int64)

    def _made(self, series: Series, more: Mapping[str, xr.Variable] | None = None) -> Floats:
        derived = derived_channels(series, self.channels)
        found = design_matrix(self.terms, series.rows(self.data.sensor_matrices, {**derived, **(more or {})}))
        return np.asarray(found.reshape(-1, found.shape[2]))

    def _with(self, source: str, added: Floats, series: Series) -> Floats:
        """Return by how much the columns change when something is added to a source; (row, column)."""
        plain = self.plain if series is self.data.series else self._made(series)
        if source == _FIELD:
            # A missing reading is stored as 0: its rate would be enormous.
            there = np.where((series["weight"] > 0)[:, None], series[_FIELD], np.nan)
            field = xr.Variable(("time", "axis"), there + added, {"units": "nT"})
            made = self._made(series, {_FIELD: field})
        else:
            values = series.values.copy(order="K")
            values[:, series.features.place(source)] += added.astype(values.dtype)
            made = self._made(replace(series, values=values))
        # In place: of a long record each such array is hundreds of megabytes.
        made -= plain
        return made

    def noise(self, source: str, size: float, series: Series) -> Floats:
        """Return noise of a source; straight between the readings of a slow channel."""
        shape = series[source].reshape(len(series.tt2000), -1).shape
        rng = np.random.default_rng(ATTENUATION_SETTINGS.seed)
        every = spacing_of(self.data, source)
        drawn = rng.normal(0.0, size, (-(-shape[0] // every) + 1, shape[1]))
        if every > 1:
            at, knots = np.arange(shape[0]), every * np.arange(len(drawn))
            drawn = np.stack([np.interp(at, knots, column) for column in drawn.T], axis=1)
        return np.asarray(drawn[: shape[0]])

    def products(self, source: str, cadence_s: float = 0.0) -> Floats:
        """Return products of the columns of noise of unit variance, N; (column, column).

        At another cadence (s) the rows are as many, closer in time: those of the series that is there.
        """
        if (source, cadence_s) not in self._products:
            series = self.data.series
            if cadence_s:
                begin = series.tt2000[0]
                since = (series.tt2000 - begin) * (cadence_s / series.step_s)
                series = replace(series, tt2000=begin + np.rint(since).astype(np.int64))
            noise = self.of_noise(source, series)
            self._products[source, cadence_s] = (noise * self._row_weight[:, None]).T @ noise
        return self._products[source, cadence_s]

    def of_noise(self, source: str, series: Series | None = None) -> Floats:
        """Return columns of noise of unit variance of a source; (row, column)."""
        series, size = series or self.data.series, np.sqrt(max(self.bound(source), 1e-300))
        found = self._with(source, self.noise(source, size, series), series)
        found /= size
        return found

    @property
    def _row_weight(self) -> Floats:
        return np.repeat(self.weight, len(self.plain) // len(self.weight))

    def bound(self, source: str) -> float:
        """Return the most that a row's noise may be (`noise_bound`)."""
        return noise_bound(self.data, source)

    def of_field(self, residual: Floats) -> Variance:
        """Return the variance of the noise of the field's size, by what the residual shares with it."""
        series = self.data.series
        both = np.stack([np.linalg.norm(series[_FIELD], axis=1), residual[:, 0]], axis=1)
        fourth, block = _fourth(series, both, 1), _block_of_fourth(series, 1)
        value, sigma = _ratio(fourth[:, 0] * fourth[:, 1], np.full(len(fourth), _GAIN), block)
        return _between(value, sigma, self.bound(_FIELD))

    def of_channel(self, source: str, bound: float, residual: Floats) -> Variance:
        """Return the variance of a channel's noise, by what its quick part has left in the residual."""
        series, every = self.data.series, spacing_of(self.data, source)
        size = np.sqrt(bound)
        drawn = self.noise(source, size, series)
        values = series[source].reshape(drawn.shape)
        quick = self._with(source, _quick(values, every), series)
        of_noise = self._with(source, drawn, series)
        quick_noise = self._with(source, _quick(drawn, every), series)
        names = self.search.model_columns()
        at = [place for place, name in enumerate(names) if name in self.names]
        used = self.places([names[place] for place in at])
        plain = _moments(self.search, self, self.products(source), Variance(0.0, 0.0))
        # By how much unit variance moves the values.
        value, lost, weight = plain.value[at], plain.slope[at], self._row_weight
        contribution = quick[:, used] @ value * weight
        expected = weight * (quick_noise[:, used] @ value) * (of_noise[:, used] @ value) / bound
        expected -= contribution * (self.plain[:, used] @ lost)
        block = np.repeat(series.block, len(self.plain) // len(series.block))
        found, sigma = _ratio(contribution * residual.reshape(-1), expected, block)
        return _between(found, sigma, bound)


def spacing_of(data: DiagnosisData, source: str) -> int:
    """Return how many rows lie between readings of a source, at least one."""
    mission, step = data.mission, data.series.step_s
    own = [
        mission.instruments[instrument].cadence / SECOND
        for instrument, name, _ in mission.channel_instruments()
        if source in (name, f"{instrument}.{name}")
    ]
    return max(1, round(max(own, default=0.0) / step))


def noise_bound(data: DiagnosisData, source: str) -> float:
    """Return the most that a row's noise may be, by the median of fourth differences; squared units."""
    series = data.series
    values = series[source].reshape(len(series.tt2000), -1)
    if source == _FIELD:
        values = np.linalg.norm(values, axis=1)[:, None]
    fourth = _fourth(series, values, spacing_of(data, source))
    if not fourth.size:
        return 0.0
    size = MAD_TO_SIGMA * np.median(np.abs(fourth), axis=0)
    if not size.any():
        # Most readings are the one before: what they are rounded to.
        steps = np.abs(np.diff(values, axis=0))
        steps = np.where(steps > 0, steps, np.nan)
        return float(np.nanmedian(steps) ** 2 / 12.0) if np.isfinite(steps).any() else 0.0
    return float(np.max(size) ** 2 / _GAIN)


def _between(value: float, sigma: float, bound: float) -> Variance:
    """Return a variance that lies between nothing and a bound, of which a measurement says something."""
    if not (np.isfinite(value) and sigma > 0):
        return Variance(0.5 * bound, bound / np.sqrt(12.0))
    if value > ATTENUATION_SETTINGS.known * sigma and value < bound:
        return Variance(value, sigma)
    # Moments of a normal distribution cut off at both ends, by sums: closed forms cancel out in its tails.
    likely = float(np.clip(value, 0.0, bound))
    off = abs(value - likely)
    reach = min(10.0 * sigma, 40.0 * sigma**2 / off) if off > 0 else 10.0 * sigma
    some = np.linspace(max(0.0, likely - reach), min(bound, likely + reach), 1001)
    weight = np.exp(-0.5 * (((some - value) / sigma) ** 2 - (off / sigma) ** 2))
    weight[[0, -1]] *= 0.5
    mean = float(np.average(some, weights=weight))
    return Variance(mean, float(np.sqrt(np.average((some - mean) ** 2, weights=weight))))


def _ratio(above: Floats, below: Floats, block: Floats) -> tuple[float, float]:
    """Return the ratio of two sums over rows, and its error by the scatter between blocks."""
    count = int(block.max()) + 1 if len(block) else 0
    up, down = (np.bincount(block, weights=one, minlength=count) for one in (above, below))
    if not down.sum() > 0:
        return float("nan"), 0.0
    value = float(up.sum() / down.sum())
    return value, float(np.sqrt(np.sum((up - value * down) ** 2)) / down.sum())


def _quick(values: Floats, every: int) -> Floats:
    """Return fourth differences of a series (sample, component), 0 at its ends."""
    out = np.zeros_like(values)
    reach = 2 * every
    if len(values) > 2 * reach:
        parts = [values[k * every : len(values) - (4 - k) * every] for k in range(5)]
        out[reach:-reach] = sum(w * part for w, part in zip(_FOURTH, parts, strict=True))
    return np.where(np.isfinite(out), out, 0.0)


def _whole(series: Series, every: int) -> np.ndarray:
    """Return the rows whose neighbours to both sides are all there, evenly apart."""
    reach, good = 2 * every, series["weight"] > 0
    count = len(good) - 2 * reach
    if count <= 0:
        return np.zeros(0, dtype=np.int64)
    there = np.all([good[k * every : k * every + count] for k in range(5)], axis=0)
    span = series.tt2000[2 * reach :] - series.tt2000[:count]
    even = np.abs(span / SECOND - 2 * reach * series.step_s) < 0.5 * series.step_s
    return np.flatnonzero(there & even) + reach


def _fourth(series: Series, values: Floats, every: int) -> Floats:
    """Return fourth differences (row, component) where all five readings are there."""
    at = _whole(series, every)
    return np.asarray(sum(w * values[at + (k - 2) * every] for k, w in enumerate(_FOURTH)))


def _block_of_fourth(series: Series, every: int) -> np.ndarray:
    return np.asarray(series.block[_whole(series, every)])
