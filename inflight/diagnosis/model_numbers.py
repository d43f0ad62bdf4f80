"""Numbers that the model holds and no fit may move: lags, widths, reference values, turns, delays.

Takes the mission and a model; makes a `HeldNumber` of everything that is written in an option of an effect,
in its channel's name, or in the mission file, and that its field depends on otherwise than in proportion
(`held_numbers`), the effects with such a number at another value (`effects_at`), and the term whose column is
what the number does (`difference_of`): between values close to it a derivative, between the value that is
held and another one the whole change. `line_of` says which command, or which line of which file, mends it.

A delay of a magnetometer itself is the clock's (`time_shift`; `inflight.diagnosis.stamps` says how else it
may be read). Periods are no such numbers: what a wrong one leaves is seen in a phase that runs away.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import scipy

from inflight.design import SENSOR_EQUATIONS, ChannelSummary, Difference, HeldNumber, Term
from inflight.effects import NO_CAUSE
from inflight.frames import GEOMETRY, SLOW_GEOMETRY
from inflight.mission import Mission, sensors_of
from inflight.model import Model, ModelEffect, make_effect
from inflight.samples import ChannelFactor, DerivedChannel, parse_channel
from inflight.time import SECOND

#: Longest lag and delay that are plausible, s (assumed: a body that warms for some hours).
LONGEST_S = 8000.0

#: Parts of themselves that the derivatives of lags, widths and reference values are made over (assumed).
STEP_PART = 0.05

#: Degrees that panels are turned by for a derivative, and that they may plausibly be turned by (assumed).
TURN_DEG, FARTHEST_DEG = 0.5, 45.0

#: Numbers of a factor of a channel's name: option, field of `ChannelFactor`, unit.
_OF_FACTOR = {"lag": "lag_s", "delay": "delay_s", "width": "width", "about": "about"}

#: How a panel's normals may be turned: about the axes of their vectors.
_TURNS = {"turn_x": (1.0, 0.0, 0.0), "turn_y": (0.0, 1.0, 0.0), "turn_z": (0.0, 0.0, 1.0)}


def held_numbers(
    mission: Mission,
    model: Model,
    channels: Mapping[str, ChannelSummary],
    cadence_s: float,
    unlagged: frozenset[str] = frozenset(),
) -> list[HeldNumber]:
    """Return the numbers that effects of a model hold; those of the mission file come last.

    Parameters
    ----------
    channels : mapping of str to ChannelSummary
        Every channel of one number a time: how far it ranges is how far a reference value may be off.
    cadence_s : float
        Of the samples that columns are made of, s: a delay's derivative is made over one of them.
    unlagged : frozenset of str
        Channels between whose samples there is no time.
    """
    own = [entry for entry in model.effects if not isinstance(entry.effect, SENSOR_EQUATIONS)]
    found = [
        number
        for entry in own
        for number in (*_of_channel(entry, channels, cadence_s, unlagged), *_of_options(entry, channels))
    ]
    names = {number.name for number in found}
    return [*found, *(one for one in _of_mission(mission, own, cadence_s, unlagged) if one.name not in names)]


def _of_channel(
    entry: ModelEffect, channels: Mapping[str, ChannelSummary], cadence_s: float, unlagged: frozenset[str]
) -> Iterator[HeldNumber]:
    """Yield the numbers of the channel that an effect follows: its slow response, play, difference, delay."""
    factors = _factors(entry)
    for place, factor in enumerate(factors):
        name, spread = factor.channel, channels[factor.channel].spread if factor.channel in channels else 0.0
        reach = spread or abs(factor.about)
        width = factor.width or float(entry.effect.given.get("width") or 0.0) * (len(factors) == 1)
        timeless = name in unlagged or (name in GEOMETRY and name not in SLOW_GEOMETRY)
        values = {
            "lag": None if timeless else factor.lag_s,
            "delay": factor.delay_s or None,
            "width": width or None,
            "about": factor.about or None,
        }
        steps = {
            "lag": max(STEP_PART * factor.lag_s, cadence_s),
            "delay": cadence_s,
            "width": STEP_PART * width,
            "about": STEP_PART * reach,
        }
        bounds = {
            "lag": (0.0, LONGEST_S),
            "delay": (-LONGEST_S, LONGEST_S),
            "width": (0.0, max(spread, 2.0 * width)),
            "about": (factor.about - 2.0 * reach, factor.about + 2.0 * reach),
        }
        for key, value in values.items():
            if value is not None:
                label = f"{entry.name}.{key}" + (f"[{name}]" if len(factors) > 1 else "")
                unit = "s" if key in ("lag", "delay") else ""
                yield HeldNumber(
                    name=label,
                    key=key,
                    effects=((entry.name, place),),
                    channel=name,
                    value=value,
                    unit=unit,
                    step=steps[key],
                    bounds=bounds[key],
                )


def _of_options(entry: ModelEffect, channels: Mapping[str, ChannelSummary]) -> Iterator[HeldNumber]:
    """Yield turns of panels, and reference values: parameters of one number that no fit ever moves."""
    common: dict[str, Any] = {"effects": ((entry.name, 0),), "channel": ""}
    for key in _TURNS if "normals" in entry.effect.given else ():
        yield HeldNumber(
            name=f"{entry.name}.{key}",
            key=key,
            value=0.0,
            unit="deg",
            step=TURN_DEG,
            bounds=(-FARTHEST_DEG, FARTHEST_DEG),
            **common,
        )
    spread = max(
        (channels[one.channel].spread for one in _factors(entry) if one.channel in channels), default=0
    )
    for key, timed in entry.parameters.items():
        kind = entry.effect.parameters()[key]
        held = timed.time == "constant" and kind.axes is None and not np.isfinite(kind.sigma)
        if held and spread and not (timed.free and np.all(timed.sigma > 0)):
            value = float(timed.value[0, 0])
            yield HeldNumber(
                name=f"{entry.name}.{key}",
                key=key,
                value=value,
                unit=timed.parameter.unit,
                step=STEP_PART * spread,
                bounds=(value - 2.0 * spread, value + 2.0 * spread),
                **common,
            )


def _of_mission(
    mission: Mission, effects: list[ModelEffect], cadence_s: float, unlagged: frozenset[str]
) -> Iterator[HeldNumber]:
    """Yield the lags that the mission states of the channels that some effects follow."""
    for instrument, name, channel in mission.channel_instruments():
        if channel.kind in NO_CAUSE or name in unlagged:
            continue
        used = tuple(
            (entry.name, place)
            for entry in effects
            for place, factor in enumerate(_factors(entry))
            if factor.channel == name
        )
        if used:
            value = channel.lag / SECOND
            yield HeldNumber(
                name=f"{name}.lag",
                key="delay",
                effects=used,
                channel=name,
                value=value,
                unit="s",
                step=cadence_s,
                bounds=(value - LONGEST_S, value + LONGEST_S),
                path=f"instruments.{instrument}.channels.{name}.lag",
            )


def _factors(entry: ModelEffect) -> tuple[ChannelFactor, ...]:
    """Return the factors of the channel an effect follows; none of an effect without one."""
    first = entry.effect.channels[0] if entry.effect.channels else ""
    return parse_channel(first).parts if first else ()


def effects_at(number: HeldNumber, value: float, model: Model, mission: Mission) -> tuple[ModelEffect, ...]:
    """Return the effects that a number is in, with another value of it.

    Raises
    ------
    ModelError
        When an effect cannot have it.
    """
    entries: dict[str, dict[str, Any]] = {}
    for name, place in number.effects:
        tree = entries.setdefault(name, model.effect(name).as_yaml())
        # What a mission states of a channel is in the samples already: an effect sees the difference.
        given = value - number.value if number.path else value
        _write(tree, model.effect(name), number, given, place)
    sensors = sensors_of(mission, model.comparison)
    return tuple(make_effect(tree, sensors, model.own, mission) for tree in entries.values())


def _write(tree: dict[str, Any], entry: ModelEffect, number: HeldNumber, value: float, place: int) -> None:
    """Write a number into an effect's entry of the model."""
    key = number.key
    if key in entry.parameters:
        tree[key] = {**tree[key], "value": value}
    elif key in _TURNS:
        turn = scipy.spatial.transform.Rotation.from_rotvec(np.deg2rad(value) * np.array(_TURNS[key]))
        tree["normals"] = turn.apply(np.asarray(tree["normals"], dtype=np.float64)).tolist()
    elif key in ("lag", "width") and tree.get(key) is not None:
        tree[key] = value if key == "width" else f"{value:.12g} s"
    else:
        text = str(tree.get("channel") or type(entry.effect).channels[0])
        parts = list(parse_channel(text).parts)
        field = _OF_FACTOR[key]
        before = parts[place].delay_s if number.path else 0.0
        changed: dict[str, Any] = {field: before + value, "text": ""}
        parts[place] = replace(parts[place], **changed)
        tree["channel"] = DerivedChannel(tuple(parts)).name


