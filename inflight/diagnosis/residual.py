"""Residual after the model, context of a verdict.

What is left: the residual with everything the model explains taken off, its sizes, its structure.

Rows of the record that an effect could not be taken off of, because its channel was not recorded there.

In the evidence a missing channel has its usual value, so that its gaps do not cost all other candidates their
rows. Once an effect that follows it was taken, such rows hold the effect still: they are neither error
nor structure of a model that has it, and sizes are told of the other rows.

What a verdict is made from beside the search, and the sizes of the residual.
"""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.design import Outliers, Rows, Term, design, turns_of
from inflight.diagnosis.scoring import Present, folds_of, score
from inflight.diagnosis.search import Option, Search
from inflight.diagnosis.series import Series
from inflight.dual import Switched
from inflight.lsq import GramArrays, GramBlocks, solve_scaled
from inflight.mission import Mission
from inflight.model import Model
from inflight.residual import NoiseFloor, joined_floor, level_of_rows
from inflight.samples import Part, parse, product, respond
from inflight.time import DAY, SECOND, utc_text

#: Lags of the residual's covariance that tell structure from noise, in rows of the series.
LAGS = 6

#: Structure counts when it is this many sigma from nothing and this part of the noise floor.
_CLEAR_T, _CLEAR_PART = 3.0, 0.2

#: The series holds every native sample when there are not more than so many times as many.
_EVERY = 1.2


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
        """Return True when it is large enough to matter beside noise of this size, nT."""
        return self.rms_nT > _CLEAR_PART * noise

    @property
    def is_sure(self) -> bool:
        """True when it is there beyond doubt."""
        return self.t > _CLEAR_T


def structure_of(series: Series, residual: Floats) -> Structure:
    """Return the structure of a residual (sample, row) by blocks: covariance at lags of one to six rows."""
    weight = series["weight"]
    good = weight > 0
    blocks = int(series.block.max()) + 1 if series.block.size else 0
    total, count = np.zeros(blocks), np.zeros(blocks)
    # Within a synthetic turn neighbours tell of its shape: structure goes on from turn to turn.
    for lag in range(series.turn_rows, series.turn_rows * (LAGS + 1), series.turn_rows):
        both = good[lag:] & good[:-lag] & (series.block[lag:] == series.block[:-lag])
        value = np.einsum("tr,tr->t", residual[lag:], residual[:-lag]) / residual.shape[1]
        say = np.sqrt(weight[lag:] * weight[:-lag])[both]
        total += np.bincount(series.block[lag:][both], weights=say * value[both], minlength=blocks)
        count += np.bincount(series.block[lag:][both], weights=say, minlength=blocks)
    used = count > 0
    if used.sum() < 3:
        return Structure(0.0, 0.0)
    each, share = total[used] / count[used], count[used] / count[used].sum()
    mean = float(each @ share)
    error = float(np.sqrt(np.sum(share**2 * (each - mean) ** 2) * used.sum() / (used.sum() - 1)))
    return Structure(float(np.sqrt(max(mean, 0.0))), mean / error if error > 0 else 0.0)


def floor_left(series: Series, residual: Floats, samples: float, floor: NoiseFloor) -> NoiseFloor:
    """Return the noise floor of what is left: that of the native samples, or a clearly lower one.

    A cause that is as fast as the samples, a switch without a rise time, looks like noise until it is taken
    off. It shows where the series holds every sample.

    Parameters
    ----------
    residual : ndarray, shape (sample, row)
        What is left of the series, nT.
    samples : float
        Native samples of the span.
    floor : NoiseFloor
        Of the native samples, nothing taken off.
    """
    good = series["weight"] > 0
    if samples > _EVERY * good.sum() or series.turn_rows > 1:
        return floor
    days = (series.tt2000 - series.tt2000[0]) // DAY
    edges = np.searchsorted(days, np.arange(int(days[-1]) + 2))
    parts = [slice(a, b) for a, b in pairwise(edges.tolist()) if good[a:b].any()]
    found = joined_floor([level_of_rows(residual[at], good[at], series.tt2000[at]) for at in parts])
    return found if found.high_nT < floor.low_nT else floor


def residual_left(
    search: Search, series: Series, terms: Mapping[str, Term], turn: dict[str, Floats], accepted: bool = True
) -> Floats:
    """Return the residual after calibration, model and (when asked) what the search took; (sample, row)."""
    options = search.accepted if accepted else []
    rows, names, columns = model_columns(search, series, terms, turn, options)
    present = [name for option in options for name in option.columns]
    values = joint_values(search, present)
    out = rows.residual.copy()
    base = [name for term in search.library.base for name in term.columns]
    for group, found in zip(search.intervals, values, strict=True):
        inside = np.isin(series.block, np.asarray(group))
        order = [names.index(name) for name in [*base, *found[1]]]
        out[inside] += columns[inside][:, :, order] @ found[0]
    return out


