"""When exactly something changed: the moment of a step, begin and end of an episode, to a row of the series.

The search knows moments to a block. Beside everything else that was taken, a change of known size gains or
loses by every row it is moved over; the sum of these from row to row is what each moment would leave.
"""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.changes import Change, moment_text
from inflight.diagnosis.columns import design
from inflight.diagnosis.left import joint_values, model_columns, residual_left
from inflight.diagnosis.library import Term, within_span
from inflight.diagnosis.material import Material, correlation_s
from inflight.diagnosis.search import Option, Search
from inflight.diagnosis.second import join_terms
from inflight.time import SECOND, Int64, to_tt2000, to_utc

#: Size and moments are sought in turn, so many times at most.
_TURNS = 4
#: Moments are whole seconds where rows are at least so many seconds apart, else milliseconds.
_COARSE_S = 2.0
#: A moment that is known already is moved when it is off by more than this part of its error.
_NEAR = 0.5


def at_its_moment(search: Search, material: Material, option: Option) -> Option:
    """Return a step or an episode at the moment that leaves least; its columns join the evidence.

    Returns
    -------
    Option
        Its `change.sharpness` is the moment's standard deviation, the larger one of an episode's two. The
        option itself when it is a drift, or at that moment already.
    """
    change, carriers = option.change, _carriers(search, option)
    if change is None or not change.at or not carriers:
        return option
    at, sigma = _moments(search, material, option, carriers)
    moved = max(abs(new - old) for new, old in zip(at, change.at, strict=True))
    if option.terms and moved <= max(_NEAR * sigma, material.series.step_s * SECOND):
        return option
    made = _all_kinds(search, at, round(sigma))
    known = {one.name for one in search.options}
    terms = [_term(search, one) for one in made if one.name not in search.library.terms]
    if terms:
        join_terms(search, material, terms)
    search.options += [one for one in made if one.name not in known]
    return next(one for one in made if one.mechanism == option.mechanism)


def _all_kinds(search: Search, at: tuple[int, ...], sigma: int) -> list[Option]:
    """Return what may change at some moments: one at its moment must not be held against others at edges."""
    made = []
    form = "episode" if len(at) == 2 else "step"
    for kind, (family, carriers) in search.carriers.kinds.items():
        if form == "episode" and len(carriers) > 1:
            continue
        name = f"{kind}_{form}@{'/'.join(moment_text(one) for one in at)}"
        change = Change(name, f"{kind}_{form}", family, {}, at, sharpness=sigma)
        columns = tuple(dated_columns(_source(search, carriers), carriers, name))
        made.append(Option(name, change.mechanism, family, columns, terms=(name,), change=change))
    return made


def _carriers(search: Search, option: Option) -> tuple[str, ...]:
    found: tuple[str, ...] = getattr(search.carriers, option.mechanism.rsplit("_", 1)[0], ())
    return found


def _source(search: Search, carriers: tuple[str, ...]) -> Term:
    return next(term for term in search.library.all_terms if carriers[0] in term.columns)


def _term(search: Search, option: Option) -> Term:
    assert option.change is not None
    carriers = _carriers(search, option)
    return dated_term(_source(search, carriers), carriers, option.name, option.change.at)


def dated_term(source: Term, carriers: tuple[str, ...], name: str, at: tuple[int, ...]) -> Term:
    """Return the term of some columns of another one that hold from a moment on, or within a span."""
    suffixes = [one.removeprefix(f"{source.key}.") for one in carriers]
    parameters = tuple(dict.fromkeys(one.split("[")[0] for one in suffixes))
    size = sum(source.entry.effect.parameters()[one].size for one in parameters)
    return Term(name, source.entry, parameters, (np.inf,) * size, at)


def dated_columns(source: Term, carriers: tuple[str, ...], name: str) -> list[str]:
    """Return the columns of a dated term that are those of the carriers."""
    return [f"{name}.{one.removeprefix(f'{source.key}.')}" for one in carriers]


