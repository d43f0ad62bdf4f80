"""What a user asks to add to a model: a name, a channel, or an entry of the model's file, made an addition.

Takes text or a mapping as `inflight add` gets it; makes a `Request` (`find_request`): the addition, and the
same with every lag of its bank, from which `best_lag` chooses when no lag is stated. `addition_of_entry`
does the same for an effect of a later version of the model, so that it can be fitted again.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from inflight.design import SENSOR_EQUATIONS, Candidate, term_of
from inflight.diagnosis.additions import (
    Addition,
    AdditionMaker,
    Column,
    FitSetup,
    drift_of,
    step_of,
    wander_of,
)
from inflight.diagnosis.refine import profile_lag
from inflight.diagnosis.scoring import fit, make_folds
from inflight.diagnosis.time_changes import DRIFTS, block_length, lines_between_windows
from inflight.effects import channels_of, known_effects, position_channel
from inflight.errors import ModelError, did_you_mean
from inflight.frames import GEOMETRY
from inflight.mission import Mission, sensors_of
from inflight.model import Model, ModelEffect, TimedValue, make_effect
from inflight.samples import base_channels, parse_channel
from inflight.time import SECOND, parse_duration, parse_utc, to_tt2000

_LAG = re.compile(r"^(?P<mechanism>.+)@lag=(?P<lag>[^@]+)$")

_TIMED = re.compile(
    r"^(?P<kind>offset|scale|angle|bias|clock)_(?:step|episode)@(?P<at>[^/]+)(?:/(?P<end>.+))?$"
)

#: An effect of a channel as a search names it: of a product, with a lag or a width of its own.
_MADE = re.compile(r"^(?P<effect>\w+)\((?P<channel>[^()]+)\)(?:@(?P<form>lag|width)=(?P<size>[^@]+))?$")

#: What is added for what it looks like: a line by its period.
_TONE = re.compile(r"^tone\((?P<period>[^(),]+)(?:,\s*order=(?P<order>\d+))?\)$")

#: A parameter that drifts irregularly, by the length of the windows that follow it.
_WANDER = re.compile(r"^wander\((?P<of>[^(),]+),\s*(?P<window>[^(),]+)\)$")

#: What may change at a time.
_KINDS = ("offset", "scale", "angle", "bias", "clock")

#: Names listed in a remedy at most.
_LISTED = 12


@dataclass(frozen=True)
class Request:
    """What a user asks to add.

    Attributes
    ----------
    addition : Addition
    bank : dict of float to Addition
        The same with every lag of its bank, when no lag is stated; else empty.
    """

    addition: Addition
    bank: Mapping[float, Addition]
    maker: AdditionMaker
    candidate: Candidate | None = None

    def at_lag(self, lag_s: float) -> Addition:
        """Return the addition with another lag, seconds."""
        return self.maker.of_candidate(self.candidate, lag_s=lag_s) if self.candidate else self.addition


def find_request(maker: AdditionMaker, effect: str | Mapping[str, Any]) -> Request:
    """Return what a user asks to add.

    Parameters
    ----------
    effect : str or mapping
        A candidate's name or mechanism, an effect, a channel, a drift, a step or episode with its time;
        or an entry of the model's file, as text or mapping.

    Raises
    ------
    ModelError
        When nothing is called so, or several things are.
    """
    given = parse_entry(effect)
    if not isinstance(given, str):
        return Request(_addition_of_text(maker, given), {}, maker)
    if (known := _shape_in_time(maker, given)) is not None:
        return Request(known, {}, maker)
    candidate, lag = _candidate(maker, given)
    if candidate is None:
        # An effect as a search names it; its channel carries the lag.
        entry, match = {"effect": given}, _MADE.match(given)
        if match is not None:
            channel, size = match["channel"], match["size"]
            entry = {"effect": match["effect"], "channel": channel}
            if match["form"] == "lag":
                entry["channel"] = f"{channel}@lag={size}"
            elif match["form"]:
                entry[match["form"]] = size
        return Request(_addition_of_text(maker, entry), {}, maker)
    if lag is not None:
        return Request(maker.of_candidate(candidate, lag_s=lag), {}, maker)
    bank = {one: maker.of_candidate(other) for one, other in maker.bank(candidate).items()}
    return Request(maker.of_candidate(candidate), bank, maker, candidate)


def _shape_in_time(maker: AdditionMaker, given: str) -> Addition | None:
    """Return the addition of a drift, of a step or episode with its time, or of a line; else None."""
    if given in DRIFTS:
        return drift_of(maker, given)
    if timed := _TIMED.match(given):
        at = np.array([_parse_time(given, timed[key]) for key in ("at", "end") if timed[key]])
        # A time within a second of an edge of blocks is that edge.
        edges = np.append(maker.raw.start, maker.raw.end[-1])
        nearest = edges[np.argmin(np.abs(edges - at[:, None]), axis=1)]
        at = np.where(np.abs(nearest - at) < SECOND, nearest, at)
        return step_of(maker, timed["kind"], _lasting(maker, given, at.tolist()))
    if tone := _TONE.match(given):
        order = {"order": int(tone["order"])} if tone["order"] else {}
        return _addition_of_text(maker, {"effect": "tone", "period": tone["period"].strip()} | order)
    if wander := _WANDER.match(given):
        width = _parsed(given, wander["window"].strip(), parse_duration, "wander(scale_factor[z], 2 d)")
        blocks = max(round(width / block_length(maker.raw)), 1)
        return wander_of(maker, wander["of"].strip(), lines_between_windows(maker.raw, blocks))
    return None


def _lasting(maker: AdditionMaker, name: str, at: list[int]) -> list[int]:
    """Return when a change begins, and ends if it does: what reaches an end of the record is a step."""
    if len(at) < 2:
        return at
    inner = [when for when in at if maker.raw.start[0] < when < maker.raw.end[-1]]
    if not inner:
        raise ModelError(
            f"{name!r} lasts as long as the record: nothing changes in it", remedy="state times within it"
        )
    return inner


def parse_entry(effect: str | Mapping[str, Any]) -> str | dict[str, Any]:
    """Return an entry of the model's file as a mapping, any other text as it is.

    ``= FORMULA`` is the entry of a `formula_field`.

    Raises
    ------
    ModelError
        When it is neither.
    """
    if not isinstance(effect, str):
        return dict(effect)
    if effect.lstrip().startswith("="):
        return {"effect": "formula_field", "formula": effect.strip().removeprefix("=").strip()}
    if "effect:" not in effect:
        return effect.strip()
    try:
        tree = YAML(typ="safe").load(effect)
    except YAMLError as error:
        raise ModelError(f"{effect!r} is no YAML: {error}", remedy="write {effect: NAME, ...}") from None
    tree = tree[0] if isinstance(tree, list) and len(tree) == 1 else tree
    if not isinstance(tree, dict):
        raise ModelError(f"{effect!r} is no entry of a model", remedy="write {effect: NAME, ...}")
    return tree


def _candidate(maker: AdditionMaker, name: str) -> tuple[Candidate | None, float | None]:
    """Return the candidate of a name, and its lag when one is stated that the bank has not."""
    own = name.partition("@")[0]
    if any(one.number == own for one in maker.library.candidates if one.number):
        raise ModelError(
            f"{own!r} is a number that is held already, and no effect",
            remedy="give it another value by 'inflight set' or in the mission file, as 'diagnose' says",
        )
    real = [one for one in maker.library.candidates if not one.placebo]
    found = [one for one in real if name in (one.name, one.mechanism)]
    if found:
        return found[0], None
    if lagged := _LAG.match(name):
        bank = [one for one in real if one.mechanism == lagged["mechanism"] and maker.bank(one)]
        if bank:
            return bank[0], _parsed(name, lagged["lag"], parse_duration, "@lag=600s") / SECOND
    mechanisms = list(dict.fromkeys(one.mechanism for one in real))
    similar = [one for one in mechanisms if one.startswith(f"{name}(") or one == f"channel_field({name})"]
    if len(similar) == 1:
        return next(one for one in real if one.mechanism == similar[0]), None
    if len(similar) > 1:
        listed = ", ".join(similar[:_LISTED])
        raise ModelError(f"{name!r} may be {len(similar)} things", remedy=f"name one of {listed}")
    made = _MADE.match(name)
    if (made["effect"] if made else name) in known_effects(maker.model.own):
        return None, None
    raise _unknown_name(maker, name, mechanisms)


def _unknown_name(maker: AdditionMaker, name: str, mechanisms: Sequence[str]) -> ModelError:
    dead = {one["name"]: one["reason"] for one in maker.library.unscorable}
    if name in dead:
        return ModelError(f"{name!r} cannot be tried: {dead[name]}", remedy="these data cannot show it")
    known = [*channels_of(maker.mission), *mechanisms, *DRIFTS, *known_effects(maker.model.own)]
    return ModelError(
        f"there is no candidate {name!r}{did_you_mean(name, known)}",
        remedy="'inflight diagnose' lists candidates; or give an entry, such as "
        "'{effect: channel_field, channel: NAME}'",
    )


def _parsed(name: str, text: str, parse: Callable[[str], Any], example: str) -> Any:
    """Return a part of a name, parsed; an error names the whole name and an example."""
    try:
        return parse(text)
    except ValueError as error:
        raise ModelError(f"{name!r}: {error}", remedy=f"write such as {example}") from None


def _parse_time(name: str, text: str) -> int:
    return int(to_tt2000(_parsed(name, text, parse_utc, "offset_step@2024-03-01")))


# Entries of a model's file.


def _addition_of_text(maker: AdditionMaker, given: Mapping[str, Any]) -> Addition:
    """Return the addition of an entry: a candidate's when it is one, else one that needs a pass."""
    found = _unmarked_addition(maker, given)
    return found.as_empirical() if given.get("empirical") else found


