"""The residual after the model: its values, its sizes, its structure, and the rows it cannot be corrected in.

Takes a state of the search and its `DiagnosisData` (the coarse series, the model, the noise floor);
makes the residual after calibration, model and everything that was taken (`remaining_residual`), its sizes in
sample (`native_rms`) and held out (`held_out_rms`), its slow structure (`structure_of`), its correlation time
(`correlation_s`) and how many independent blocks there are (`effective_blocks`).

In the Gram blocks a missing channel has its usual value, so that its gaps do not cost all other candidates
their rows. Once an effect that follows it was taken, such rows hold the effect still: they are neither error
nor structure of a model that has it. Sizes are those of the other rows (`with_correctable_rows`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.design import DesignRows, OutlierReport, Term, design_matrix, sensor_matrices
from inflight.diagnosis.scoring import ModelColumns, make_folds, project_out_of, score
from inflight.diagnosis.search import Option, Search
from inflight.diagnosis.series import Series
from inflight.dual import JumpAttribution
from inflight.lsq import GramArrays, GramBlocks, solve_scaled
from inflight.mission import Mission
from inflight.model import Model
from inflight.residual import NoiseFloor, floor_of_parts
from inflight.samples import ChannelFactor, channel_product, parse_channel, slow_response
from inflight.time import DAY, SECOND, utc_text


@dataclass(frozen=True, kw_only=True)
class StructureSettings:
    """When a residual has structure.

    Attributes
    ----------
    lags : int
        Lags of the residual's covariance that separate structure from noise, in rows of the series; assumed.
    t, part : float
        Structure counts when it is this many sigma from nothing and this part of the noise floor: three
        sigma; a fifth of the floor adds two hundredths to it.
    every : float
        The series holds every native sample when there are not more than so many times as many; assumed.
    days : int
        Days that the noise floor of what remains is measured on, at most; assumed.
    """

    lags: int = 6
    t: float = 3.0
    part: float = 0.2
    every: float = 1.2
    days: int = 100


@dataclass(frozen=True, kw_only=True)
class BlockSettings:
    """How the residual is described block by block, and over time.

    Attributes
    ----------
    forgotten : float
        A slow response is known where no more than this part of its past weight is missing; assumed.
    nearly_all, few : float, int
        Blocks that hold this part of the residual's square between them are named when they are no more than
        so many; assumed.
    least_correlation, longest, finest : float, int, int
        The correlation time is summed until the correlation falls to this, over no more than so many rows, in
        steps of no more than a so-many-th of the lag; assumed.
    """

    forgotten: float = 0.2
    nearly_all: float = 0.9
    few: int = 12
    least_correlation: float = 0.02
    longest: int = 5000
    finest: int = 8


STRUCTURE_SETTINGS = StructureSettings()
BLOCK_SETTINGS = BlockSettings()

#: Lags of the residual's covariance.
LAGS = STRUCTURE_SETTINGS.lags


@dataclass(frozen=True)
class Structure:
    """Slow structure of a residual.

    Attributes
    ----------
    rms_nT : float
        Root of the mean covariance of neighbouring rows: white noise has none.
    t : float
        Its mean over the error between blocks.
    """

    rms_nT: float  # noqa: N815 (a unit)
    t: float

    def is_large(self, noise: float) -> bool:
        """Return True when it is large enough to matter next to noise of this size, nT."""
        return self.rms_nT > STRUCTURE_SETTINGS.part * noise

    @property
    def is_sure(self) -> bool:
        """True when it is significant."""
        return self.t > STRUCTURE_SETTINGS.t


def structure_of(series: Series, residual: Floats) -> Structure:
    """Return the structure of a residual (sample, row) by blocks: covariance at lags of one to six rows."""
    weight = series["weight"]
    good = weight > 0
    blocks = int(series.block.max()) + 1 if series.block.size else 0
    total, count = np.zeros(blocks), np.zeros(blocks)
    # Within a synthetic turn neighbours have its shape in common: structure goes on from turn to turn.
    for lag in range(series.turn_rows, series.turn_rows * (STRUCTURE_SETTINGS.lags + 1), series.turn_rows):
        both = good[lag:] & good[:-lag] & (series.block[lag:] == series.block[:-lag])
        value = np.einsum("tr,tr->t", residual[lag:], residual[:-lag]) / residual.shape[1]
        shared = np.sqrt(weight[lag:] * weight[:-lag])[both]
        total += np.bincount(series.block[lag:][both], weights=shared * value[both], minlength=blocks)
        count += np.bincount(series.block[lag:][both], weights=shared, minlength=blocks)
    used = count > 0
    if used.sum() < 3:
        return Structure(0.0, 0.0)
    each, share = total[used] / count[used], count[used] / count[used].sum()
    mean = float(each @ share)
    error = float(np.sqrt(np.sum(share**2 * (each - mean) ** 2) * used.sum() / (used.sum() - 1)))
    return Structure(float(np.sqrt(max(mean, 0.0))), mean / error if error > 0 else 0.0)


def remaining_floor(series: Series, residual: Floats, samples: float, floor: NoiseFloor) -> NoiseFloor:
    """Return the noise floor of what remains: that of the native samples, or a clearly lower one.

    A cause that is as fast as the samples, a switch without a rise time, looks like noise until it is taken
    off. It shows where the series holds every sample.

    Parameters
    ----------
    residual : ndarray, shape (sample, row)
        What remains of the series, nT.
    samples : float
        Native samples of the span.
    floor : NoiseFloor
        Of the native samples, nothing taken off.
    """
    good = series["weight"] > 0
    if not holds_every_sample(series, samples):
        return floor
    days = (series.tt2000 - series.tt2000[0]) // DAY
    edges = np.searchsorted(days, np.arange(int(days[-1]) + 2))
    parts = [slice(a, b) for a, b in pairwise(edges.tolist()) if good[a:b].any()]
    # Of a long mission some of its days tell it, evenly spread.
    parts = parts[:: -(-len(parts) // STRUCTURE_SETTINGS.days)]
    found = floor_of_parts(residual, good, series.tt2000, parts)
    return found if found.high_nT < floor.low_nT else floor


def holds_every_sample(series: Series, samples: float) -> bool:
    """Return True when the series has each of a span's native samples, as far as a noise floor needs it."""
    used = float(np.sum(series["weight"] > 0))
    return samples <= STRUCTURE_SETTINGS.every * used and series.turn_rows == 1


