"""Additions bound to a time: drifts, steps and episodes of a sensor's parameters, a bias or a clock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.additions import Addition, Maker, names_of
from inflight.diagnosis.changes import moment_text
from inflight.diagnosis.columns import turns_of
from inflight.diagnosis.library import Term
from inflight.diagnosis.moments import dated_columns, dated_term
from inflight.diagnosis.refit import Column
from inflight.diagnosis.search import Option
from inflight.effects.vector_sensor import ANGLES
from inflight.errors import ModelError
from inflight.model import ModelEffect, make_effect
from inflight.sensors import sensors_of
from inflight.time import DAY, to_utc

#: Effect and parameter of a drift, its neutral values and unit, by what drifts.
_DRIFTING: dict[str, tuple[str, str, list[float], str]] = {
    "scale": ("affine", "matrix", np.eye(3).ravel().tolist(), "1/d"),
    "angle": ("affine", "matrix", np.eye(3).ravel().tolist(), "deg/d"),
    "offset": ("affine", "shift", [0.0, 0.0, 0.0], "nT/d"),
    "clock": ("time_shift", "seconds", [0.0], "s/d"),
    "bias": ("scalar_bias", "bias", [0.0], "nT/d"),
}


def addition_of(maker: Maker, option: Option) -> Addition:
    """Return the addition of what a search took."""
    if option.change is not None:
        if not option.change.at:
            return drift_of(maker, option.name)
        return step_of(maker, option.name.split("_")[0], option.change.at)
    candidates = {one.name: one for one in maker.library.candidates}
    if option.name in candidates:
        return maker.of_candidate(candidates[option.name])
    return maker.of_terms(option.name, [maker.library.terms[key] for key in option.terms])


def drift_of(maker: Maker, kind: str, name: str = "") -> Addition:
    """Return a drift straight in time: of scale factors, angles or offsets, of the scalar's clock or bias.

    It grows from nothing at the middle of the span; calibration intervals still have their own nine. Of
    the vector sensor's parameters it is an affine change of the reading before them.

    Raises
    ------
    ModelError
        When the comparison has no such parameters.
    """
    what = kind.removesuffix("_drift")
    columns = getattr(maker.carriers, what)
    if not columns:
        raise ModelError(f"this comparison has nothing that '{kind}' could be of", remedy="try another")
    middle = maker.raw.start / 2 + maker.raw.end / 2
    origin = float(middle.mean())
    days = (middle - origin) / DAY
    term = maker.carrier(columns[0])
    entry = _drifting(maker, what, name or maker.free_name(kind), term, int(origin))
    _, part, _, unit = _DRIFTING[what]
    if len(columns) == 1:
        titles, turn, values = [f"{entry.name}.{what}"], np.eye(1), [f"{entry.name}.{part}*b"]
    else:
        axes = ANGLES if what == "angle" else tuple("xyz")
        titles = [f"{entry.name}.{what}[{axis}]" for axis in axes]
        turn = _before_the_nine(maker, what, term) * (-np.deg2rad(1.0) if what == "angle" else 1.0)
        values = [f"{entry.name}.{part}[{2 * axis if what == 'scale' else axis}]*b" for axis in axes]
    made = tuple(Column(title, ((column, 1.0),), days) for title, column in zip(titles, columns, strict=True))
    gains = {value: _weighted(titles, row) for value, row in zip(values, turn, strict=True)}
    return Addition(kind, made, (entry,), (term,), gains=gains, unit=unit)


def _drifting(maker: Maker, what: str, name: str, term: Term, origin: int) -> ModelEffect:
    effect, part, neutral, _ = _DRIFTING[what]
    timed = {
        "time": "linear",
        "t0": f"{to_utc(origin)}Z",
        "per": "1 d",
        "value": [[one, 0.0] for one in neutral],
        "free": False,
    }
    told = {"effect": effect, "name": name, "sensor": term.entry.sensor.name, part: timed}
    return make_effect(told, sensors_of(maker.mission, maker.model.comparison), mission=maker.mission)


def _before_the_nine(maker: Maker, what: str, term: Term) -> Floats:
    """Return what changes of the sensor's own parameters are as changes of its reading; (3, 3).

    Rows are those of the reading: relative ones of its axes, or of angles of its own next to 90 deg. A
    change D of K (Yin 2010, eq. 2.5) is the reading's own change S before it, with ``K S = D``.
    """
    if what == "offset":
        return np.eye(3) * (1.0 if term.entry.effect.label() == "affine" else -1.0)
    own = term.entry.parameters
    kx, ky, _ = own["scale_factor"].value[:, 0]
    if what == "scale":
        return np.diag(1.0 / own["scale_factor"].value[:, 0])
    angles = np.deg2rad(own["misalignment"].value[:, 0])
    xy, xz, yz = np.sin(angles)
    across = -np.cos(angles[0]) * yz / (kx * ky)
    return np.array([[xy / kx, 0.0, 0.0], [0.0, xz / kx, across], [0.0, 0.0, yz / ky]])


def step_of(maker: Maker, kind: str, at: Sequence[int], name: str = "") -> Addition:
    """Return a step of a sensor's parameter, or an episode between two moments.

    At edges of blocks its columns are the sensor's own times a function of the block, else columns of
    their own.

    Parameters
    ----------
    kind : str
        ``offset``, ``scale``, ``angle``, ``bias`` or ``clock``.
    at : sequence of int
        TT2000: when it begins, and when it ends if it does.

    Raises
    ------
    ModelError
        When the comparison has no such parameter.
    """
    found = tuple(getattr(maker.carriers, kind))
    if not found:
        raise ModelError(f"this comparison has no {kind} that could change", remedy="try another")
    inside = maker.raw.start >= at[0]
    if len(at) == 2:
        inside = inside & (maker.raw.start < at[1])
    label = f"{kind}_{'episode' if len(at) == 2 else 'step'}"
    title = name or maker.free_name(f"{label}_{_stamp(at[0])}")
    entries = _dated(maker, kind, title, at, maker.carrier(found[0]))
    values = [names_of(entry, (_only(entry),)) for entry in entries]
    source, factor = maker.carrier(found[0]), inside.astype(np.float64)
    gains = _gains(maker, kind, values, source)
    told = f"{label}@{'/'.join(moment_text(when) for when in at)}"
    if set(at) <= {*maker.raw.start.tolist(), int(maker.raw.end[-1])}:
        parts = zip(values[0], found, strict=True)
        made = tuple(Column(one, ((column, 1.0),), factor) for one, column in parts)
        return Addition(told, made, entries, (source,), True, gains)
    parts = zip(values[0], dated_columns(source, found, told), strict=True)
    made = tuple(Column(one, ((column, 1.0),)) for one, column in parts)
    return Addition(told, made, entries, (dated_term(source, found, told, tuple(at)),), True, gains)


def _dated(maker: Maker, kind: str, title: str, at: Sequence[int], term: Term) -> tuple[ModelEffect, ...]:
    """Return the effects that say it; a bias that comes and goes is two steps."""
    sensors = sensors_of(maker.mission, maker.model.comparison)
    when = [f"{to_utc(one)}Z" for one in at]
    if kind != "bias" and len(at) == 2:
        told = [{"effect": f"{kind}_episode", "name": title, "from": when[0], "to": when[1]}]
    else:
        names = [title, f"{title}_end"]
        told = [
            {"effect": f"{kind}_step", "name": name, "at": one}
            for name, one in zip(names, when, strict=False)
        ]
    given: dict[str, Any] = {"sensor": term.entry.sensor.name}
    if kind in ("scale", "angle"):
        # The sensor's equation takes the offset off before it scales and turns.
        offset = term.entry.parameters["offset"].value[:, 0].tolist()
        given["about"] = {"value": offset, "free": False}
    return tuple(make_effect(one | given, sensors, mission=maker.mission) for one in told)


def _gains(
    maker: Maker, kind: str, values: Sequence[Sequence[str]], term: Term
) -> dict[str, tuple[tuple[str, float], ...]]:
    """Return how the model's values follow from those of the carrier's columns."""
    first = values[0]
    turn = np.eye(len(first))
    if kind == "offset":
        turns = turns_of(maker.model, int(maker.raw.start[0]))
        # Behind the sensor's equation a step of its offset is that step through K.
        affine = term.entry.effect.label() == "affine"
        turn = -np.eye(3) if affine else np.reshape(turns.get(term.entry.sensor.name, np.eye(3)), (3, 3))
    elif kind in ("scale", "angle"):
        turn = _before_the_nine(maker, kind, term)
    gains = {}
    for sign, names in zip((1.0, -1.0), values, strict=False):
        for row, name in enumerate(names):
            gains[name] = _weighted(first, sign * turn[row])
    return gains


def _weighted(names: Sequence[str], weights: Floats) -> tuple[tuple[str, float], ...]:
    return tuple((name, float(weight)) for name, weight in zip(names, weights, strict=True))


def _only(entry: ModelEffect) -> str:
    return next(iter(type(entry.effect).parameters()))


def _stamp(when: int) -> str:
    """Return a moment as a part of a name."""
    return "".join(c for c in str(to_utc(when))[:16] if c.isalnum())