def require_known(effect: str | Mapping[str, Any], model: Model, mission: Mission) -> None:
    """Refuse an entry of a model, or an effect of a channel, that the mission cannot have; reads no data.

    Raises
    ------
    ModelError
        Names that only a search may know are left to `find_request`.
    """
    given = parse_entry(effect)
    if isinstance(given, str):
        match, kinds = _MADE.match(given), known_effects(model.own)
        if given in kinds:
            _require_channels(given, [name for name in kinds[given].channels if name in GEOMETRY], mission)
        if match is None or "channel" not in getattr(kinds.get(match["effect"]), "option_names", list)():
            return
        _require_channels(match["effect"], base_channels(match["channel"].strip()), mission)
    else:
        entry = make_effect(given, sensors_of(mission, model.comparison), model.own, mission)
        _require_channels_of(entry, mission)


def _require_channels_of(entry: ModelEffect, mission: Mission) -> None:
    channels = [base for name in entry.effect.channels for base in base_channels(name)]
    _require_channels(entry.effect.label(), channels, mission)


def _require_channels(label: str, channels: Iterable[str], mission: Mission) -> None:
    # What geometry adds is made from the orbit.
    known = {*channels_of(mission), *(GEOMETRY if position_channel(mission) else ())}
    for channel in channels:
        if channel not in known:
            raise ModelError(
                f"effect '{label}' needs channel {channel!r}, which the mission has not"
                f"{did_you_mean(channel, known)}",
                remedy="it is made from positions: name a channel of kind 'position' in the mission YAML"
                if channel in GEOMETRY
                else "name it in the mission YAML, or give the option 'channel'",
            )


