"""The form of what was taken: lags and widths between those of the bank, before the next effect is sought.

An effect in a form that is nearly right leaves a remnant that wrong companions would explain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from inflight.arrays import Floats
from inflight.derived import Derived, parse
from inflight.diagnosis.findings import lag_profile
from inflight.diagnosis.library import Term
from inflight.diagnosis.material import Material
from inflight.diagnosis.rivalry import hac_t
from inflight.diagnosis.search import Option, Search
from inflight.diagnosis.second import can_join, join_terms
from inflight.diagnosis.trials import Trials, like

#: A lag is refined when it is off by more than this part.
_NEAR = 0.02
#: Profiles of a lag at most: each new column makes the next one sharper.
_TURNS = 3
#: Widths tried, as parts of the channel's range, and lags from this part of a row's spacing up to this, s.
_WIDTHS = np.geomspace(0.02, 0.9, 16)
_SHORTEST, _LONGEST, _RESPONSES = 0.5, 8000.0, 12
#: The channel itself stays beside its play when it helps by more than this t.
_NEEDED = 2.0


def refine(search: Search, material: Material, option: Option) -> Option:
    """Return the option in its best form; the option itself when the bank has it already.

    The new columns join the evidence, from the coarse series.
    """
    if option.change is not None or not option.channels or not can_join(search, material):
        return option
    if option.mechanism.startswith("hysteresis("):
        return _with_width(search, material, option)
    if option.mechanism.startswith("channel_field(") and len(option.channels) == 1:
        return _with_lag(search, material, option)
    if len(option.terms) == 1:
        return _with_response(search, material, option)
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
    source = search.library.terms[option.terms[0]]
    term = like(search, material, source, key, {"lag": f"{lag:g} s"}, ("coefficient",))
    return _joined(search, material, option, term, lag)


def _with_response(search: Search, material: Material, option: Option) -> Option:
    """Return an effect whose channel, or a factor of it, acts slowly, when that explains clearly more."""
    made = option
    channel = search.library.terms[option.terms[0]].entry.effect.given.get("channel")
    parts = parse(channel).parts if isinstance(channel, str) else ()
    if any(part.channel not in material.series.channels or part.width for part in parts):
        return option
    for place in range(len(parts)):
        made = _slower(search, material, option, made, place)
    return made


def _slower(search: Search, material: Material, option: Option, now: Option, place: int) -> Option:
    """Return the option with the best lag of one factor of its channel; the present one if none is better."""
    source = search.library.terms[now.terms[0]]
    parts = list(parse(str(source.entry.effect.given["channel"])).parts)
    old = parts[place].lag_s
    trials = Trials(search, material, option)

    def term(lag: float, key: str) -> Term:
        parts[place] = replace(parts[place], lag_s=lag, text="")
        return like(search, material, source, key, {"channel": Derived(tuple(parts)).name}, source.parameters)

    def left(lag: float) -> Floats:
        return trials.left([term(lag, f"{option.mechanism}@trial")])

    lags = np.geomspace(_SHORTEST * material.series.step_s, _LONGEST, _RESPONSES)
    best = _least(lags, left, (0.7, 1.43))
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
    name = str(made.entry.effect.given["channel"])
    key = (
        f"{option.mechanism}@lag={best:g}s"
        if len(parts) == 1
        else f"{type(made.entry.effect).label()}({name})"
    )
    return _joined(search, material, option, replace(made, key=key), best)


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
    """Return where least is left: on the whole grid, then on a finer one around the best; four digits."""
    best = 0.0
    for _ in range(2):
        best = _lowest(grid, np.array([left(float(one)).sum() for one in grid]))
        grid = best * np.geomspace(*around, 7)
    return float(f"{best:.4g}")


def _lowest(grid: Floats, sums: Floats) -> float:
    """Return where the sums are least, by a parabola in the logarithm."""
    at = int(np.argmin(sums))
    if at in (0, len(sums) - 1):
        return float(grid[at])
    x = np.log(grid[at - 1 : at + 2])
    a, b, _ = np.polyfit(x - x[1], sums[at - 1 : at + 2], 2)
    return float(np.exp(np.clip(x[1] - b / (2.0 * a), x[0], x[2]))) if a > 0 else float(grid[at])


def _joined(search: Search, material: Material, option: Option, term: Term, lag: float) -> Option:
    """Return the option with another term, its columns in the evidence and it among the candidates."""
    made = replace(option, name=term.key, terms=(term.key,), columns=tuple(term.columns), lag_s=lag)
    if term.key not in search.library.terms:
        join_terms(search, material, [term])
    search.options.append(made)
    return made
