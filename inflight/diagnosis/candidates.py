"""Candidates of the library: every effect with every channel and coordinate it may depend on.

Takes the mission, the present model and what is known of each channel; makes the `Library` of terms and
candidates that a pass makes columns of (`make_library`): a bank of lags and widths of every channel,
geometry, the fixed parameters of the sensor, and placebos, the plain fields of shifted channels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from inflight.design import Candidate, ChannelSummary, Library, Term, term_of
from inflight.diagnosis.model_numbers import difference_of, held_numbers
from inflight.effects import Effect, channels_of, family_of, known_effects
from inflight.errors import InflightError
from inflight.frames import SHADOW, SHADOW_EDGES
from inflight.mission import Mission, Sensor, sensors_of
from inflight.model import Model, ModelEffect, make_effect
from inflight.samples import base_channels, parse_channel
from inflight.time import SECOND, parse_duration


@dataclass(frozen=True, kw_only=True)
class BankSettings:
    """Lags and widths that every channel is tried with.

    Attributes
    ----------
    lags : tuple of float
        First-order responses, s. They grow four times a step: combinations of neighbours reach what lies
        between to seven hundredths (tests/diagnosis/test_diagnosis_lags.py).
    widths : tuple of float
        Of the play operator, as parts of the channel's range; assumed, the best width is refined.
    placebo_lags : tuple of float
        Of placebos, s; assumed: fewer, for they only bound chance.
    """

    lags: tuple[float, ...] = (0.0, 60.0, 240.0, 1000.0, 4000.0)
    widths: tuple[float, ...] = (0.15, 0.4)
    placebo_lags: tuple[float, ...] = (0.0, 240.0)


BANK_SETTINGS = BankSettings()

#: Kinds of channels that may act on a sensor's scale or by hysteresis; currents do neither.
THERMAL = frozenset({"temperature", "other", "voltage"})

#: Effects that only such channels are tried with.
OF_THERMAL = frozenset({"channel_scale", "channel_angle", "channel_turn", "hysteresis"})

#: Effects that are tried with every lag: a field behind its channel, a body that warms after an eclipse.
SLOW = frozenset({"channel_field", "day_night"})

#: Effects that are tried with every lag of a channel that the model uses inside a sensor's equation.
OF_RESPONSE = frozenset({"channel_scale", "channel_angle", "channel_turn"})

#: Effects that the pass does not try by themselves: they need a time, which the search over blocks finds.
TIMED = frozenset(
    {"bias_step"}
    | {f"{kind}_{form}" for kind in ("offset", "scale", "angle", "clock") for form in ("step", "episode")}
)

#: Options that give one cause another form.
FORM = frozenset({"lag", "width", "degree", "order"})

#: Effects of so many columns that a single channel would outweigh all others; a user adds them by name.
WIDE = frozenset({"function_of_channel", "function_of_two", "tolles_lawson"})


def make_library(
    mission: Mission,
    model: Model,
    channels: Mapping[str, ChannelSummary],
    geometry: Sequence[str],
    shifts: Mapping[str, float],
    base: Sequence[Term],
    periods: tuple[float, float],
    fixed: Sequence[Term] = (),
    unlagged: frozenset[str] = frozenset(),
) -> Library:
    """Return everything that may be tried on a comparison.

    Parameters
    ----------
    model : Model
        The present model; what it holds free is refined, not tried.
    channels : mapping of str to ChannelSummary
        Every channel of one number a time.
    geometry : sequence of str
        Coordinates the samples hold, such as ``orbit_phase`` and ``sunlit``.
    shifts : mapping of str to float
        Placebo name -> seconds.
    base : sequence of Term
        The calibration's own terms.
    periods : tuple of float
        Shortest and longest period that can be seen, s.
    fixed : sequence of Term
        Parameters of the vector sensor that the model holds fixed.
    unlagged : frozenset of str
        Channels without lag, width and slow response: see `Library`.
    """
    # The model's own parameters that a stated sigma lets data refine.
    fitted = {term.entry.name for term in base}
    refined = [
        term
        for entry in model.effects
        if entry.name not in fitted
        and (term := term_of(entry, f"model:{entry.name}", free_only=True)).parameters
    ]
    library = Library(list(base), refined, placebos=dict(shifts), unlagged=unlagged)
    there = set(channels) | set(geometry)
    for label, kind in sorted(known_effects(model.own).items()):
        if label in TIMED or label in WIDE or label == "vector_sensor":
            continue
        try:
            options = kind.candidates(mission)
        except InflightError as error:
            library.unscorable.append({"name": label, "family": kind.family, "reason": error.message})
            continue
        for given in options:
            _add_effect(library, mission, model, label, given, there, channels, periods)
    for term in fixed:
        key = f"{term.key}.{term.parameters[0]}"
        own = replace(term, key=key)
        library.add(Candidate(key, key, "sensor", (), (key,)), [own])
    _add_numbers(library, mission, model, channels, 0.5 * periods[0])
    _add_placebos(library, mission, model, shifts)
    _add_edges(library, mission, model, there)
    return library


def _add_edges(library: Library, mission: Mission, model: Model, there: set[str]) -> None:
    """Add what is fitted beside all that follows the Earth's shadow; see `Library.edges`."""
    used = {name for entry in model.effects for name in entry.effect.channels if name}
    library.edged = any(SHADOW in base_channels(name) for name in used)
    # A channel of that name, which the mission delivers, knows the light.
    if SHADOW in channels_of(mission) or not there >= {SHADOW, *SHADOW_EDGES}:
        return
    sensors = acting_sensors(known_effects(model.own)["channel_field"], mission, model)
    for channel in SHADOW_EDGES:
        entry = {"effect": "channel_matrix", "sensor": sensors[0].name, "channel": channel}
        made = effect_or_none(entry, mission, model)
        if made is not None:
            library.edges.append(term_of(made, channel))