def model_columns(
    search: Search,
    series: Series,
    terms: Mapping[str, Term],
    turn: dict[str, Floats],
    options: Sequence[Option],
) -> tuple[Rows, list[str], Floats]:
    """Return the series as rows, and names and columns of calibration, model and some options on it.

    Columns are (sample, row, column) in scaled units; those of changes in time are among them.
    """
    wanted = [*search.library.base, *search.library.refined]
    used = {key for option in options for key in option.terms}
    carried = {name for one in options if one.change for name, _ in one.change.functions.values()}
    used |= {key for key, term in terms.items() if carried & set(term.columns)}
    wanted += [terms[key] for key in sorted(used - {term.key for term in wanted})]
    channels = {name for term in wanted for name in term.entry.effect.channels if name}
    rows = series.rows(turn, made_channels(series, channels))
    names = [name for term in wanted for name in term.columns]
    columns = design(wanted, rows)
    for option in options:
        if option.change is not None:
            for name, (column, factor) in option.change.functions.items():
                own = columns[:, :, names.index(column)] * np.asarray(factor)[series.block][:, None]
                columns = np.concatenate([columns, own[:, :, None]], axis=2)
                names.append(name)
    return rows, names, columns


def joint_values(search: Search, present: list[str]) -> list[tuple[Floats, list[str]]]:
    """Return each interval's values of calibration, refined and taken columns (scaled), in this order.

    With each come the names of the refined and taken columns.
    """
    evidence = search.forms["raw"]
    refined = [name for term in search.library.refined for name in term.columns]
    sigma = [s for term in search.library.refined for s in term.sigma]
    names = [*refined, *present]
    precision = search.precision(evidence, names, np.asarray([*sigma, *[np.inf] * len(present)]))
    total = evidence.total
    place, y = evidence.index(names), search.y("raw")
    common = (
        -solve_scaled(total[np.ix_(place, place)] + np.diag(precision), total[place, y])
        if names
        else np.zeros(0)
    )
    base = [name for term in search.library.base for name in term.columns]
    own_sigma = np.asarray([s for term in search.library.base for s in term.sigma])
    return [
        (np.concatenate([_base_values(search, group, base, own_sigma, names, common), common]), names)
        for group in search.intervals
    ]


def _base_values(
    search: Search, group: Sequence[int], base: list[str], sigma: Floats, names: list[str], common: Floats
) -> Floats:
    if not base:
        return np.zeros(0)
    raw: GramBlocks = search.raw
    total = raw.rows(base, blocks=np.asarray(group)).sum(axis=0)
    inner, others, y = raw.index(base), raw.index(names), raw.residuals[search.residual]
    right = total[:, y] + (total[:, others] @ common if names else 0.0)
    precision = search.precision(raw, base, sigma)
    return -solve_scaled(total[:, inner] + np.diag(precision), right)


def made_channels(
    series: Series, names: set[str], shifts: Mapping[str, float] | None = None
) -> dict[str, xr.Variable]:
    """Return derived channels on the series' own rows; placebos shifted by `shifts`, seconds."""
    out: dict[str, xr.Variable] = {}
    known = set(series.channels)
    for name in names:
        if name in known:
            continue
        factors = []
        for part in parse(name).parts:
            values = series[part.channel] if part.channel in known else np.zeros(len(series.values))
            factors.append(_part(series, part, values, shifts or {}))
        made = product(factors)
        unit = "*".join(f"({_unit(series, part.channel)})" for part in parse(name).parts)
        out[name] = xr.Variable(("time", "axis")[: made.ndim], made, {"units": unit})
    return out


def _unit(series: Series, channel: str) -> str:
    names = series.features.names
    return series.features.units[names.index(channel)] if channel in names else "1"


def _part(series: Series, part: Part, values: Floats, shifts: Mapping[str, float]) -> Floats:
    if part.placebo:
        shift = round(shifts.get(f"{part.channel}~{part.placebo}", 0.0) / series.step_s)
        values = np.roll(values, shift, axis=0)
    if not (part.lag_s or part.width):
        return values
    return part.of(values, np.diff(series.tt2000) / SECOND)


#: A slow response is known where no more than this part of what it remembers is missing.
_FORGOTTEN = 0.2


@dataclass(frozen=True)
class Uncorrected:
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


def uncorrected(search: Search, series: Series, terms: Mapping[str, Term]) -> Uncorrected | None:
    """Return the rows that what a search took cannot be taken off of; None when there are none."""
    rows, weight = np.zeros(len(series.tt2000), dtype=bool), series["weight"]
    channels: dict[str, float] = {}
    for part in _parts_taken(search, terms):
        lost = unknown_rows(series, part)
        if lost is not None and (share := _weight_part(lost, weight)) > 0:
            rows |= lost
            channels[part.channel] = max(share, channels.get(part.channel, 0.0))
    # Where hardly anything is left, a model is judged by the whole record or not at all.
    if not channels or not (weight[~rows] > 0).any():
        return None
    return Uncorrected(rows, series, dict(sorted(channels.items(), key=lambda one: -one[1])))


