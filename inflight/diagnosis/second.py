"""A second look: fields that follow the product of two channels.

All pairs of all channels would be too many columns for every mission. When the rounds leave something
unexplained, the pairs of the most telling channels are made from the coarse series, with all their
products with every other column, and join the evidence as candidates like any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, pairwise

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.columns import design
from inflight.diagnosis.evidence import Evidence
from inflight.diagnosis.gram import prewhiten
from inflight.diagnosis.left import made_channels
from inflight.diagnosis.library import Term
from inflight.diagnosis.material import Material
from inflight.diagnosis.search import Option, Search, Table
from inflight.errors import InflightError
from inflight.model import make_effect
from inflight.sensors import sensors_of
from inflight.time import DAY

#: Channels that are paired: the most telling ones.
_CHANNELS, _PAIRS = 8, 60
#: A factor that varies by less than this part of its size is a constant.
_STEADY = 1e-3
#: Angles: a field may follow them, but no product with them means anything.
NO_FACTOR = frozenset({"longitude", "orbit_phase", "sun_phase", "local_time"})
#: Rows of the series at most: of longer records a user asks for a product by name.
MOST_ROWS = 400_000


def look_again(search: Search, material: Material, tables: Sequence[Table], unexplained: bool) -> bool:
    """Add products of channels to the search's candidates; return whether there were any.

    Parameters
    ----------
    unexplained : bool
        Something is left: all pairs of the most telling channels are tried. Else only pairs with a
        channel that was taken, because its field may depend on another channel.
    """
    if not can_join(search, material):
        return False
    known = {option.mechanism for option in search.options}
    terms = [
        term
        for one, other in _pairs(search, material, tables, unexplained)
        if (term := _product(material, one, other)) is not None and term.key not in known
    ]
    if not terms:
        return False
    join_terms(search, material, terms)
    for term in terms:
        channels = tuple(term.entry.effect.channels[0].split("*"))
        search.options.append(
            Option(term.key, term.key, "unknown", tuple(term.columns), channels, (term.key,))
        )
    return True


def join_terms(search: Search, material: Material, terms: Sequence[Term]) -> None:
    """Join the columns of new terms to the evidence and its forms, with their products with all others."""
    names = [name for term in terms for name in term.columns]
    scale = np.array([one for term in terms for one in term.scale])
    raw, white = _borders(search, material, terms)
    base, sigma = search.base()
    precision = search.precision(search.raw, base, sigma)
    for form, (source, groups) in search.sources().items():
        left = source.absorbed_border(base, groups, precision, *(white if form == "white" else raw))
        search.forms[form] = search.forms[form].bordered(names, scale, *left)
    search.raw = search.raw.bordered(names, scale, *raw)
    search.white = search.white.bordered(names, scale, *white)
    for term in terms:
        search.library.terms[term.key] = material.terms[term.key] = term


def can_join(search: Search, material: Material) -> bool:
    """Return True when columns can still be made: of long records the days' own equations are gone."""
    return search.within is None and len(material.series.tt2000) <= MOST_ROWS


def _pairs(
    search: Search, material: Material, tables: Sequence[Table], unexplained: bool
) -> list[tuple[str, str]]:
    """Return the pairs to try: a channel that was taken with every other one; of the telling ones all."""
    series = material.series
    scalars = [name for name in series.channels if series[name].ndim == 1 and _varies(series[name], name)]
    taken = [name for option in search.accepted for name in option.channels if name in scalars]
    pairs = [(one, other) for one in dict.fromkeys(taken) for other in scalars if other != one]
    if unexplained:
        pairs += combinations(telling_channels(search, material, tables), 2)
    first: dict[frozenset[str], tuple[str, str]] = {}
    for pair in pairs:
        first.setdefault(frozenset(pair), pair)
    return list(first.values())[:_PAIRS]


def _varies(values: Floats, name: str) -> bool:
    """Return True when a product with the channel is another thing than the other channel alone."""
    known = values[np.isfinite(values)]
    return name not in NO_FACTOR and known.size > 0 and bool(np.std(known) > _STEADY * np.abs(known).mean())