def _add_numbers(
    library: Library, mission: Mission, model: Model, channels: Mapping[str, ChannelSummary], cadence_s: float
) -> None:
    """Add the numbers that the model holds, each by its derivative."""
    known = {entry.name: entry for entry in model.effects}
    for number in held_numbers(mission, model, channels, cadence_s, library.unlagged):
        entry = known[number.effects[0][0]]
        bases = [one for name in entry.effect.channels if name for one in base_channels(name)]
        family = family_of(entry.effect, mission)
        try:
            term = difference_of(number, model, mission)
        except InflightError as error:
            library.unscorable.append({"name": number.name, "family": family, "reason": error.message})
            continue
        used = (number.channel,) if number.path else tuple(dict.fromkeys(bases))
        library.add(
            Candidate(number.name, number.name, family, used, (number.name,), number=number.name), [term]
        )


def _add_effect(
    library: Library,
    mission: Mission,
    model: Model,
    label: str,
    options: Mapping[str, Any],
    there: set[str],
    channels: Mapping[str, ChannelSummary],
    periods: tuple[float, float],
) -> None:
    """Add the candidates of one effect with one choice of options."""
    kind = known_effects(model.own)[label]
    for sensor in acting_sensors(kind, mission, model):
        entry = effect_or_none({"effect": label, "sensor": sensor.name, **options}, mission, model)
        if entry is None:
            continue
        used = [name for name in entry.effect.channels if name]
        missing = [name for name in used if name not in there]
        given = [str(value) for key, value in options.items() if key not in FORM]
        mechanism = f"{label}({', '.join(given)})" if given else label
        family = family_of(entry.effect, mission)
        if missing:
            library.unscorable.append(
                {"name": mechanism, "family": family, "reason": f"{', '.join(missing)} is not there"}
            )
            continue
        held = _in_model(model, entry)
        if held and label not in SLOW:
            continue
        if "period" in options:
            period = options["period"]
            seconds = parse_duration(period) / SECOND if isinstance(period, str) else float(period)
            if not periods[0] <= seconds <= periods[1]:
                continue
        # Of what the model has, another response is what it may lack.
        lags = [lag for lag in BANK_SETTINGS.lags if not held or lag != _lag_of(entry)]
        _add_forms(library, mission, model, label, dict(options), entry, mechanism, family, channels, lags)


def _add_forms(
    library: Library,
    mission: Mission,
    model: Model,
    label: str,
    options: dict[str, Any],
    entry: ModelEffect,
    mechanism: str,
    family: str,
    channels: Mapping[str, ChannelSummary],
    lags: Sequence[float],
) -> None:
    """Add an effect with every lag or width of its bank."""
    base = tuple(dict.fromkeys(one for name in entry.effect.channels if name for one in base_channels(name)))
    common: dict[str, Any] = {
        "mechanism": mechanism,
        "family": family,
        "channels": base,
        # A period that the mission states has its cause.
        "agnostic": entry.effect.empirical and "period" not in options,
    }
    lone = options.get("channel", "")
    if label in OF_THERMAL and lone in channels and channels[lone].kind not in THERMAL:
        return
    given = {"effect": label, "sensor": entry.sensor.name, **options}
    slow = label in SLOW or (label in OF_RESPONSE and lone in _inside_sensors(model))
    if slow and (lone in channels or not lone):
        for lag in lags if lone not in library.unlagged else [one for one in lags if not one]:
            made = effect_or_none(given | ({"lag": f"{lag:g} s"} if lag else {}), mission, model)
            if made is not None:
                term = term_of(made, f"{mechanism}@lag={lag:g}s" if lag else mechanism)
                library.add(Candidate(term.key, terms=(term.key,), lag_s=lag, **common), [term])
    elif label == "hysteresis" and lone in library.unlagged:
        return
    elif label == "hysteresis" and lone in channels:
        _add_plays(library, mission, model, given, channels[lone].spread, common)
    else:
        form = "".join(f"@{key}={options[key]}" for key in ("degree", "order") if key in options)
        term = term_of(entry, f"{mechanism}{form}")
        if term.parameters:
            library.add(Candidate(term.key, terms=(term.key,), **common), [term])


