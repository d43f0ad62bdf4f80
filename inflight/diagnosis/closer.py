"""A closer look at what lies in few blocks: its gain in spans no longer than the residual's memory asks for.

Signs of six blocks can be flipped in 64 ways: whatever lies in them can never be sure, however clearly each
of them tells of it. Where blocks are much longer than the residual remembers, they are cut, and each part's
gain is held against what the other parts promise (see `inflight.diagnosis.rivalry`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.diagnosis.library import Term
from inflight.diagnosis.material import Material, correlation_s
from inflight.diagnosis.rivalry import promised_p
from inflight.diagnosis.search import Option, Search, Table
from inflight.diagnosis.trials import Trials
from inflight.time import SECOND

#: Parts are at least so many correlation times of what is left, and so many rows, long.
_MEMORIES, _ROWS = 10.0, 20
#: Options looked at closely at most: the best of those that only their p-value keeps out.
_MOST = 6


def look_closer(search: Search, material: Material, table: Table) -> Table:
    """Return the table with p-values of options that lie in too few blocks for flips, where all else speaks.

    Each is a bound of Student's distribution times the number of options: family-wise, as flips are.
    """
    rules, raw = search.rules, table.scores["raw"]
    real = np.array([not option.placebo for option in table.options], dtype=bool)
    almost = real & (raw.t > rules.t) & (raw.gain > rules.gain) & (table.beats_placebo["raw"] > rules.t)
    almost &= table.p["raw"] >= rules.p
    places = sorted(np.flatnonzero(almost).tolist(), key=lambda place: float(raw.loss[:, place].sum()))
    if not places:
        return table
    tried = int(real.sum()) * len(table.scores)
    p = table.p["raw"].copy()
    for place in places[:_MOST]:
        p[place] = min(p[place], tried * _p_of(search, material, table.options[place]))
    return replace(table, p=table.p | {"raw": p})


def _p_of(search: Search, material: Material, option: Option) -> float:
    """Return the probability that an option gains by chance what it gains in parts of blocks."""
    terms = _terms_of(material, option)
    if terms is None:
        return 1.0
    trials = Trials(search, material, option)
    before, after = trials.contribution(option, terms)
    series = material.series
    memory = correlation_s(
        series, (after / np.where(trials.root > 0, trials.root, 1.0)).reshape(len(series.tt2000), -1)
    )
    length = max(_MEMORIES * memory, _ROWS * series.step_s)
    part = ((series.tt2000 - series.tt2000[0]) / (length * SECOND)).astype(np.int64)
    part = np.repeat(part, len(before) // len(part))
    _, part = np.unique(part, return_inverse=True)
    gained, promised = _summed(before**2 - after**2, part), _summed((before - after) ** 2, part)
    return float(promised_p(gained, promised, promised > 0)[0])


def _summed(values: Floats, part: npt.NDArray[np.int64]) -> Floats:
    """Return the sums of rows (row,) by their part; (part, 1)."""
    return np.bincount(part, weights=values).astype(np.float64)[:, None]


def _terms_of(material: Material, option: Option) -> list[Term] | None:
    """Return the terms whose columns an option is made of; None when the series cannot make them."""
    if option.change is None or option.terms:
        keys = list(option.terms)
        return [material.terms[key] for key in keys] if set(keys) <= set(material.terms) else None
    carried = {column for column, _ in option.change.functions.values()}
    found = [term for term in material.terms.values() if carried & set(term.columns)]
    return found or None