def difference_of(
    number: HeldNumber,
    model: Model,
    mission: Mission,
    value: float | None = None,
    key: str = "",
    around: float | None = None,
) -> Term:
    """Return the term of a number: its derivative, or what another value changes.

    Parameters
    ----------
    value : float, optional
        The column is what this value changes of the one that is held; the derivative when absent.
    key : str
        Of the term; the number's name when absent.
    around : float, optional
        Where the derivative is made; at the value that is held when absent.
    """
    middle = number.value if around is None else around
    ends = max(middle - number.step, number.bounds[0]), min(middle + number.step, number.bounds[1])
    low, high = ends if value is None else (number.value, value)
    made = [effects_at(number, one, model, mission) for one in (low, high)]
    difference = Difference(number, made[0], made[1], (low, high))
    return Term(key or number.name, made[1][0], (), (np.inf,), difference=difference)


def rounded(value: float, sigma: float) -> str:
    """Return a value to a tenth of its error, as text."""
    if not 0.0 < sigma < abs(value):
        return f"{value:.3g}"
    return f"{value:.{int(np.clip(np.ceil(np.log10(abs(value) / sigma)) + 1, 3, 12))}g}"


def line_of(number: HeldNumber, value: float, sigma: float = 0.0) -> str:
    """Return the command that gives a number of the model another value, or the line of the mission file."""
    text = f"{rounded(value, sigma)}{' s' if number.unit == 's' else ''}"
    if number.path:
        return f"mission.yaml: {number.path}: {text}"
    return f'inflight set "{number.name}={text.replace(" ", "")}"'


def words_of(number: HeldNumber, value: float, sigma: float, unit: str) -> str:
    """Return what the data say of a number."""
    what = {"about": "reference value", "delay": "delay"}.get(number.key, number.key)
    effects = " and ".join(dict.fromkeys(name for name, _ in number.effects))
    whose = f" of {number.channel}" if number.channel else ""
    if number.path:
        text, where = f"the lag{whose} in the mission file", f" ({number.path}; used by {effects})"
    else:
        text, where = f"the {what}{whose} in {effects}", f" ({number.name})"
    unit = f" {unit}" if unit else ""
    says = f"the data say {rounded(value, sigma)} +- {sigma:.2g}{unit}"
    if number.key in _TURNS:
        return f"the panels of {effects} are turned about {number.key[-1]}, {says} more{where}"
    return f"{text} is {number.value:.6g}{unit}, {says}{where}"
