"""The form of what was taken, before the next effect is sought: its lag, its width, its moment.

An effect in a form that is nearly right leaves a remnant that wrong companions would explain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from inflight.arrays import Floats
from inflight.derived import Derived, parse
from inflight.diagnosis.candidates import SLOW
from inflight.diagnosis.lags import jackknife
from inflight.diagnosis.library import Term
from inflight.diagnosis.material import Material
from inflight.diagnosis.moments import at_its_moment
from inflight.diagnosis.rivalry import hac_t
from inflight.diagnosis.scoring import folds_of
from inflight.diagnosis.search import Option, Search
from inflight.diagnosis.second import can_join, join_terms
from inflight.diagnosis.trials import Trials, like
from inflight.geometry import GEOMETRY, SLOW_GEOMETRY

#: A lag is refined when it is off by more than this part.
_NEAR = 0.02
#: Widths tried, as parts of the channel's range, and lags from this part of a row's spacing up to this, s.
_WIDTHS = np.geomspace(0.02, 0.9, 16)
_SHORTEST, _LONGEST, _RESPONSES = 0.5, 8000.0, 12
#: The channel itself stays beside its play when it helps by more than this t.
_NEEDED = 2.0


def refine(search: Search, material: Material, option: Option) -> Option:
    """Return the option in its best form; the option itself when the bank has it already.

    The new columns join the evidence, from the coarse series.
    """
    if not can_join(search, material):
        return option
    if option.change is not None:
        return at_its_moment(search, material, option)
    if not option.channels or set(option.channels) & search.library.unlagged:
        return option
    return _of_channel(search, material, option)


def _of_channel(search: Search, material: Material, option: Option) -> Option:
    if option.mechanism.startswith("hysteresis("):
        return _with_width(search, material, option)
    if option.mechanism.split("(")[0] in SLOW and len(option.channels) == 1:
        return _with_lag(search, material, option)
    if len(option.terms) == 1:
        return _with_response(search, material, option)
    return option


def _with_lag(search: Search, material: Material, option: Option) -> Option:
    """Return the option with the lag that explains most; without one when that is not clearly more."""
    source = search.library.terms[option.terms[0]]
    trials = Trials(search, material, option)

    def term(lag: float, key: str = "trial") -> Term:
        given = {"lag": f"{lag:g} s"} if lag else {}
        return like(search, material, source, key, given, source.parameters)

    def left(lag: float) -> Floats:
        return trials.left([term(lag)])

    best, sigma = _best_lag(search, material, left)
    if float(hac_t((left(0.0) - left(best))[:, None])[0]) < search.rules.t:
        plain = [one for one in search.options if one.mechanism == option.mechanism and one.lag_s == 0.0]
        return plain[0] if plain else option
    if abs(best - option.lag_s) <= _NEAR * best:
        return option
    return _joined(search, material, option, term(best, f"{option.mechanism}@lag={best:g}s"), best, sigma)


def _best_lag(
    search: Search, material: Material, left: Callable[[float], Floats]
) -> tuple[float, float | None]:
    """Return the lag that leaves least, s, and its error by leaving out folds of blocks."""
    lags = np.geomspace(_SHORTEST * material.series.step_s, _LONGEST, _RESPONSES)
    best = _least(lags, left, (0.7, 1.43))
    beside = best * np.array([0.9, 1.0, 1.0 / 0.9])
    each = np.stack([left(float(one)) for one in beside])
    total = each.sum(axis=1)
    folds = folds_of(each.shape[1])
    others = [_vertex(np.log(beside), total - each[:, fold].sum(axis=1)) for fold in folds]
    if not np.all(np.isfinite(others)):
        return best, None
    return best, best * jackknife(others)


def _with_response(search: Search, material: Material, option: Option) -> Option:
    """Return an effect whose channel, or a factor of it, acts slowly, when that explains clearly more."""
    made = option
    parts = _channel_of(search.library.terms[option.terms[0]]).parts
    if any(part.channel not in material.series.channels or part.width for part in parts):
        return option
    for place, part in enumerate(parts):
        if part.channel not in GEOMETRY or part.channel in SLOW_GEOMETRY:
            made = _slower(search, material, option, made, place)
    return made


def _channel_of(term: Term) -> Derived:
    """Return the one channel an effect follows, as option `channel` may name it; without parts if none."""
    channel = term.entry.effect.given.get("channel")
    return parse(channel) if isinstance(channel, str) else Derived(())


def _slower(search: Search, material: Material, option: Option, now: Option, place: int) -> Option:
    """Return the option with the best lag of one factor of its channel; the present one if none is better."""
    source = search.library.terms[now.terms[0]]
    parts = list(_channel_of(source).parts)
    old = parts[place].lag_s
    trials = Trials(search, material, option)

    def term(lag: float, key: str) -> Term:
        parts[place] = replace(parts[place], lag_s=lag, text="")
        return like(search, material, source, key, {"channel": Derived(tuple(parts)).name}, source.parameters)

    def left(lag: float) -> Floats:
        return trials.left([term(lag, f"{option.mechanism}@trial")])

    best, sigma = _best_lag(search, material, left)
    if old and abs(best - old) <= _NEAR * old:
        return now
    before, after = trials.left([source]), left(best)
    gained = before - after
    worth = (
        float(hac_t(gained[:, None])[0]) > search.rules.t and gained.sum() > search.rules.gain * before.sum()
    )
    if not (worth or (old and gained.sum() > 0)):
        return now
    made = term(best, "")
    name = made.entry.effect.channels[0]
    key = (
        f"{option.mechanism}@lag={best:g}s"
        if len(parts) == 1
        else f"{type(made.entry.effect).label()}({name})"
    )
    return _joined(search, material, option, replace(made, key=key), best, sigma)


def _with_width(search: Search, material: Material, option: Option) -> Option:
    """Return the play of the best width, with the channel itself where it is needed."""
    trials = Trials(search, material, option)
    source = search.library.terms[option.terms[-1]]
    direct = [search.library.terms[option.terms[0]]] if len(option.terms) > 1 else []
    low, high = np.nanquantile(material.series[option.channels[0]], [0.02, 0.98])
    widths = _WIDTHS * float(high - low)

    def term(width: float, key: str) -> Term:
        return like(search, material, source, key, {"width": width}, ("play",))

    def left(width: float, beside: list[Term]) -> Floats:
        return trials.left([*beside, term(width, f"{option.mechanism}@trial")])

    alone = _least(widths, lambda width: left(width, []), (0.85, 1.18))
    width = _least(widths, lambda width: left(width, direct), (0.85, 1.18)) if direct else alone
    needed = bool(direct) and float(hac_t((left(alone, []) - left(width, direct))[:, None])[0]) > _NEEDED
    width = width if needed else alone
    key = f"{option.mechanism}@width={width:g}"
    made = _joined(search, material, option, term(width, key), 0.0)
    if not needed:
        return made
    whole = replace(made, terms=(direct[0].key, key), columns=(*direct[0].columns, *made.columns))
    search.options[-1] = whole
    return whole


def _least(grid: Floats, left: Callable[[float], Floats], around: tuple[float, float]) -> float:
    """Return where least is left: on the whole grid, then twice on finer ones around it; four digits."""
    best = 0.0
    for part in (1.0, 0.25, 0.0):
        best = _lowest(grid, np.array([left(float(one)).sum() for one in grid]))
        if part:
            grid = best * np.geomspace(*around, 7) ** part
    return float(f"{best:.4g}")


def _lowest(grid: Floats, sums: Floats) -> float:
    """Return where the sums are least, by a parabola in the logarithm."""
    at = int(np.argmin(sums))
    if at in (0, len(sums) - 1):
        return float(grid[at])
    x = np.log(grid[at - 1 : at + 2])
    found = _vertex(x, sums[at - 1 : at + 2])
    return float(np.exp(np.clip(found, x[0], x[2]))) if np.isfinite(found) else float(grid[at])


def _vertex(x: Floats, y: Floats) -> float:
    """Return where the parabola through three points is least; NaN when it opens downward."""
    a, b, _ = np.polyfit(x - x[1], y, 2)
    return float(x[1] - b / (2.0 * a)) if a > 0 else float("nan")


def _joined(
    search: Search,
    material: Material,
    option: Option,
    term: Term,
    lag: float,
    sigma: float | None = None,
) -> Option:
    """Return the option with another term, its columns in the evidence and it among the candidates."""
    made = replace(
        option, name=term.key, terms=(term.key,), columns=tuple(term.columns), lag_s=lag, lag_sigma_s=sigma
    )
    if term.key not in search.library.terms:
        join_terms(search, material, [term])
    search.options.append(made)
    return made