def _moments(
    search: Search, material: Material, option: Option, carriers: tuple[str, ...]
) -> tuple[tuple[int, ...], float]:
    """Return when a change begins, and ends if it does, TT2000, and the standard deviation, ns."""
    assert option.change is not None
    series, at = material.series, option.change.at
    beside, left, columns = _beside(search, material, option, carriers)
    noise = _noise(material, left)
    windows = [_window(search, option, place) for place in range(len(at))]
    sigma = 0.0
    for _ in range(_TURNS):
        inside = within_span(series.tt2000, at) & (series["weight"] > 0)
        if not inside.any():
            break
        flat = columns[inside].reshape(-1, columns.shape[2]), beside[inside].reshape(-1)
        with_it = beside - columns @ np.linalg.lstsq(*flat, rcond=None)[0]
        gained = np.sum(with_it**2 - beside**2, axis=1) * series["weight"]
        found = [
            _moment(series.tt2000, gained * (-1.0) ** place, window, noise)
            for place, window in enumerate(windows)
        ]
        before, at = at, tuple(_rounded(one[0], series.step_s) for one in found)
        sigma = max(one[1] for one in found)
        if at == before or (len(at) == 2 and at[0] >= at[1]):
            break
    return (
        (option.change.at, float(option.change.sharpness))
        if not sigma or list(at) != sorted(at)
        else (at, sigma)
    )


def _beside(
    search: Search, material: Material, option: Option, carriers: tuple[str, ...]
) -> tuple[Floats, Floats, Floats]:
    """Return the residual without and with an option, and its columns as if it held always.

    Each is (sample, row) or (sample, row, column).
    """
    rows, names, columns = model_columns(
        search, material.series, material.terms, material.turn, search.accepted
    )
    left = residual_left(search, material.series, material.terms, material.turn)
    taken = [name for one in search.accepted for name in one.columns]
    values, known = joint_values(search, taken)[0]
    value = dict(zip(known, values[len(values) - len(known) :], strict=True))
    own = columns[:, :, [names.index(name) for name in option.columns]]
    beside = left - own @ np.array([value[name] for name in option.columns])
    source = _source(search, carriers)
    every = design([source], rows)
    return beside, left, every[:, :, [source.columns.index(name) for name in carriers]]


def _noise(material: Material, left: Floats) -> float:
    """Return the variance of what a row adds to a sum over many, correlation with its neighbours counted."""
    series = material.series
    used = series["weight"] > 0
    memory = 2.0 * correlation_s(series, left) / series.step_s
    return float(np.mean(left[used] ** 2)) * max(memory, 1.0)


def _window(search: Search, option: Option, place: int) -> tuple[int, int]:
    """Return from when to when a moment may be: a block around it, or as far as it was known before."""
    assert option.change is not None
    at, raw = option.change.at, search.raw
    block = int(np.clip(np.searchsorted(raw.start, at[place], side="right") - 1, 0, len(raw) - 1))
    around = slice(max(block - 1, 0), block + 2)
    reach = max(option.change.sharpness, int(np.max(raw.end[around] - raw.start[around])))
    low, high = at[place] - reach, at[place] + reach
    if len(at) == 2:
        middle = at[0] + (at[1] - at[0]) // 2
        low, high = (low, min(high, middle)) if place == 0 else (max(low, middle), high)
    return low, high


def _moment(stamps: Int64, gained: Floats, window: tuple[int, int], noise: float) -> tuple[int, float]:
    """Return the median moment of those that leave little, and the root mean square of the others about it.

    Parameters
    ----------
    gained : ndarray, shape (sample,)
        By how much the residual's square grows when a row lies behind the moment, nT^2.
    noise : float
        Variance of a row, nT^2: it tells what is little.
    """
    first, last = np.searchsorted(stamps, window)
    places = np.arange(max(int(first), 1), min(int(last), len(stamps) - 1) + 1)
    if places.size < 2:
        return sum(window) // 2, (window[1] - window[0]) / np.sqrt(12.0)
    left = -np.concatenate([[0.0], np.cumsum(gained)])[places]
    width = (stamps[places] - stamps[places - 1]).astype(np.float64)
    offset = (stamps[places - 1] - stamps[0]) + 0.5 * width
    chance = width * np.exp(-(left - left.min()) / (2.0 * noise))
    chance /= chance.sum()
    passed = np.cumsum(chance)
    middle = int(np.searchsorted(passed, 0.5))
    part = (0.5 - passed[middle] + chance[middle]) / chance[middle]
    best = offset[middle] + (part - 0.5) * width[middle]
    spread = np.sum(chance * ((offset - best) ** 2 + width**2 / 12.0))
    return int(stamps[0]) + round(float(best)), float(np.sqrt(spread))


def _rounded(when: int, step_s: float) -> int:
    unit = "datetime64[s]" if step_s >= _COARSE_S else "datetime64[ms]"
    return int(to_tt2000(to_utc(when).astype(unit)))
