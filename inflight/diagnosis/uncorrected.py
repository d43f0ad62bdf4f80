"""Rows of the record that an effect could not be taken off of, because its channel was not recorded there.

In the evidence a missing channel has its usual value, so that its gaps do not cost all other candidates their
rows. Once an effect that follows it was taken, such rows hold the effect still: they are neither error
nor structure of a model that has it, and sizes are told of the other rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from inflight.arrays import Floats
from inflight.derived import Part, parse, respond
from inflight.diagnosis.evidence import Evidence
from inflight.diagnosis.left import model_columns
from inflight.diagnosis.library import Term
from inflight.diagnosis.search import Search
from inflight.diagnosis.series import Series
from inflight.time import SECOND

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
        return _part(self.rows, self.series["weight"])

    def as_json(self) -> list[dict[str, Any]]:
        """Return channels with the part of the record each of them is needed for and missing in."""
        return [{"channel": name, "part": part} for name, part in self.channels.items()]


def uncorrected(search: Search, series: Series, terms: Mapping[str, Term]) -> Uncorrected | None:
    """Return the rows that what a search took cannot be taken off of; None when there are none."""
    rows, weight = np.zeros(len(series.tt2000), dtype=bool), series["weight"]
    channels: dict[str, float] = {}
    for part in _parts_taken(search, terms):
        lost = unknown_rows(series, part)
        if lost is not None and (share := _part(lost, weight)) > 0:
            rows |= lost
            channels[part.channel] = max(share, channels.get(part.channel, 0.0))
    # Where hardly anything is left, a model is judged by the whole record or not at all.
    if not channels or not (weight[~rows] > 0).any():
        return None
    return Uncorrected(rows, series, dict(sorted(channels.items(), key=lambda one: -one[1])))


def _part(rows: np.ndarray, weight: Floats) -> float:
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
) -> Evidence:
    """Return the raw form of the model's columns and the residual, of the rows that could be corrected.

    What the lost rows add to the Gram matrices is taken off by the coarse series. Of long records a row
    of the series is a mean of several of the evidence: what is within the means counts in proportion.
    """
    raw, series = search.raw, gaps.series
    base, sigma = search.base()
    model = [name for term in search.library.refined for name in term.columns]
    model += [name for option in search.accepted for name in option.columns]
    order = [*raw.index([*base, *model]), raw.residuals[search.residual]]
    rows, names, columns = model_columns(search, series, terms, turn, search.accepted)
    places = [names.index(name) for name in [*base, *model]]
    values = np.concatenate([columns[:, :, places], rows.residual[:, :, None]], axis=2)
    values *= np.sqrt(series["weight"])[:, None, None]
    gram = np.array(raw.gram[:, np.array(order)[:, None], np.array(order)], dtype=np.float64)
    count = raw.count.copy()
    for block in np.unique(series.block[gaps.rows]):
        own = series.block == block
        weight = series["weight"][own]
        share = _part(gaps.rows[own], weight)
        if share <= 0:
            continue
        bins = count[block] / (weight.sum() * values.shape[1])
        every, lost = (_square(values[one]) * bins for one in (own, own & gaps.rows))
        gram[block] -= lost + share * (gram[block] - every)
        count[block] *= 1.0 - share
    small = replace(
        raw,
        names=(*base, *model, raw.names[order[-1]]),
        gram=gram,
        count=count,
        scale=raw.scale[np.array(order)],
    )
    return small.absorbed(base, search.intervals, search.precision(raw, base, sigma))


def _square(values: Floats) -> Floats:
    flat = values.reshape(-1, values.shape[2])
    return np.asarray(flat.T @ flat)