def _unmarked_addition(maker: AdditionMaker, given: Mapping[str, Any]) -> Addition:
    sensors = sensors_of(maker.mission, maker.model.comparison)
    entry = make_effect(given, sensors, maker.model.own, maker.mission)
    _require_channels_of(entry, maker.mission)
    plain = not set(given) & set(entry.parameters)
    candidate, lag = _matching_candidate(maker, entry)
    # A dipole's columns are those of both sensors; a candidate's are of one.
    if candidate is not None and plain and entry.dipole is None:
        return maker.of_candidate(candidate, str(given.get("name") or ""), lag)
    name = maker.free_name(str(given.get("name") or maker.title(entry)))
    return _outside_library(
        maker, make_effect({**given, "name": name}, sensors, maker.model.own, maker.mission)
    )


def _outside_library(maker: AdditionMaker, entry: ModelEffect) -> Addition:
    """Return the addition of an effect that is in no library, at values that do nothing."""
    # Options such as the order of a tone decide how many components a parameter has.
    still = {
        key: replace(
            timed,
            value=timed.parameter.default_values[:, None],
            sigma=np.full((timed.parameter.size, 1), timed.parameter.sigma),
            free=True,
            before=None,
        )
        if np.isfinite(timed.parameter.sigma) and timed.time == "constant"
        else timed
        for key, timed in entry.parameters.items()
    }
    entry = entry.with_parameters(still)
    # Gram blocks are known by the names of their columns: these say what the effect is made of.
    made_of = json.dumps(entry.as_yaml(), sort_keys=True, default=str)
    key = f"{entry.name}#{hashlib.sha256(made_of.encode()).hexdigest()[:12]}"
    term = term_of(entry, key)
    moving = tuple(one for one in term.parameters if still[one].time == "constant")
    if not moving or moving != term.parameters:
        raise ModelError(
            f"effect '{entry.effect.label()}' has no constant parameter with a sigma: nothing can be fitted",
            remedy="give its Parameter a sigma: what is known of it beforehand",
        )
    return maker.of_term(term)


def _matching_candidate(maker: AdditionMaker, entry: ModelEffect) -> tuple[Candidate | None, float]:
    """Return the candidate an entry is, whatever its lag, and the lag."""
    if entry.effect.source is not None:
        return None, 0.0
    identity, lag = _identity(entry)
    for candidate in maker.library.candidates:
        term = maker.library.terms[candidate.terms[0]]
        if candidate.placebo or candidate.number or len(candidate.terms) > 1:
            continue
        own, own_lag = _identity(term.entry)
        if own == identity and (own_lag == lag or maker.bank(candidate)):
            return candidate, lag
    return None, lag


