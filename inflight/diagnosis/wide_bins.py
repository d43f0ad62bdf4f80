"""Means of rows of the coarse series: what a search in wider bins would see of its own columns.

Takes a state of a search and its `DiagnosisData`; makes columns of the model and of some options in means of
several rows (`mean_columns`), and their Gram blocks (`gram_of_means`). The mean residual is the same function
of mean columns: nothing is lost but what is quicker than a bin.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.design import BIN_SETTINGS, Term, design_matrix
from inflight.diagnosis.refine import can_add_columns
from inflight.diagnosis.residual import DiagnosisData, derived_channels
from inflight.diagnosis.scoring import Index
from inflight.diagnosis.search import Option, Search
from inflight.diagnosis.series import Series
from inflight.diagnosis.time_changes import Stretches
from inflight.lsq import GramArrays, gram_of, parts_of, prewhiten
from inflight.samples import parse_channel
from inflight.time import SECOND


@dataclass(frozen=True, kw_only=True)
class Means:
    """Rows of the series in means of so many: residual, weights, and columns as they are made.

    Attributes
    ----------
    times : int
        Rows of a mean.
    starts : ndarray of int, shape (mean,)
        First row of each, on one even grid of time; one that has some of two blocks belongs to the first.
    own : ndarray, shape (sample,)
        Weights of the rows.
    weight : ndarray, shape (mean,)
        Each weighs as much as its rows: a row's variance is then what it was. 0 where too little is there.
    """

    times: int
    starts: Index
    own: Floats
    weight: Floats

    @classmethod
    def of(cls, series: Series, times: int) -> Means:
        """Return the means of a series."""
        step = series.step_s * SECOND
        place = np.rint((series.tt2000 - series.tt2000[0]) / step).astype(np.int64) // times
        starts, own = np.flatnonzero(np.diff(place, prepend=-1)), series["weight"]
        total = np.add.reduceat(own, starts)
        weight = np.where(total >= BIN_SETTINGS.fewest * times, total, 0.0)
        return cls(times=times, starts=starts, own=own, weight=weight)

    def __call__(self, values: Floats) -> Floats:
        """Return the means of rows (sample, row, column)."""
        flat = np.where(self.own > 0, np.moveaxis(values, 0, -1), 0.0) * self.own
        total = np.maximum(np.add.reduceat(self.own, self.starts), 1e-300)
        return np.moveaxis(np.add.reduceat(flat, self.starts, axis=-1) / total, -1, 0)


def has_means(search: Search, data: DiagnosisData) -> bool:
    """Return True when means of the series' rows are rows of wider bins, and it has what was taken."""
    # A filter has mixed the rows: means of them are no rows of another cadence.
    row_filter = data.series.row_filter
    mixed = row_filter is not None and not isinstance(row_filter, Stretches)
    there = all(is_on_series(search, data, one) for one in search.accepted)
    return not mixed and can_add_columns(search, data) and there


def mean_columns(
    search: Search, data: DiagnosisData, options: Sequence[Option], means: Sequence[Means]
) -> tuple[dict[str, float], list[Floats]]:
    """Return the names and scales of calibration, model and options, and their columns in each of the means.

    Columns are (mean, row, column), the residual last.
    """
    series, terms = data.series, terms_of(search, options)
    functions = {
        name: source
        for one in options
        if one.change is not None
        for name, source in one.change.functions.items()
    }
    channels = {name for term in terms for name in term.channels}
    rows = series.rows(data.sensor_matrices, derived_channels(series, channels))
    scales: dict[str, float] = {}
    pieces: list[list[Floats]] = [[] for _ in means]
    for term in terms:
        # One term at a time: all columns of all rows together would be hundreds of megabytes.
        fine = design_matrix([term], rows)
        scales |= dict(zip(term.columns, term.scale, strict=True))
        for name, (column, factor) in functions.items():
            if column in term.columns:
                own = fine[:, :, [term.columns.index(column)]]
                fine = np.concatenate([fine, own * np.asarray(factor)[series.block][:, None, None]], axis=2)
                scales[name] = term.scale[term.columns.index(column)]
        for piece, mean in zip(pieces, means, strict=True):
            piece.append(mean(fine))
    for piece, mean in zip(pieces, means, strict=True):
        piece.append(mean(rows.residual[:, :, None]))
    return scales, [np.concatenate(piece, axis=2) for piece in pieces]


def gram_of_means(
    search: Search,
    data: DiagnosisData,
    form: str,
    mean: Means,
    scales: Mapping[str, float],
    columns: Floats,
) -> GramArrays:
    """Return Gram blocks of columns (mean, row, column), the residual last, the calibration marginalised."""
    raw, weight = search.raw, mean.weight
    if form == "white":
        columns = prewhiten(columns, weight, data.series.tt2000[mean.starts], data.correlation_time_s)
    parts = parts_of(data.series.block[mean.starts], [*range(len(raw)), len(raw)])
    count = np.array([weight[part].sum() * columns.shape[1] for part in parts])
    gram = gram_of(columns[:, :, :-1], columns[:, :, -1:], weight, parts)
    scale = np.array([*scales.values(), 1.0])
    made = GramArrays((*scales, "residual"), gram, raw.start, raw.end, count, scale)
    base, sigma = search.base()
    groups = search.shared.days if form == "within" else search.intervals
    return made.marginalise(base, groups, search.precision(made, base, sigma))


def terms_of(search: Search, options: Sequence[Option]) -> list[Term]:
    """Return the terms of calibration, model and some options."""
    sources = {source for one in options for source in one.sources}
    own = {term.key for term in (*search.library.base, *search.fitted_terms)}
    return [term for term in search.library.all_terms if term.key in own or sources & set(term.columns)]


def is_on_series(search: Search, data: DiagnosisData, option: Option) -> bool:
    """Return True when the series has all that the columns of an option are made from."""
    known = {name for term in search.library.all_terms for name in term.columns}
    if not option.sources <= known:
        return False
    channels = {name for term in terms_of(search, [option]) for name in term.channels}
    there = set(data.series.features.names)
    return all(part.channel in there for name in channels for part in parse_channel(name).parts)