def telling_channels(search: Search, material: Material, tables: Sequence[Table]) -> list[str]:
    """Return the channels whose own effects explain most, by any round's scores; those taken come first."""
    there = set(material.series.channels)
    gains = {channel: np.inf for option in search.accepted for channel in option.channels if channel in there}
    for table in tables:
        scores = table.scores["raw"]
        for place, option in enumerate(table.options):
            if option.placebo or len(option.channels) != 1 or option.channels[0] not in there:
                continue
            name = option.channels[0]
            if material.series[name].ndim == 1 and scores.t[place] > 1.0:
                gains[name] = max(gains.get(name, 0.0), float(scores.gain[place]))
    scalars = [name for name in gains if material.series[name].ndim == 1]
    return sorted(sorted(scalars), key=lambda name: -gains[name])[:_CHANNELS]


def _product(material: Material, one: str, other: str) -> Term | None:
    sensors = sensors_of(material.mission, material.model.comparison)
    first = next(iter(material.series.features.sensors))
    entry = {"effect": "channel_field", "channel": f"{one}*{other}", "sensor": first}
    try:
        made = make_effect(entry, sensors, material.model.own, material.mission)
    except InflightError:
        return None
    return Term(f"channel_field({one}*{other})", made, ("coefficient",), (np.inf,) * 3)


def _wall(search: Search, material: Material, terms: Sequence[Term]) -> tuple[list[str], list[np.ndarray]]:
    """Return the names of the columns of all terms, and pieces of them on the coarse series.

    Pieces are (sample, row, column) float32. They are kept: each further column costs its own making only.
    """
    series = material.series
    known, kept = search.wall
    new = [term for term in [*search.library.all_terms, *terms] if not set(term.columns) <= set(known)]
    channels = {name for term in new for name in term.entry.effect.channels if name}
    rows = series.rows(material.turn, made_channels(series, channels, search.library.placebos))
    made = [design([term], rows).astype(np.float32) for term in new]
    search.wall = [*known, *(name for term in new for name in term.columns)], [*kept, *made]
    return search.wall


#: Products of new columns with every column there is, and with each other; (block, ...) each.
Border = tuple[Floats, Floats]


def _borders(search: Search, material: Material, terms: Sequence[Term]) -> tuple[Border, Border]:
    """Return the terms' products with all columns, raw and prewhitened."""
    series = material.series
    names, wall = _wall(search, material, terms)
    fresh = [name for term in terms for name in term.columns]
    places = [names.index(name) for name in fresh]
    residual = series["residual"].reshape(len(series.tt2000), -1, 1)
    grams = [np.zeros((len(search.raw), len(names) + 1, len(fresh))) for _ in range(2)]
    day = (series.tt2000 - series.tt2000[0]) // DAY
    for part in _runs(day):
        weight, stamps, block = series["weight"][part], series.tt2000[part], series.block[part]
        used = np.where((weight > 0)[:, None, None], np.nan_to_num(residual[part]), 0.0)
        columns = np.concatenate([*(piece[part] for piece in wall), used], axis=2)
        for gram, values in zip(
            grams, (columns, prewhiten(columns, weight, stamps, material.memory_s)), strict=True
        ):
            _add(gram, values, weight, block, places)
    changes = {
        name: told
        for option in search.accepted
        if option.change
        for name, told in option.change.functions.items()
    }
    return (
        _border(search.raw, grams[0], names, terms, changes),
        _border(search.white, grams[1], names, terms, changes),
    )


def _runs(day: np.ndarray) -> list[slice]:
    edges = [0, *(np.flatnonzero(np.diff(day)) + 1).tolist(), len(day)]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]


def _add(gram: Floats, values: Floats, weight: Floats, block: np.ndarray, places: list[int]) -> None:
    """Add products of all columns with the fresh ones, block by block; the residual stands last."""
    root = np.sqrt(weight)[:, None, None]
    scaled = values * root
    for one in np.unique(block):
        flat = scaled[block == one].reshape(-1, values.shape[2])
        gram[one] += flat.T @ flat[:, places]


def _border(
    evidence: Evidence,
    gram: Floats,
    names: Sequence[str],
    terms: Sequence[Term],
    changes: dict[str, tuple[str, Floats]],
) -> Border:
    """Return the fresh columns' products with those of the evidence, changes in time among them."""
    fresh = [name for term in terms for name in term.columns]
    places = {name: place for place, name in enumerate([*names, "residual"])}
    across = np.zeros((len(evidence), len(evidence.names), len(fresh)))
    for place, name in enumerate(evidence.names):
        source, factor = changes.get(name, (name, None))
        if source in places:
            piece = gram[:, places[source]]
            across[:, place] = piece if factor is None else piece * np.asarray(factor)[:, None]
    return across, gram[:, [places[name] for name in fresh]]