def _add_plays(
    library: Library,
    mission: Mission,
    model: Model,
    given: dict[str, Any],
    spread: float,
    common: dict[str, Any],
) -> None:
    """Add a channel with its play of several widths; its own columns are those of its plain field."""
    plain = effect_or_none(
        {"effect": "channel_field", "sensor": given["sensor"], "channel": given["channel"]}, mission, model
    )
    if plain is None:
        return
    direct = term_of(plain, f"channel_field({given['channel']})")
    for part in BANK_SETTINGS.widths:
        width = float(f"{part * spread:.3g}")
        made = effect_or_none(given | {"width": width}, mission, model)
        if made is not None:
            key = f"{common['mechanism']}@width={width:g}"
            own = Term(key, made, ("play",), (np.inf,) * 3)
            library.add(Candidate(key, terms=(direct.key, key), **common), [direct, own])


def _add_placebos(library: Library, mission: Mission, model: Model, shifts: Mapping[str, float]) -> None:
    """Add the plain field of shifted channels, with a few lags."""
    kind = known_effects(model.own)["channel_field"]
    sensors = acting_sensors(kind, mission, model)
    for name in shifts:
        channel, number = name.split("~")
        for lag in BANK_SETTINGS.placebo_lags if channel not in library.unlagged else (0.0,):
            derived = f"{channel}@lag={lag:g}s~{number}" if lag else name
            entry = effect_or_none(
                {"effect": "channel_field", "sensor": sensors[0].name, "channel": derived}, mission, model
            )
            if entry is None:
                continue
            term = term_of(entry, f"channel_field({derived})")
            library.add(
                Candidate(
                    term.key, f"channel_field({name})", "unknown", (name,), (term.key,), lag, False, True
                ),
                [term],
            )


def acting_sensors(kind: type[Effect], mission: Mission, model: Model) -> list[Sensor]:
    """The sensor an effect's candidates act on: one is enough, the data give the difference only."""
    sensors = list(sensors_of(mission, model.comparison).values())
    roles = getattr(kind, "acts_on", ("vector", "inboard", "scalar"))
    comparison = mission.comparisons[model.comparison].kind
    if kind.seen_in and comparison not in kind.seen_in:
        return []
    if comparison == "platform":
        # The vector sensor gives the direction only: whatever is seen is at the scalar sensor.
        roles = ("scalar",)
    for role in roles:
        found = [sensor for sensor in sensors if sensor.role == role]
        if found:
            return found[:1]
    return []


def effect_or_none(entry: Mapping[str, Any], mission: Mission, model: Model) -> ModelEffect | None:
    """Return the effect of an entry; None where the mission has not what it needs."""
    try:
        return make_effect(entry, sensors_of(mission, model.comparison), model.own, mission)
    except InflightError:
        return None


def _lag_of(entry: ModelEffect) -> float:
    """Return the lag an effect follows its channel with, s."""
    parts = parse_channel(entry.effect.channels[0]).parts if any(entry.effect.channels) else ()
    return float(parts[0].lag_s) if len(parts) == 1 else 0.0


def _inside_sensors(model: Model) -> set[str]:
    """Return the channels that the model uses inside a sensor's equation."""
    return {
        one
        for entry in model.effects
        if not entry.is_additive
        for name in entry.effect.channels
        if name
        for one in base_channels(name)
    }


def _in_model(model: Model, entry: ModelEffect) -> bool:
    """Return True when the model has this cause already and leaves it free."""
    for own in model.effects:
        same = type(own.effect) is type(entry.effect) and own.effect.channels == entry.effect.channels
        if same and own.effect.given == entry.effect.given and own.sensor.role == entry.sensor.role:
            return any(timed.free for timed in own.parameters.values())
    return False
