"""The form of what was taken: lags and widths between those of the bank, before the next effect is sought.

An effect in a form that is nearly right leaves a remnant that wrong companions would explain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.columns import Rows, design
from inflight.diagnosis.findings import lag_profile
from inflight.diagnosis.left import made_channels
from inflight.diagnosis.library import Term
from inflight.diagnosis.material import Material
from inflight.diagnosis.rivalry import hac_t
from inflight.diagnosis.search import Option, Search
from inflight.diagnosis.second import MOST_ROWS, join_terms
from inflight.model import make_effect
from inflight.sensors import sensors_of

#: A lag is refined when it is off by more than this part.
_NEAR = 0.02
#: Profiles of a lag at most: each new column makes the next one sharper.
_TURNS = 3
#: Widths tried, as parts of the channel's range.
_WIDTHS = np.geomspace(0.02, 0.9, 16)
#: The channel itself stays beside its play when it helps by more than this t.
_NEEDED = 2.0


def refine(search: Search, material: Material, option: Option) -> Option:
    """Return the option in its best form; the option itself when the bank has it already.

    The new columns join the evidence, from the coarse series.
    """
    if option.change is not None or len(option.channels) != 1 or len(material.series.tt2000) > MOST_ROWS:
        return option
    if option.mechanism.startswith("hysteresis("):
        return _with_width(search, material, option)
    if option.mechanism.startswith("channel_field("):
        return _with_lag(search, material, option)
    return option


def _with_lag(search: Search, material: Material, option: Option) -> Option:
    made = option
    for _ in range(_TURNS):
        # The profile between two lags of the bank is a mixture's; a column of the lag itself makes it exact.
        better = _nearer(search, material, option, made)
        if better is made:
            break
        made = better
    return made


def _nearer(search: Search, material: Material, option: Option, now: Option) -> Option:
    """Return the option with a lag nearer to the best one; the present one when it is near enough."""
    found = lag_profile(search, option)
    if found is None:
        return now
    smallest = float(found.lags[found.lags > 0][0])
    best = found.best if found.best >= smallest else 0.0
    if abs(best - now.lag_s) <= _NEAR * max(best, now.lag_s) or (best == 0.0 and now.lag_s == 0.0):
        return now
    if best == 0.0:
        plain = [one for one in search.options if one.mechanism == option.mechanism and one.lag_s == 0.0]
        return plain[0] if plain else now
    lag = float(f"{best:.4g}")
    key = f"{option.mechanism}@lag={lag:g}s"
    term = _term(search, material, option.terms[0], key, {"lag": f"{lag:g} s"}, ("coefficient",))
    return _joined(search, material, option, [term], key, lag)


def _with_width(search: Search, material: Material, option: Option) -> Option:
    """Return the play of the best width, with the channel itself where it is needed."""
    plays = _Plays(search, material, option)
    alone = plays.best(False)
    width = plays.best(True)
    gained = plays.left(alone, False) - plays.left(width, True)
    needed = float(hac_t(gained[:, None])[0]) > _NEEDED
    width = width if needed else alone
    key = f"{option.mechanism}@width={width:g}"
    term = plays.term(width, key)
    made = _joined(search, material, option, [term], key, 0.0)
    if not needed:
        return made
    plain = option.terms[0]
    columns = (*search.library.terms[plain].columns, *term.columns)
    whole = replace(made, terms=(plain, key), columns=columns)
    search.options[-1] = whole
    return whole


def _lowest(widths: Floats, sums: Floats) -> float:
    """Return where the sums are least, by a parabola in the logarithm of the width."""
    at = int(np.argmin(sums))
    if at in (0, len(sums) - 1):
        return float(widths[at])
    x = np.log(widths[at - 1 : at + 2])
    a, b, _ = np.polyfit(x - x[1], sums[at - 1 : at + 2], 2)
    return float(np.exp(np.clip(x[1] - b / (2.0 * a), x[0], x[2]))) if a > 0 else float(widths[at])


class _Plays:
    """Plays of one channel on the coarse series, everything else of the model projected out."""

    def __init__(self, search: Search, material: Material, option: Option) -> None:
        self.search, self.material, self.option = search, material, option
        self.series = material.series
        values = self.series[option.channels[0]]
        low, high = np.nanquantile(values, [0.02, 0.98])
        self.widths = _WIDTHS * float(high - low)
        others = [one for one in search.accepted if one is not option and one.change is None]
        keys = {key for one in others for key in one.terms}
        self.kept = [*search.library.refined, *(material.terms[key] for key in sorted(keys))]
        self.direct = material.terms[option.terms[0]] if len(option.terms) > 1 else None
        self.rows = self._rows([*search.library.base, *self.kept, *([self.direct] if self.direct else [])])
        base = self._flat(search.library.base)
        self.block = np.repeat(self.series.block, self.rows.residual.shape[1])
        self.groups = [np.isin(self.block, np.asarray(group)) for group in search.intervals]
        self.basis = [np.linalg.qr(base[group])[0] for group in self.groups] if base.shape[1] else []
        weight = np.sqrt(np.repeat(self.rows.weight, self.rows.residual.shape[1]))
        self.y = self._absorbed((self.rows.residual.reshape(-1) * weight)[:, None])
        self.model = self._absorbed(self._flat(self.kept))
        self.own = self._absorbed(self._flat([self.direct])) if self.direct else np.zeros((len(self.y), 0))

    def _rows(self, terms: Sequence[Term]) -> Rows:
        channels = {name for term in terms for name in term.entry.effect.channels if name}
        return self.series.rows(self.material.turn, made_channels(self.series, channels))

    def _flat(self, terms: Sequence[Term], rows: Rows | None = None) -> Floats:
        used = rows or self.rows
        columns = design(terms, used)
        root = np.sqrt(used.weight)[:, None, None]
        return np.asarray((columns * root).reshape(root.size * columns.shape[1], columns.shape[2]))

    def _absorbed(self, values: Floats) -> Floats:
        out = values.copy()
        for group, basis in zip(self.groups, self.basis, strict=False):
            out[group] -= basis @ (basis.T @ values[group])
        return out

    def best(self, direct: bool) -> float:
        """Return the width that leaves least: on the whole grid, then on a finer one around the best."""
        grid = self.widths
        width = 0.0
        for _ in range(2):
            width = _lowest(grid, np.array([self.left(one, direct).sum() for one in grid]))
            grid = width * np.geomspace(0.85, 1.18, 7)
        return float(f"{width:.4g}")

    def term(self, width: float, key: str) -> Term:
        """Return the play of one width."""
        source = self.option.terms[-1]
        return _term(self.search, self.material, source, key, {"width": width}, ("play",))

    def left(self, width: float, direct: bool) -> Floats:
        """Return what a play leaves in each block, with or without the channel itself; (block,) nT^2."""
        term = self.term(width, f"{self.option.mechanism}@trial")
        play = self._absorbed(self._flat([term], self._rows([term])))
        columns = np.concatenate([self.model, play, *([self.own] if direct else [])], axis=1)
        value = np.linalg.lstsq(columns.T @ columns, columns.T @ self.y[:, 0], rcond=1e-12)[0]
        rest = self.y[:, 0] - columns @ value
        return np.asarray(
            np.bincount(self.block, weights=rest**2, minlength=len(self.search.raw)), dtype=np.float64
        )


def _term(
    search: Search,
    material: Material,
    source: str,
    key: str,
    options: dict[str, Any],
    parameters: tuple[str, ...],
) -> Term:
    """Return a term like another one with other options."""
    entry = search.library.terms[source].entry
    given = {name: value for name, value in entry.effect.given.items() if name not in ("lag", "width")}
    wanted = {"effect": type(entry.effect).label(), "sensor": entry.sensor.name, **given, **options}
    made = make_effect(
        wanted, sensors_of(material.mission, material.model.comparison), material.model.own, material.mission
    )
    size = sum(made.effect.parameters()[name].size for name in parameters)
    return Term(key, made, parameters, (np.inf,) * size)


def _joined(
    search: Search, material: Material, option: Option, terms: list[Term], key: str, lag: float
) -> Option:
    """Return the option with other terms, their columns in the evidence and it among the candidates."""
    made = replace(
        option, name=key, terms=tuple(term.key for term in terms), columns=tuple(terms[0].columns), lag_s=lag
    )
    if key not in search.library.terms:
        join_terms(search, material, terms)
    search.options.append(made)
    return made