def _weight_part(rows: np.ndarray, weight: Floats) -> float:
    return float(weight[rows].sum() / max(weight.sum(), 1e-300))


def _parts_taken(search: Search, terms: Mapping[str, Term]) -> list[Part]:
    names = {
        name
        for option in search.accepted
        for key in option.terms
        for name in terms[key].entry.effect.channels
        if name
    }
    return [part for name in sorted(names) for part in parse(name).parts]


def unknown_rows(series: Series, part: Part) -> np.ndarray | None:
    """Return in which rows a channel, or its slow response or play, is not known; None when in no row.

    A response is not known while more than a fifth of what it remembers is missing; a play, after a
    gap, until its channel has moved by the whole width.
    """
    lost = series.missing.get(part.channel)
    if lost is None:
        return None
    if part.lag_s:
        forgotten = respond(lost.astype(np.float64), np.diff(series.tt2000) / SECOND, part.lag_s)
        lost = forgotten > _FORGOTTEN
    if part.width:
        slow = replace(part, width=0.0, text="").of(series[part.channel], np.diff(series.tt2000) / SECOND)
        lost = _unsettled(lost, slow, part.width)
    return np.asarray(lost)


def _unsettled(lost: np.ndarray, values: Floats, width: float) -> np.ndarray:
    """Return rows in or after a gap in which a play may still stand where the gap left it; (sample,)."""
    out = lost.copy()
    edges = np.flatnonzero(np.diff(lost.astype(np.int8))) + 1
    for start, end in pairwise([*edges.tolist(), len(lost)]):
        if not lost[start]:
            part = values[start:end]
            moved = np.maximum.accumulate(part) - np.minimum.accumulate(part)
            out[start:end] = moved < width
    return out


def known_evidence(
    search: Search, gaps: Uncorrected, terms: Mapping[str, Term], turn: dict[str, Floats]
) -> GramBlocks:
    """Return the raw form of the model's columns and the residual, of the rows that could be corrected.

    What the lost rows add to the Gram matrices is taken off by the coarse series. Of long records a row
    of the series is a mean of several of the evidence: what is within the means counts in proportion.
    """
    raw, series = search.raw, gaps.series
    base, sigma = search.base()
    model = [name for term in search.library.refined for name in term.columns]
    model += [name for option in search.accepted for name in option.columns]
    order = np.array([*raw.index([*base, *model]), raw.residuals[search.residual]])
    rows, names, columns = model_columns(search, series, terms, turn, search.accepted)
    places = [names.index(name) for name in [*base, *model]]
    values = np.concatenate([columns[:, :, places], rows.residual[:, :, None]], axis=2)
    values *= np.sqrt(series["weight"])[:, None, None]
    gram = np.array(raw.rows(order, order), dtype=np.float64)
    count = raw.count.copy()
    for block in np.unique(series.block[gaps.rows]):
        own = series.block == block
        weight = series["weight"][own]
        share = _weight_part(gaps.rows[own], weight)
        if share <= 0:
            continue
        bins = count[block] / (weight.sum() * values.shape[1])
        every, lost = (_square(values[one]) * bins for one in (own, own & gaps.rows))
        gram[block] -= lost + share * (gram[block] - every)
        count[block] *= 1.0 - share
    names_known = (*base, *model, raw.names[order[-1]])
    small = GramArrays(names_known, gram, raw.start, raw.end, count, raw.scale[order])
    return small.marginalise(base, search.intervals, search.precision(raw, base, sigma))


def _square(values: Floats) -> Floats:
    flat = values.reshape(-1, values.shape[2])
    return np.asarray(flat.T @ flat)


#: Part of the residual's square that a few blocks may hold between them, and how many are few.
_NEARLY_ALL, _FEW = 0.9, 12