def residual_with(
    series: Series, sensor_matrices: dict[str, Floats], terms: Sequence[Term], factors: Mapping[str, Floats]
) -> Floats:
    """Return the residual of the series with columns of terms added; (sample, row), nT.

    Parameters
    ----------
    factors : mapping of str to ndarray, shape (block,)
        What each column is multiplied by, as `FitSetup.block_factors` returns it.
    """
    channels = {name for term in terms for name in term.channels}
    rows = series.rows(sensor_matrices, derived_channels(series, channels))
    return _with_columns(rows.residual.copy(), terms, rows, factors, series.block)


def remaining_residual(search: Search, data: DiagnosisData, accepted: bool = True) -> Floats:
    """Return the residual of the series after calibration, model and what was taken; (sample, row).

    Parameters
    ----------
    accepted : bool
        False leaves what was taken in the residual.
    """
    options, series = search.accepted if accepted else (), data.series
    terms, rows = _terms_and_rows(search, series, data.sensor_matrices, options)
    factors = _factors_of_columns(search, options)
    _spread_changes(factors, options)
    return _with_columns(rows.residual.copy(), terms, rows, factors, series.block)


def contribution(search: Search, data: DiagnosisData, option: Option) -> Floats:
    """Return what an option that was taken makes of the residual of the series; nT, (sample, row)."""
    return _made_by(search, data, option.columns, [option])


def number_contribution(search: Search, data: DiagnosisData, number: str) -> Floats:
    """Return what a number of the model's own makes by as much as data moved it; nT, (sample, row).

    Parameters
    ----------
    number : str
        Such as ``temperature.linear``: all of its components together.
    """
    columns = [
        name
        for term in search.library.refined
        for name in term.columns
        if name.removeprefix("model:").partition("[")[0] == number
    ]
    return _made_by(search, data, columns, [])


