"""What is left: the residual with everything the model explains taken off, its sizes, its structure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.derived import Part, parse, product
from inflight.diagnosis.columns import Rows, design
from inflight.diagnosis.evidence import Evidence, solve_scaled
from inflight.diagnosis.library import Term
from inflight.diagnosis.search import Option, Search
from inflight.diagnosis.series import Series
from inflight.noise import NoiseFloor, joined_floor, level_of_rows
from inflight.time import DAY, SECOND

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
    search: Search, group: object, base: list[str], sigma: Floats, names: list[str], common: Floats
) -> Floats:
    if not base:
        return np.zeros(0)
    raw: Evidence = search.raw
    total = raw.gram[np.asarray(group)].sum(axis=0)
    inner, others, y = raw.index(base), raw.index(names), raw.residuals[search.residual]
    right = total[inner, y] + (total[np.ix_(inner, others)] @ common if names else 0.0)
    precision = search.precision(raw, base, sigma)
    return -solve_scaled(total[np.ix_(inner, inner)] + np.diag(precision), right)


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