def _identity(entry: ModelEffect) -> tuple[tuple[Any, ...], float]:
    """Return what an effect is, its name and its values not counted, and its lag, seconds."""
    given = dict(entry.effect.given)
    lag = 0.0
    if entry.effect.channels and {"channel", "lag"} & set(given):
        parts = parse_channel(entry.effect.channels[0]).parts
        if len(parts) == 1 and parts[0].lag_s:
            lag = float(parts[0].lag_s)
            given.pop("lag", None)
            # An effect whose channel is its own states a lag alone.
            if "channel" in given:
                given["channel"] = str(given["channel"]).partition("@lag=")[0]
    options = tuple(sorted((key, str(value)) for key, value in given.items()))
    return (entry.effect.label(), entry.sensor.name, options), lag


def held_already(model: Model, request: Request) -> ModelEffect | None:
    """Return the effect of a model that a request would add once more, though its numbers are fitted already.

    Another lag of the same channel is another response, where it is stated. Numbers that the model holds
    without a sigma can only be corrected by the same effect beside them.
    """
    for entry in request.addition.entries:
        if isinstance(entry.effect, SENSOR_EQUATIONS) or not _is_constant(entry):
            continue
        identity, lag = _identity(entry)
        for own in model.effects:
            own_identity, own_lag = _identity(own)
            same = own_identity == identity and (bool(request.bank) or own_lag == lag)
            if same and _is_constant(own) and all(_is_fitted(own.parameters[key]) for key in _numbers(own)):
                return own
    return None


def _is_constant(entry: ModelEffect) -> bool:
    return all(timed.time == "constant" for timed in entry.parameters.values())


def _numbers(entry: ModelEffect) -> list[str]:
    """Return the parameters of an effect that can be fitted."""
    return [key for key, kind in type(entry.effect).parameters().items() if np.isfinite(kind.sigma)]


def _is_fitted(timed: TimedValue) -> bool:
    return bool(timed.free and np.any((timed.sigma > 0) & np.isfinite(timed.sigma)))


def addition_of_entry(maker: AdditionMaker, entry: ModelEffect) -> Addition:
    """Return the addition that an effect of a later version of the model is."""
    found = _plain_addition_of_entry(maker, entry)
    return found.as_empirical() if entry.effect.empirical else found


def _plain_addition_of_entry(maker: AdditionMaker, entry: ModelEffect) -> Addition:
    if (changing := _changing_addition_of_entry(maker, entry)) is not None:
        return changing
    label = entry.effect.label()
    kind, _, form = label.partition("_")
    if kind in _KINDS and form in ("step", "episode"):
        at = [
            _parse_time(entry.name, str(entry.effect.given[key]))
            for key in ("at", "from", "to")
            if key in entry.effect.given
        ]
        if getattr(maker.time_variable, kind):
            return step_of(maker, kind, at, entry.name)
    candidate, lag = _matching_candidate(maker, entry)
    if candidate is not None:
        return maker.of_candidate(candidate, entry.name, lag)
    return _outside_library(maker, entry)


def _changing_addition_of_entry(maker: AdditionMaker, entry: ModelEffect) -> Addition | None:
    """Return the addition that an effect is that drifts or wanders; None of another one."""
    for key, timed in entry.parameters.items():
        if timed.time == "spline" and key in ("change", "seconds", "bias"):
            return wander_of(maker, str(entry.effect.given.get("of", key)), timed.dependence, entry.name)
        if timed.time != "linear" or timed.free:
            continue
        kind = {"shift": "offset", "matrix": "scale", "seconds": "clock", "bias": "bias"}.get(key)
        if key == "matrix":
            growth = np.reshape(timed.value[:, 1], (3, 3))
            kind = "angle" if np.any(growth[~np.eye(3, dtype=bool)]) else "scale"
        if kind is not None:
            return drift_of(maker, f"{kind}_drift", entry.name)
    return None


# Lags.


def best_lag(
    setup: FitSetup, fixed: Mapping[str, float], columns: Sequence[Column], bank: Mapping[float, Addition]
) -> float:
    """Return the lag that explains most next to the rest of the model, seconds; 0 when it may be none."""
    tried = [
        Column(f"{lag:g}|{column.name}", column.parts)
        for lag, addition in bank.items()
        for column in addition.columns
    ]
    grams, present = setup.marginalised([*columns, *tried], fixed)
    count = len(present.columns) - len(tried)
    present = replace(present, columns=present.columns[:count], precision=present.precision[:count])
    places = {
        lag: grams.index([f"{lag:g}|{column.name}" for column in addition.columns])
        for lag, addition in bank.items()
    }
    y = grams.residuals[0]
    if len(places) > 2:
        found = profile_lag(grams, present, places, y, make_folds(len(grams)))
        return found.best if found.best > found.sigma else 0.0
    _, explained = fit(grams, present, list(places.values()), y)
    return list(places)[int(np.argmax(explained))]