def _made_by(
    search: Search, data: DiagnosisData, columns: Sequence[str], options: Sequence[Option]
) -> Floats:
    """Return what columns of the fit make of the residual of the series; changes are those of `options`."""
    series = data.series
    terms, rows = _terms_and_rows(search, series, data.sensor_matrices, search.accepted)
    every = _factors_of_columns(search, search.accepted)
    factors = {name: -every[name] for name in columns}
    _spread_changes(factors, options)
    return _with_columns(np.zeros_like(rows.residual), terms, rows, factors, series.block)


def _factors_of_columns(search: Search, options: Sequence[Option]) -> dict[str, Floats]:
    """Return what each column is multiplied by in each block, those of calibration and model among them."""
    values = joint_values(search, [name for option in options for name in option.columns])
    base = [name for term in search.library.base for name in term.columns]
    factors: dict[str, Floats] = {}
    for group, (found, known) in zip(search.intervals, values, strict=True):
        for name, value in zip([*base, *known], found, strict=True):
            factors.setdefault(name, np.zeros(len(search.raw)))[np.asarray(group)] = value
    return factors


def _spread_changes(factors: dict[str, Floats], options: Sequence[Option]) -> None:
    """Put what changes of some options are multiplied by on the columns that they are changes of."""
    for option in options:
        for name, (column, factor) in (option.change.functions if option.change else {}).items():
            factors[column] = factors.get(column, 0.0) + factors.pop(name) * np.asarray(factor)


def _with_columns(
    out: Floats,
    terms: Sequence[Term],
    rows: DesignRows,
    factors: Mapping[str, Floats],
    block: npt.NDArray[np.int64],
) -> Floats:
    """Add the columns of terms, each times its factor of the sample's block."""
    # One term at a time: of a long record all columns together are hundreds of megabytes.
    for term in terms:
        used = [place for place, name in enumerate(term.columns) if name in factors]
        if used:
            each = np.stack([factors[term.columns[place]] for place in used], axis=1)
            own = design_matrix([term], rows)[:, :, used]
            out += np.einsum("trk,tk->tr", own, each[block])
    return out


def _terms_and_rows(
    search: Search, series: Series, sensor_matrices: dict[str, Floats], options: Sequence[Option]
) -> tuple[list[Term], DesignRows]:
    """Return the terms of calibration, model and some options, and the series as rows for them."""
    terms = search.library.by_key
    chosen = [*search.library.base, *search.fitted_terms]
    used = {key for option in options for key in option.terms}
    changing = {name for one in options if one.change for name, _ in one.change.functions.values()}
    used |= {key for key, term in terms.items() if changing & set(term.columns)}
    chosen += [terms[key] for key in sorted(used - {term.key for term in chosen})]
    channels = {name for term in chosen for name in term.channels}
    return chosen, series.rows(sensor_matrices, derived_channels(series, channels))


def iter_model_columns(
    search: Search,
    series: Series,
    sensor_matrices: dict[str, Floats],
    options: Sequence[Option],
    wanted: Sequence[str],
) -> tuple[DesignRows, Iterator[tuple[int, Floats]]]:
    """Return the series as rows, and an iterator over columns of calibration, model and some options on it.

    One term at a time: of a long record all columns together are hundreds of megabytes. With each column,
    (sample, row) in scaled units and not to be changed, comes its place among those that are `wanted`, each
    of which is there once.
    """
    terms, rows = _terms_and_rows(search, series, sensor_matrices, options)
    changing = [one.change.functions for one in options if one.change]
    changes = {name: (of, np.asarray(factor)) for each in changing for name, (of, factor) in each.items()}
    unknown = set(wanted) - changes.keys() - {name for term in terms for name in term.columns}
    if unknown or len(set(wanted)) < len(wanted):
        raise ValueError(f"the model has no columns {sorted(unknown)}, or some are wanted twice: {wanted}")
    place = {name: at for at, name in enumerate(wanted)}
    return rows, _iter_columns(terms, rows, changes, series.block, place)