@dataclass(frozen=True)
class Material:
    """What a verdict needs beside the search.

    Attributes
    ----------
    model : Model
        The model diagnosed.
    linearised : Model
        The same at the values the evidence was linearised at.
    terms : mapping of str to Term
    series : Series
    sums : mapping of str to float
        Over native samples: count, square, inside, spikes, and of the noise floor.
    cadence_s : float
        Of the search.
    memory_s : float
        Correlation time the prewhitened form assumes, s.
    outliers : Outliers
        What the pass left out.
    gaps : Uncorrected, optional
        Rows that count in no size, and weigh nothing in the series (see `of_known_rows`).
    switched : Switched, optional
        Switchings that two sensors show; residuals are relative to the stretches between those that no
        channel follows.
    """

    mission: Mission
    model: Model
    linearised: Model
    terms: MutableMapping[str, Term]
    series: Series
    sums: Mapping[str, float]
    cadence_s: float
    floor: NoiseFloor
    context: str = ""
    run: str = ""
    memory_s: float = 600.0
    outliers: Outliers = field(default_factory=Outliers)
    gaps: Uncorrected | None = None
    switched: Switched | None = None

    @property
    def turn(self) -> dict[str, Floats]:
        """K of every vector sensor, row by row; (9,) each."""
        return turns_of(self.linearised, int(self.series.tt2000[len(self.series.tt2000) // 2]))


def of_known_rows(search: Search, material: Material) -> Material:
    """Return the material of the rows in which the channels of all that was taken are known.

    A comparison in a band of frequencies has no such rows: its filter mixes them.
    """
    if material.mission.comparisons[material.model.comparison].kind == "platform":
        return material
    whole = material.series if material.gaps is None else material.gaps.series
    gaps = uncorrected(search, whole, material.terms)
    if gaps is None:
        return replace(material, series=whole, gaps=None)
    return replace(material, series=whole.without(gaps.rows), gaps=gaps)


def _evidence(search: Search, material: Material) -> tuple[GramBlocks, Present, int]:
    """Return the raw form that sizes are told of, the model's columns in it, and the residual's index."""
    if material.gaps is None:
        return search.forms["raw"], search.present(), search.y()
    evidence = known_evidence(search, material.gaps, material.terms, material.turn)
    return evidence, search.present_in(evidence), evidence.residuals[0]


def held_out(search: Search, material: Material) -> float:
    """Return the held-out rms at the cadence of the comparison, nT: of bins, and of what is inside them."""
    evidence, present, y = _evidence(search, material)
    interleaved = any(option.interleaved for option in search.accepted)
    empty: list[Any] = []
    found = score(evidence, present, empty, y, folds_of(len(evidence), interleaved))
    mean = float(found.loss0.sum() / max(evidence.count.sum(), 1.0))
    return float(np.sqrt(max(mean, 0.0) + _inside(material)))


def _inside(material: Material) -> float:
    return material.sums.get("inside", 0.0) / max(material.sums.get("count", 1.0), 1.0)


def native_rms(material: Material, search: Search) -> float:
    """Return the in-sample rms at the cadence of the comparison, nT, after all that was taken."""
    evidence, present, y = _evidence(search, material)
    total = evidence.total
    left = total[y, y] - (
        total[y, present.columns] @ present.solve(total)[:, y] if present.columns.size else 0.0
    )
    return float(np.sqrt(max(left, 0.0) / max(evidence.count.sum(), 1.0) + _inside(material)))


def effective_blocks(search: Search, material: Material, left: Floats) -> dict[str, Any]:
    """Return number and length of the blocks, and how many independent ones there really are.

    Neighbours that the residual's correlation ties together count once, and blocks that hold hardly any of
    the residual's square hardly count: of four days, a storm of some hours may be all that tells.
    """
    raw, evidence, y = search.raw, search.forms["raw"], search.y()
    length = float(np.median(raw.end - raw.start)) / SECOND
    memory = correlation_s(material.series, left)
    used = int(np.sum(raw.count > 0))
    span = float(raw.end[-1] - raw.start[0]) / SECOND
    square = np.clip(evidence.squares[:, y], 0.0, None)
    telling = float(square.sum() ** 2 / max(float(np.sum(square**2)), 1e-300))
    by_length = min(float(used), span / max(2.0 * memory, 1e-9))
    return {
        "count": used,
        "length_s": length,
        "correlation_s": memory,
        "by_length": by_length,
        "telling": telling,
        "independent": min(by_length, telling),
        "holding": holding(raw, square),
    }


def holding(evidence: GramBlocks, square: Floats) -> list[dict[str, Any]]:
    """Return the blocks that hold nearly all of the residual's square, in order of time, if they are few."""
    order = np.argsort(-square)
    whole = max(float(square.sum()), 1e-300)
    most = int(np.searchsorted(np.cumsum(square[order]), _NEARLY_ALL * whole)) + 1
    if most > _FEW:
        return []
    return [
        {
            "start": utc_text(int(evidence.start[place])),
            "end": utc_text(int(evidence.end[place])),
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
    while lag < min(len(y) // 4, 5000):
        both = good[lag:] & good[:-lag]
        value = float(np.sum(y[lag:] * y[:-lag])) / max(both.sum(), 1) / size
        if value <= 0.02:
            break
        step = max(1, lag // 8)
        total += value * step
        lag += step
    return total * series.step_s


def left_of(search: Search, material: Material, accepted: bool = True) -> Floats:
    """Return the residual of the series after calibration, model and what was taken; (sample, row)."""
    return residual_left(search, material.series, material.terms, material.turn, accepted)