def _iter_columns(
    terms: Sequence[Term],
    rows: DesignRows,
    changes: Mapping[str, tuple[str, Floats]],
    block: npt.NDArray[np.int64],
    place: Mapping[str, int],
) -> Iterator[tuple[int, Floats]]:
    """Yield columns of terms, then those that are changes of others, each with its place."""
    changing, kept = {of for of, _ in changes.values()}, dict[str, Floats]()
    used = changing | place.keys()
    for term in terms:
        if used.isdisjoint(term.columns):
            continue
        made = design_matrix([term], rows)
        for at, name in enumerate(term.columns):
            if name in changing:
                kept[name] = made[:, :, at]
            if name in place:
                yield place[name], made[:, :, at]
    for name, (of, factor) in changes.items():
        own = kept[of] * factor[block][:, None]
        if name in changing:
            kept[name] = own
        if name in place:
            yield place[name], own


def joint_values(search: Search, present: list[str]) -> list[tuple[Floats, list[str]]]:
    """Return each interval's values of calibration, refined and taken columns (scaled), in this order.

    With each come the names of the refined and taken columns.
    """
    grams = search.forms["raw"]
    refined = [name for term in search.fitted_terms for name in term.columns]
    names = [*refined, *present]
    precision = search.precision(grams, names, search.sigma_of_model(len(names)))
    place, y = grams.index(names), search.y("raw")
    total = grams.rows(place, np.append(place, y)).sum(axis=0)
    common = -solve_scaled(total[:, :-1] + np.diag(precision), total[:, -1]) if names else np.zeros(0)
    base, base_sigma = search.base()
    raw = search.raw
    inner, others, y = raw.index(base), raw.index(names), raw.residuals[search.residual]
    prior = np.diag(search.precision(raw, base, base_sigma))
    out = []
    for group in search.intervals:
        values = np.zeros(0)
        if base:
            sums = raw.rows(base, blocks=np.asarray(group)).sum(axis=0)
            right = sums[:, y] + (sums[:, others] @ common if names else 0.0)
            values = -solve_scaled(sums[:, inner] + prior, right)
        out.append((np.concatenate([values, common]), names))
    return out


def derived_channels(
    series: Series,
    names: set[str],
    shifts: Mapping[str, float] | None = None,
    rows: slice = slice(None),
) -> dict[str, xr.Variable]:
    """Return derived channels on the series' own rows, or on a part of them.

    Placebos are shifted by `shifts`, seconds, in the whole series; slow responses begin with the part.
    """
    out: dict[str, xr.Variable] = {}
    new = names - set(series.channels)
    if not new:
        return out
    units = dict(zip(series.features.names, series.features.units, strict=True))
    steps_s = np.diff(series.tt2000[rows]) / SECOND
    for name in new:
        factors = []
        for part in parse_channel(name).parts:
            shift = (shifts or {}).get(f"{part.channel}~{part.placebo}", 0.0) if part.placebo else 0.0
            values = _shifted(series, part.channel, round(shift / series.step_s) if shift else 0, rows)
            factors.append(part.of(values, steps_s))
        made = channel_product(factors)
        unit = "*".join(f"({units.get(part.channel, '1')})" for part in parse_channel(name).parts)
        out[name] = xr.Variable(("time", "axis")[: made.ndim], made, {"units": unit})
    return out


def _shifted(series: Series, channel: str, shift: int, rows: slice) -> Floats:
    """Return some rows of a channel shifted in the whole series, whose end comes first; 0 of no channel."""
    first, last, _ = rows.indices(len(series.tt2000))
    if channel not in series.channels:
        return np.zeros(last - first)
    if not shift:
        return series.part(rows)[channel]
    places = (np.arange(first, last) - shift) % len(series.tt2000)
    return series.at(places, channel)


@dataclass(frozen=True)
class UncorrectableRows:
    """Rows that what was taken cannot be taken off of.

    Attributes
    ----------
    rows : ndarray of bool, shape (sample,)
    series : Series
        With their weights still.
    channels : dict of str to float
        Part of the record each channel keeps from being corrected; the largest first.
    """

    rows: np.ndarray
    series: Series
    channels: Mapping[str, float]

    @property
    def part(self) -> float:
        """Part of the record that counts in no size."""
        return _weight_part(self.rows, self.series["weight"])

    def as_json(self) -> list[dict[str, Any]]:
        """Return channels with the part of the record each of them is needed for and missing in."""
        return [{"channel": name, "part": part} for name, part in self.channels.items()]


def uncorrectable_rows(search: Search, series: Series) -> UncorrectableRows | None:
    """Return the rows that what a search took cannot be taken off of; None when there are none."""
    rows, weight = np.zeros(len(series.tt2000), dtype=bool), series["weight"]
    channels: dict[str, float] = {}
    terms = search.library.by_key
    taken = [terms[key] for option in search.accepted for key in option.terms]
    names = {name for term in taken for name in term.channels}
    for part in (part for name in sorted(names) for part in parse_channel(name).parts):
        lost = unknown_rows(series, part)
        if lost is not None and (share := _weight_part(lost, weight)) > 0:
            rows |= lost
            channels[part.channel] = max(share, channels.get(part.channel, 0.0))
    # Where hardly any row can be corrected, a model is judged by the whole record or not at all.
    if not channels or not (weight[~rows] > 0).any():
        return None
    return UncorrectableRows(rows, series, dict(sorted(channels.items(), key=lambda one: -one[1])))


def _weight_part(rows: np.ndarray, weight: Floats) -> float:
    return float(weight[rows].sum() / max(weight.sum(), 1e-300))


def unknown_rows(series: Series, part: ChannelFactor) -> np.ndarray | None:
    """Return in which rows a channel, or its slow response or play, is not known; None when in no row.

    A response is not known while more than a fifth of what it remembers is missing; a play, after a
    gap, until its channel has moved by the whole width.
    """
    lost = series.missing.get(part.channel)
    if lost is None:
        return None
    if part.lag_s:
        forgotten = slow_response(lost.astype(np.float64), np.diff(series.tt2000) / SECOND, part.lag_s)
        lost = forgotten > BLOCK_SETTINGS.forgotten
    if part.width:
        slow = replace(part, width=0.0, text="").of(series[part.channel], np.diff(series.tt2000) / SECOND)
        lost = _unsettled(lost, slow, part.width)
    return np.asarray(lost)


def _unsettled(lost: np.ndarray, values: Floats, width: float) -> np.ndarray:
    """Return rows in or after a gap in which a play may still be where it was before the gap; (sample,)."""
    out = lost.copy()
    edges = np.flatnonzero(np.diff(lost.astype(np.int8))) + 1
    for start, end in pairwise([*edges.tolist(), len(lost)]):
        if not lost[start]:
            part = values[start:end]
            moved = np.maximum.accumulate(part) - np.minimum.accumulate(part)
            out[start:end] = moved < width
    return out


def correctable_grams(
    search: Search, gaps: UncorrectableRows, sensor_matrices: dict[str, Floats]
) -> GramBlocks:
    """Return the raw form of the model's columns and the residual, of the rows that could be corrected.

    What the lost rows add to the Gram matrices is subtracted with the help of the coarse series. Of long
    records a row of the series is a mean of several rows of the Gram blocks: what is within the means counts
    in proportion.
    """
    raw, series = search.raw, gaps.series
    base, sigma = search.base()
    model = [name for term in search.fitted_terms for name in term.columns]
    model += [name for option in search.accepted for name in option.columns]
    order = np.array([*raw.index([*base, *model]), raw.residuals[search.residual]])
    rows, made = iter_model_columns(search, series, sensor_matrices, search.accepted, [*base, *model])
    root = np.sqrt(series["weight"])[:, None]
    values = np.empty((*rows.residual.shape, len(order)))
    for at, column in made:
        np.multiply(column, root, out=values[:, :, at])
    np.multiply(rows.residual, root, out=values[:, :, -1])
    gram = np.array(raw.rows(order, order), dtype=np.float64)
    count = raw.count.copy()
    for block in np.unique(series.block[gaps.rows]):
        own = slice(*np.searchsorted(series.block, [block, block + 1]).tolist())
        weight = series["weight"][own]
        share = _weight_part(gaps.rows[own], weight)
        if share <= 0:
            continue
        bins = count[block] / (weight.sum() * values.shape[1])
        flat = [one.reshape(-1, values.shape[2]) for one in (values[own], values[own][gaps.rows[own]])]
        every, lost = (part.T @ part * bins for part in flat)
        gram[block] -= lost + share * (gram[block] - every)
        count[block] *= 1.0 - share
    names_known = (*base, *model, raw.names[order[-1]])
    small = GramArrays(names_known, gram, raw.start, raw.end, count, raw.scale[order])
    return small.marginalise(base, search.intervals, search.precision(raw, base, sigma))


@dataclass(frozen=True, kw_only=True)
class DiagnosisData:
    """What a diagnosis needs in addition to the search: model, coarse series, sums, noise floor.

    Attributes
    ----------
    model : Model
        The model diagnosed.
    linearised : Model
        The same at the values the Gram blocks were linearised at.
    series : Series
        The coarse series.
    sums : mapping of str to float
        Over native samples: count, square, inside, spikes, and of the noise floor.
    cadence_s : float
        Of the search.
    floor : NoiseFloor
        Of the native samples.
    context_id, run : str
        Of the catalog.
    correlation_time_s : float
        Correlation time the prewhitened form assumes, s.
    outliers : Outliers
        Samples that the pass skipped.
    columns : dict of str to ndarray, shape (column, row)
        Columns of the series by term, weighted: those of the model are asked for again and again. Also what
        trials left in each block (see `FormTrials.loss`).
    gaps : UncorrectableRows, optional
        Rows that count in no size, and have no weight in the series (see `with_correctable_rows`).
    switched : JumpAttribution, optional
        Switchings that two sensors show; residuals are relative to the stretches between those that no
        channel follows.
    lost : mapping of datetime64[D] to str
        Days that could not be taken in, and why: nothing here knows of them.
    """

    mission: Mission
    model: Model
    linearised: Model
    series: Series
    sums: Mapping[str, float]
    cadence_s: float
    floor: NoiseFloor
    context_id: str = ""
    run: str = ""
    correlation_time_s: float = 600.0
    outliers: OutlierReport = field(default_factory=OutlierReport)
    columns: dict[str, Floats] = field(default_factory=dict, compare=False, repr=False)
    gaps: UncorrectableRows | None = None
    switched: JumpAttribution | None = None
    lost: Mapping[np.datetime64, str] = field(default_factory=dict)

    @property
    def sensor_matrices(self) -> dict[str, Floats]:
        """The matrix K of every vector sensor, row by row; (9,) each."""
        return sensor_matrices(self.linearised, int(self.series.tt2000[len(self.series.tt2000) // 2]))


class Native(NamedTuple):
    """What a search took, at the cadence of the samples.

    Attributes
    ----------
    search : Search
        On Gram blocks of the samples.
    cadence_s : float
    series : Series, optional
        The samples; None where they are too many for columns to be made of them.
    """

    search: Search
    cadence_s: float
    series: Series | None = None

    def data(self, data: DiagnosisData) -> DiagnosisData | None:
        """Return the data of the samples, of those of the search; None where they are too many."""
        if self.series is None:
            return None
        return replace(data, series=self.series, cadence_s=self.cadence_s, columns={}, gaps=None)


def with_correctable_rows(search: Search, data: DiagnosisData) -> DiagnosisData:
    """Return the data of the rows in which the channels of all that was taken are known.

    A comparison in a band of frequencies has no such rows: its filter mixes them.
    """
    if data.mission.comparisons[data.model.comparison].kind == "platform":
        return data
    whole = data.series if data.gaps is None else data.gaps.series
    gaps = uncorrectable_rows(search, whole)
    if gaps is None:
        return replace(data, series=whole, gaps=None, columns={})
    return replace(data, series=whole.without(gaps.rows), gaps=gaps, columns={})


def _grams_of_sizes(search: Search, data: DiagnosisData) -> tuple[GramBlocks, ModelColumns, int]:
    """Return the raw form that sizes are taken from, the model's columns in it, and the residual's index."""
    if data.gaps is None:
        return search.forms["raw"], search.present(), search.y()
    grams = correctable_grams(search, data.gaps, data.sensor_matrices)
    return grams, search.present_in(grams), grams.residuals[0]


def held_out_rms(search: Search, data: DiagnosisData) -> float:
    """Return the held-out rms at the cadence of the comparison, nT: of bins, and of what is inside them."""
    grams, present, y = _grams_of_sizes(search, data)
    interleaved = any(option.interleaved for option in search.accepted)
    empty: list[Any] = []
    found = score(grams, present, empty, y, make_folds(len(grams), interleaved))
    mean = float(found.loss0.sum() / max(grams.count.sum(), 1.0))
    return float(np.sqrt(max(mean, 0.0) + _square_within_bins(data)))


def _square_within_bins(data: DiagnosisData) -> float:
    return data.sums.get("inside", 0.0) / max(data.sums.get("count", 1.0), 1.0)


def native_rms(data: DiagnosisData, search: Search) -> float:
    """Return the in-sample rms at the cadence of the comparison, nT, after all that was taken."""
    grams, present, y = _grams_of_sizes(search, data)
    remaining = project_out_of(grams, present, np.array([y]))[0, 0]
    return float(np.sqrt(max(remaining, 0.0) / max(grams.count.sum(), 1.0) + _square_within_bins(data)))


def effective_blocks(search: Search, data: DiagnosisData, residual: Floats) -> dict[str, Any]:
    """Return number and length of the blocks, and how many independent ones there really are.

    Neighbours that the residual's correlation ties together count once, and blocks that hold hardly any of
    the residual's square hardly count: of four days, a storm of some hours may hold all the information.
    """
    raw, grams, y = search.raw, search.forms["raw"], search.y()
    length = float(np.median(raw.end - raw.start)) / SECOND
    correlation = correlation_s(data.series, residual)
    used = int(np.sum(raw.count > 0))
    span = float(raw.end[-1] - raw.start[0]) / SECOND
    square = np.clip(grams.squares[:, y], 0.0, None)
    informative = float(square.sum() ** 2 / max(float(np.sum(square**2)), 1e-300))
    by_length = min(float(used), span / max(2.0 * correlation, 1e-9))
    return {
        "count": used,
        "length_s": length,
        "correlation_s": correlation,
        "by_length": by_length,
        "telling": informative,
        "independent": min(by_length, informative),
        "holding": dominant_blocks(raw, square),
    }


def dominant_blocks(grams: GramBlocks, square: Floats) -> list[dict[str, Any]]:
    """Return the blocks that hold nearly all of the residual's square, in order of time, if they are few."""
    order = np.argsort(-square)
    whole = max(float(square.sum()), 1e-300)
    most = int(np.searchsorted(np.cumsum(square[order]), BLOCK_SETTINGS.nearly_all * whole)) + 1
    if most > BLOCK_SETTINGS.few:
        return []
    return [
        {
            "start": utc_text(int(grams.start[place])),
            "end": utc_text(int(grams.end[place])),
            "part": float(square[place] / whole),
        }
        for place in sorted(order[:most].tolist())
    ]


def correlation_s(series: Series, residual: Floats) -> float:
    """Return the residual's integrated correlation time, s, summed up to its first zero."""
    good = series["weight"] > 0
    y = np.where(good[:, None], residual, 0.0)
    size = float(np.sum(y**2)) / max(good.sum(), 1)
    if size <= 0:
        return series.step_s
    total, lag = 0.5, 1
    while lag < min(len(y) // 4, BLOCK_SETTINGS.longest):
        both = good[lag:] & good[:-lag]
        value = float(np.sum(y[lag:] * y[:-lag])) / max(both.sum(), 1) / size
        if value <= BLOCK_SETTINGS.least_correlation:
            break
        step = max(1, lag // BLOCK_SETTINGS.finest)
        total += value * step
        lag += step
    return total * series.step_s
