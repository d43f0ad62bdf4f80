"""`check_effect`: whether a class keeps what model, fit and search rely on.

It takes a class (and the mission whose channels it names), makes fields and readings with every channel,
and runs the class as the product code does: through a model, its YAML and a pickle. Everything that fails
is collected and said at once, each time with what to mend. Columns are held against central differences of
the residual, `disturb` against `correct`.

The suite imports the model and the design matrix, which it needs; nothing but the face of this folder
names it.
"""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.conformance import Faults
from inflight.design import SENSOR_EQUATIONS, DesignRows, design_matrix, sensor_matrices, term_of
from inflight.effects import registry
from inflight.effects.base import Effect, Parameter
from inflight.effects.families import FAMILIES, channel_unit, channels_of, has_orbit
from inflight.effects.user_effects import require_sound_class
from inflight.errors import ModelError
from inflight.frames import GEOMETRY
from inflight.instruments import Channel
from inflight.mission import Mission, sensors_of
from inflight.model import Model, ModelEffect, make_effect, rows_of
from inflight.samples import FIELD_ROLES, base_channels, derive_channel
from inflight.time import SECOND, day_bounds, to_utc
from inflight.units import factor_and_offset, parse_unit, product_factor

#: The sensors every effect is tried on, and channels by the names the library uses.
_STANDARD = """
mission: standard
periods: {orbit: 5580 s}
instruments:
  standard_vector:
    role: vector
    cadence: 1 s
    files: &files {pattern: "none", reader: npz, time: t}
    channels: {field: {variable: b, unit: nT, axes: [x, y, z]}}
  standard_scalar:
    role: scalar
    cadence: 1 s
    files: *files
    channels: {field: {variable: f, unit: nT}}
  standard_inboard:
    role: vector
    cadence: 1 s
    files: *files
    channels: {field: {variable: b, unit: nT, axes: [x, y, z]}}
  housekeeping:
    role: housekeeping
    cadence: 1 s
    files: *files
    channels:
      coil_temperature: {variable: a, unit: degC, kind: temperature, range: [-10, 40]}
      electronics_temperature: {variable: b, unit: degC, kind: temperature}
      boom_temperature: {variable: c, unit: degC, kind: temperature}
      frequency_ratio: {variable: d, unit: "1", kind: frequency}
      solar_current: {variable: e, unit: mA, kind: solar_current}
      battery_current: {variable: g, unit: mA, kind: battery_current}
      camera_current: {variable: h, unit: mA, kind: camera_current}
      heater_current: {variable: i, unit: mA, kind: heater}
      bus_voltage: {variable: j, unit: V, kind: voltage}
      shutter: {variable: k, unit: "1", kind: flag}
      torquer_current: {variables: [p, q, r], unit: mA, kind: torquer_current}
      wheel_speed: {variables: [s, t, u], unit: Hz}
  attitude: {role: attitude, cadence: 1 s, files: *files,
    channels: {attitude: {variable: v, unit: "1", axes: [x, y, z, w], kind: attitude, frame: itrf}}}
  orbit: {role: orbit, cadence: 1 s, files: *files,
    channels: {position: {variable: w, unit: km, axes: [x, y, z], kind: position, frame: itrf}}}
comparisons:
  main: {kind: scalar, vector: standard_vector, scalar: standard_scalar}
  pair: {kind: dual, inboard: standard_inboard, outboard: standard_vector}
events: [{at: 2004-05-01T00:03:20Z, name: reset, kind: reset}]
"""

#: A mission that delivers nothing but the fields: `candidates` must work there, too.
_BARE = "\n".join(_STANDARD.split("  housekeeping:", maxsplit=1)[0].splitlines()) + (
    "\ncomparisons: {main: {kind: scalar, vector: standard_vector, scalar: standard_scalar}}\n"
)

#: Mean, scatter and unit of a channel by its kind, where its unit allows.
_USUAL = {
    "temperature": (15.0, 8.0, "degC"),
    "frequency": (1.0, 1e-6, "1"),
    "voltage": (28.0, 1.0, "V"),
    **{f"{kind}current": (2.0, 1.5, "A") for kind in ("", "solar_", "battery_", "camera_", "torquer_")},
    "heater": (2.0, 1.5, "A"),
}


@dataclass(frozen=True, kw_only=True)
class ConformanceSettings:
    """What counts as the same.

    Attributes
    ----------
    samples : int
        Of the record, one a second. Assumed: enough for differences of fourth order and two events.
    rounding_ulp : float
        By how many units in the last place of the strongest field a reading may differ after `disturb` and
        `correct`: derived, a dozen operations and a solution that stops at 1e-9 nT.
    small_step : float
        Part of a parameter's step that finite differences are made with. Derived: a whole step of a
        coefficient per mA is thousands of nT, over which a field strength is not linear.
    column_part : float
        Part of its rms by which a column may differ from the central difference (assumed).
    column_floor : float
        The same for columns of next to nothing: rounding of the residual over `small_step` (derived).
    reach : int
        Samples around a missing value that may be missing, too: effects take rates of change, the slowest
        over 20 s on either side.
    steps : float
        Parameters are tried at up to so many of their steps, and within their sigma.
    """

    samples: int = 400
    rounding_ulp: float = 32.0
    small_step: float = 1e-3
    column_part: float = 1e-3
    column_floor: float = 2e-8
    reach: int = 25
    steps: float = 3.0


CONFORMANCE_SETTINGS = ConformanceSettings()


def check_effect(
    kind: type[Effect],
    mission: Mission | None = None,
    options: Mapping[str, Any] | None = None,
    settings: ConformanceSettings = CONFORMANCE_SETTINGS,
) -> None:
    """Check that a class of effects keeps its contract; return when it does.

    Parameters
    ----------
    kind : type
        The class; it need not be registered.
    mission : Mission, optional
        Whose channels it names; without one, a standard mission with the channels of the library.
    options : mapping, optional
        Options of one effect, as in the model YAML. Without them every candidate the class makes of the
        mission is tried, and the class as it stands when it makes none.
    settings : ConformanceSettings
        Tolerances.

    Raises
    ------
    ConformanceError
        Listing every check that failed, where, and what to mend.

    Examples
    --------
    >>> from inflight.effects import check_effect, effect_class
    >>> check_effect(effect_class("channel_field"), options={"channel": "solar_current"})
    """
    faults = Faults()
    for check in (_describes_itself, _states_parameters, _offers_candidates):
        faults.collect(check, kind, mission or _standard())
    if not faults.found:
        with _registered(kind):
            for case in _cases(kind, mission, options, settings, faults.found):
                for check_case in _CHECKS:
                    faults.collect(check_case, case, where=case.where)
                if faults.found:
                    break  # one case shows it; the same in ten others would hide it
    faults.require_none(kind.__name__, "docs/how-to/own-effect.md")


@contextmanager
def _registered(kind: type[Effect]) -> Iterator[None]:
    """Make a class known by its name for a while."""
    before = dict(registry._registered)
    registry.register(kind)
    try:
        yield
    finally:
        registry._registered.clear()
        registry._registered.update(before)


@lru_cache(maxsize=1)
def _standard() -> Mission:
    return Mission.parse(_STANDARD, "standard mission")


# --- the class by itself ---------------------------------------------------------------------------


#: A year, an equation, a section, a link, or a formula in double backticks.
_SOURCE = re.compile(r"\b(18|19|20)\d\d\b|\beqs?\.|\bsection\b|\bchapter\b|https?://|``[^`]+``")


def _describes_itself(kind: type[Effect], mission: Mission) -> Iterator[str]:
    own = kind.__dict__.get("__doc__") or ""
    if not own.strip():
        yield "the class has no docstring; write one that says what the effect adds to the reading"
    elif not _SOURCE.search(own):
        yield (
            "the docstring names no source; give the formula in double backticks, such as "
            "``coefficient * current``, or the publication and equation"
        )
    if kind.family not in FAMILIES:
        yield f"family {kind.family!r} is unknown; choose one of {', '.join(FAMILIES)}"
    if unknown := set(kind.acts_on) - set(FIELD_ROLES):
        yield f"acts_on names {', '.join(sorted(unknown))}; the roles are {', '.join(FIELD_ROLES)}"
    try:
        require_sound_class(kind, "")
    except ModelError as error:
        yield str(error)


def _states_parameters(kind: type[Effect], mission: Mission) -> Iterator[str]:
    for name, parameter in kind.parameters().items():
        yield from (f"parameter '{name}' {fault}" for fault in _faults_of(parameter))
        if parameter.per_channel and not kind.channels:
            yield f"parameter '{name}' is per channel, and the class names no channel; set 'channels'"


def _faults_of(parameter: Parameter) -> Iterator[str]:
    try:
        parse_unit(parameter.unit)
    except ValueError as error:
        yield f"has a unit that is none: {error}"
    if not 0.0 < parameter.step < np.inf:
        yield f"has step {parameter.step}; state a typical size above 0"
    if not parameter.sigma > 0.0:
        yield f"has sigma {parameter.sigma}; state what is known beforehand, or leave it out"
    if parameter.axes is not None and len(set(parameter.axes)) < len(parameter.axes):
        yield "names a component twice"
    if np.size(parameter.default) not in (1, parameter.size):
        yield f"has {np.size(parameter.default)} defaults for {parameter.size} components"
    elif parameter.bounds is not None:
        low, high = parameter.bounds
        if not (
            low < high and np.all((parameter.default_values >= low) & (parameter.default_values <= high))
        ):
            yield f"has bounds {parameter.bounds} that do not rise or do not hold the default"


def _offers_candidates(kind: type[Effect], mission: Mission) -> Iterator[str]:
    known = set(channels_of(mission)) | set(GEOMETRY)
    with _registered(kind):
        for given in (mission, Mission.parse(_BARE, "bare mission")):
            found = kind.candidates(given)
            if not isinstance(found, list) or not all(isinstance(one, Mapping) for one in found):
                yield f"candidates() returns {found!r:.80}; return a list of options, [] for none"
                continue
            if found != kind.candidates(given):
                yield "candidates() gives another answer when asked again; do not change what it returns"
            for options in found:
                if stray := set(options) - set(kind.option_names()):
                    yield f"a candidate has {', '.join(sorted(stray))}, which is no option of the class"
                elif given is mission:
                    yield from _faults_of_candidate(kind, options, known, mission)


def _faults_of_candidate(
    kind: type[Effect], options: Mapping[str, Any], known: set[str], mission: Mission
) -> Iterator[str]:
    effect = kind("", **options)
    # Geometry is made of positions: an orbit that is not delivered makes no candidate.
    needed = {base for name in effect.channels for base in base_channels(name)}
    if stray := needed - known:
        yield f"the candidate {dict(options)} needs {', '.join(sorted(stray))}, which the mission has not"
    elif needed & (set(GEOMETRY) - set(channels_of(mission))) and not has_orbit(mission):
        yield f"the candidate {dict(options)} needs an orbit, which the mission has not; see has_orbit()"


# --- cases: an effect at a sensor, with samples and values -----------------------------------------


@dataclass(frozen=True, kw_only=True)
class _Case:
    """One effect with options at one sensor of one comparison, and the fields it is tried in.

    Attributes
    ----------
    entry : dict
        Of the model YAML, with values.
    truth : xarray.Dataset
        True readings by role, and every channel.
    """

    kind: type[Effect]
    mission: Mission
    comparison: str
    entry: dict[str, Any]
    truth: xr.Dataset
    settings: ConformanceSettings

    @property
    def where(self) -> str:
        """The case in words."""
        options = {key: self.entry[key] for key in self.entry if key in self.kind.option_names()}
        stated = f", {', '.join(f'{key}: {value}' for key, value in options.items())}" if options else ""
        return f"at the {self.made.sensor.role} sensor{stated}"

    def step(self, effect: Effect, parameter: Parameter) -> float:
        """Return a step of a parameter; smaller by the channel's size when it is per channel."""
        if not parameter.per_channel:
            return parameter.step
        series = np.asarray(self.truth[effect.channels[0]].values, dtype=np.float64)
        return parameter.step / max(1.0, _rms(series)) ** parameter.per_channel

    def make(self, **changed: Any) -> ModelEffect:
        """Return the effect, some parameters replaced."""
        sensors = sensors_of(self.mission, self.comparison)
        return make_effect({**self.entry, **changed}, sensors, mission=self.mission)

    @cached_property
    def made(self) -> ModelEffect:
        """The effect with its values."""
        return self.make()

    @cached_property
    def plain(self) -> ModelEffect:
        """The effect with its defaults."""
        parameters = self.made.effect.parameters()
        return self.make(**{key: parameter.default_values.tolist() for key, parameter in parameters.items()})

    def model(self, *entries: ModelEffect) -> Model:
        """Return a model of the comparison with some effects."""
        model = Model.parse(f"comparison: {self.comparison}\neffects: []", self.mission)
        return replace(model, effects=entries)

    @cached_property
    def corrected(self) -> xr.Dataset:
        """Samples of a model without effects: readings, `field` and its direction."""
        return self.model().correct(self.truth)

    @property
    def reading(self) -> Floats:
        """The true reading of the sensor; (time, axis) or (time,) nT."""
        return np.asarray(self.truth[self.made.sensor.role].values, dtype=np.float64)

    def correction(
        self, samples: xr.Dataset, made: ModelEffect | None = None, values: Mapping[str, Floats] | None = None
    ) -> Floats:
        """Return what `correct` makes of the true reading."""
        made = made or self.made
        known = values or made.values(np.asarray(samples["tt2000"].values))
        reading = np.asarray(samples[made.sensor.role].values, dtype=np.float64)
        return np.asarray(made.effect.correct(reading, samples, known, made.sensor))

    @property
    def rounding(self) -> float:
        """By how much readings may differ, nT."""
        return float(self.settings.rounding_ulp * np.spacing(np.nanmax(np.abs(self.reading))))


def _cases(
    kind: type[Effect],
    mission: Mission | None,
    options: Mapping[str, Any] | None,
    settings: ConformanceSettings,
    faults: list[str],
) -> Iterator[_Case]:
    """Yield the effect with each of its options at each kind of sensor it acts on."""
    tried = _standard()
    if mission is not None:
        # The standard sensors and comparisons, with all channels of the mission.
        own = {name: one for name, one in tried.instruments.items() if name.startswith("standard_")}
        changes = {
            "instruments": {**mission.instruments, **own},
            "comparisons": tried.comparisons,
            "events": mission.events or tried.events,
        }
        tried = mission.model_copy(update=changes)
    places = [
        (comparison, name)
        for comparison in ("main", "pair")
        for name, sensor in sensors_of(tried, comparison).items()
        if sensor.role in kind.acts_on
    ]
    given = [dict(options)] if options is not None else kind.candidates(mission or tried) or [{}]
    made = 0
    for number, chosen in enumerate(given):
        try:
            effect = kind("", **chosen)
            effect.require_complete()
        except ModelError as error:
            if options is not None or len(given) == 1:
                faults.append(f"making: {error}; pass 'options' with which it can be made")
            continue
        # The first candidate is tried at every sensor, the others show what their options do.
        for comparison, sensor in places[: None if number == 0 else 1]:
            entry: dict[str, Any] = {"effect": kind.label(), "sensor": sensor, **chosen}
            try:
                truth = _samples(tried, comparison, effect.channels, settings.samples)
            except ModelError as error:
                faults.append(f"making: {error}; pass the 'mission' whose channels it names")
                return
            made += 1
            case = _Case(
                kind=kind, mission=tried, comparison=comparison, entry=entry, truth=truth, settings=settings
            )
            generator = np.random.default_rng(number)
            for key, parameter in effect.parameters().items():
                entry[key] = _random_value(parameter, case.step(effect, parameter), generator, settings)
            yield case
    if not made and not faults:
        faults.append("making: no candidate can be made as it stands; pass 'options' with which it can")


def _random_value(
    parameter: Parameter, step: float, generator: np.random.Generator, settings: ConformanceSettings
) -> list[float]:
    """Return values of either sign within sigma and some steps of the default."""
    size = min(parameter.sigma, settings.steps * step)
    sign = np.where(generator.random(parameter.size) < 0.5, -1.0, 1.0)
    values = parameter.default_values + sign * size * generator.uniform(0.3, 1.0, parameter.size)
    return np.clip(values, *(parameter.bounds or (-np.inf, np.inf))).tolist()  # type: ignore[no-any-return]


def _samples(mission: Mission, comparison: str, channels: Sequence[str], count: int) -> xr.Dataset:
    """Return true fields of low and high latitudes, every channel, geometry, and derived channels."""
    generator = np.random.default_rng(1)
    stamps = day_bounds("2004-05-01")[0] + SECOND * np.arange(count)
    phase = np.linspace(0.0, 2.0 * np.pi, count)
    field = np.stack([25e3 * np.cos(phase), 4e3 * np.sin(phase + 1.0), -48e3 * np.sin(phase)], axis=1)
    field += generator.normal(0.0, 20.0, field.shape)
    known = {name: _series(channel, generator, count) for name, channel in channels_of(mission).items()}
    units = {name: channel.unit for name, channel in channels_of(mission).items()} | GEOMETRY
    known = _geometry(phase) | known
    for name in channels:
        if name not in known:
            known[name] = derive_channel(name, known, 1.0)
            units[name] = channel_unit(mission, name) or "1"
    readings = {
        role: field if role != "scalar" else np.linalg.norm(field, axis=1)
        for role in mission.comparisons[comparison].instruments()
    }
    return xr.Dataset(
        {
            name: (
                ("time", "axis" if array.shape[-1] == 3 else f"{name}_axis")[: array.ndim],
                array,
                {"units": unit},
            )
            for made, each in ((known, units), (readings, dict.fromkeys(readings, "nT")))
            for name, array in made.items()
            for unit in (each[name],)
        }
        | {"flag": ("time", np.zeros(count, dtype=np.uint32)), "tt2000": ("time", stamps)},
        coords={"time": to_utc(stamps)},
    )


def _series(channel: Channel, generator: np.random.Generator, count: int) -> Floats:
    """Return a random series of a channel, within its range, in its unit."""
    shape = (count, len(channel.axis_names)) if channel.axis_names else (count,)
    if channel.kind in ("sunlight", "flag"):
        return (generator.random(shape) < 0.7).astype(np.float64)
    if channel.range is not None:
        return generator.uniform(*channel.range, shape)
    mean, scatter, unit = _USUAL.get(channel.kind, (0.0, 1.0, channel.unit))
    values = mean + scatter * generator.normal(size=shape)
    if channel.kind in ("attitude", "sun_direction"):
        return np.asarray(values / np.linalg.norm(values, axis=-1, keepdims=True))
    try:
        factor, offset = factor_and_offset(unit, channel.unit)
    except ValueError:
        factor, offset = 1.0, 0.0
    return np.asarray(factor * values + offset)


def _geometry(phase: Floats) -> dict[str, Floats]:
    """Return the geometry of one orbit at phases along it, rad."""
    sun = np.stack([np.cos(phase), np.sin(phase), np.full(phase.size, 0.5)], axis=1)
    return {
        "sunlit": (phase < 4.0).astype(np.float64),
        "orbit_phase": np.rad2deg(phase),
        "sun_phase": np.rad2deg(phase + 0.3) % 360.0,
        "local_time": np.where(phase < 3.0, 9.0, 21.0),
        "latitude": 90.0 * np.sin(phase),
        "longitude": np.rad2deg(phase) - 180.0,
        "sun_direction": sun / np.linalg.norm(sun, axis=1, keepdims=True),
        "shadow_entry": (np.abs(phase - 4.0) < 0.02).astype(np.float64)[:, None] * np.eye(3)[0],
        "shadow_exit": (phase < 0.02).astype(np.float64)[:, None] * np.eye(3)[0],
    }


_CHECKS: list[Callable[[_Case], Iterator[str]]] = []


def _check(function: Callable[[_Case], Iterator[str]]) -> Callable[[_Case], Iterator[str]]:
    """Add a check of what an effect does; checks run in the order of the file."""
    _CHECKS.append(function)
    return function


# --- what the effect does ---------------------------------------------------------------------------


@_check
def _shapes(case: _Case) -> Iterator[str]:
    reading, found = case.reading, case.correction(case.corrected)
    if found.shape != reading.shape:
        yield f"correct() returns shape {found.shape} for a reading of {reading.shape}; return the latter"
    elif not np.isfinite(found).all():
        yield "correct() returns values that are not finite though nothing is missing"
    elif found.dtype != np.float64:
        yield f"correct() returns {found.dtype}; return float64"
    if case.kind.field is not Effect.field:
        made = case.made
        values = made.values(np.asarray(case.truth["tt2000"].values))
        field = np.asarray(made.effect.field(case.corrected, values, made.sensor))
        if field.shape != (len(reading), 3):
            yield f"field() returns shape {field.shape}; return (time, 3), here ({len(reading)}, 3)"


@_check
def _leaves_its_arguments_alone(case: _Case) -> Iterator[str]:
    samples, values = case.corrected.copy(deep=True), case.made.values(case.truth["tt2000"].values)
    kept = {key: np.array(value) for key, value in values.items()}
    first = case.correction(samples, values=values)
    if not samples.identical(case.corrected):
        yield "the samples are changed; work on copies"
    if any(not np.array_equal(kept[key], value) for key, value in values.items()):
        yield "the values are changed; work on copies"
    if case.correction(samples, values=values).tobytes() != first.tobytes():
        yield "the same call gives other numbers the second time; keep no state between calls"


@_check
def _reads_declared_channels_only(case: _Case) -> Iterator[str]:
    always = {"tt2000", "time", "flag", "field", "field_direction", case.made.sensor.role}
    named = {str(name) for name in case.corrected.variables} & (always | set(case.made.effect.channels))
    bare = case.corrected[sorted(named - {"time"})]
    try:
        same = np.array_equal(case.correction(bare), case.correction(case.corrected), equal_nan=True)
    except KeyError as error:
        yield f"it reads {error}, which it does not declare; add it to 'channels'"
        return
    if not same:
        yield "it gives other numbers where only its declared channels are there; declare all it reads"


#: Another unit for the units of channels.
_OTHER_UNITS = {"degC": "K", "K": "degC", "mA": "A", "A": "mA", "V": "mV", "deg": "rad", "Hz": "mHz"}


@_check
def _knows_the_units_of_its_channels(case: _Case) -> Iterator[str]:
    """A channel in another unit gives the same field, unless the effect asks for it as it is."""
    for name in case.made.effect.channels:
        unit = str(case.corrected[name].attrs["units"])
        other = _OTHER_UNITS.get(unit)
        if other is None or _reads_in_own_unit(case, name):
            continue
        factor, offset = factor_and_offset(unit, other)
        series = case.corrected[name].copy(data=factor * case.corrected[name].values + offset)
        changed = case.corrected.assign({name: series.assign_attrs(units=other)})
        if not _close(case.correction(changed), case.correction(case.corrected), case.rounding):
            yield (
                f"channel '{name}' in {other} gives another field than in {unit}; read it by "
                f"self.channel(samples, {unit!r}, index), which converts"
            )
    for key, parameter in case.made.effect.parameters().items():
        yield from _unit_of_coefficient(case, key, parameter)


def _reads_in_own_unit(case: _Case, name: str) -> bool:
    """Return True when the effect reads a channel in its own unit: knots, widths and references are in it."""
    asked: list[int] = []
    effect = case.make().effect
    plain = effect.series
    effect.series = lambda samples, index=0: (asked.append(index), plain(samples, index))[1]  # type: ignore[method-assign,func-returns-value]
    case.correction(case.corrected, replace(case.made, effect=effect))
    return any(effect.channels[index] == name for index in asked)


def _unit_of_coefficient(case: _Case, key: str, parameter: Parameter) -> Iterator[str]:
    """A coefficient stated per another unit of its channel gives the same field."""
    unit = channel_unit(case.mission, case.made.effect.channels[0]) if parameter.per_channel else None
    if unit not in ("mA", "A", "V", "Hz"):
        return
    power = f"^{parameter.per_channel}" if parameter.per_channel > 1 else ""
    stated = f"{parameter.unit}/{'k' + unit if unit != 'mA' else 'uA'}{power}"
    factor = product_factor(stated, unit, parameter.per_channel, parameter.unit)
    value = (case.made.parameters[key].value[:, 0] / factor).tolist()
    other = case.make(**{key: {"unit": stated, "value": value}})
    if not _close(case.correction(case.corrected, other), case.correction(case.corrected), case.rounding):
        yield f"'{key}' in {stated} gives another field; read its channel by self.drive(samples, {key!r})"


def _close(found: Floats, expected: Floats, rounding: float) -> bool:
    return bool(np.allclose(found, expected, rtol=1e-11, atol=rounding))


@_check
def _does_nothing_at_its_defaults(case: _Case) -> Iterator[str]:
    parameters = case.made.effect.parameters()
    if not parameters:
        return
    change = np.abs(case.correction(case.corrected, case.plain) - case.reading)
    if np.nanmax(change) > 1e-9:
        yield (
            f"with its defaults it changes the reading by up to {np.nanmax(change):.3g} nT; let the default "
            "be the value that does nothing"
        )
    if case.made.is_additive:
        none = {key: np.zeros(parameter.size) for key, parameter in parameters.items()}
        if np.any(case.correction(case.corrected, values=none) != case.reading):
            yield "with all values 0 the field is not 0; a field must be proportional to its coefficients"
    if np.nanmax(np.abs(case.correction(case.corrected) - case.reading)) <= case.rounding:
        yield "it changes nothing, whatever its values; is a value used at all, and is 'step' its true size?"


@_check
def _is_undone_exactly(case: _Case) -> Iterator[str]:
    for time in ("constant", "linear"):
        made = case.made if time == "constant" else _in_time(case)
        model = case.model(made)
        for name, first, second in (
            ("correct(disturb(x))", model.disturb, model.correct),
            ("disturb(correct(x))", model.correct, model.disturb),
        ):
            back = second(first(case.truth))[made.sensor.role].values
            if np.shape(back) != case.reading.shape:
                yield (
                    f"{name} has shape {np.shape(back)} with {time} values; values that change in time have "
                    "shape (time, component)"
                )
            elif not (worst := float(np.nanmax(np.abs(back - case.reading)))) <= case.rounding:
                yield (
                    f"{name} differs from x by {worst:.3g} nT with {time} values; 'disturb' must undo "
                    "'correct' exactly, not to first order"
                )


def _in_time(case: _Case) -> ModelEffect:
    """Return the effect with values that grow by a tenth over the record."""
    grown = {}
    for key, timed in case.made.parameters.items():
        default = timed.parameter.default_values
        rows = np.stack([timed.value[:, 0], 0.1 * (timed.value[:, 0] - default)], axis=1).tolist()
        grown[key] = {
            "time": "linear",
            "t0": "2004-05-01",
            "per": f"{case.settings.samples} s",
            "unit": timed.parameter.unit,
            "value": rows,
        }
    return case.make(**grown)


@_check
def _columns_are_its_derivatives(case: _Case) -> Iterator[str]:
    """Columns of the design matrix against central differences of the residual of the whole model."""
    entry, settings = case.plain, case.settings
    terms = [term_of(entry, entry.name)]
    if not terms[0].parameters:
        return
    base = case.model() if isinstance(entry.effect, SENSOR_EQUATIONS) else case.model(*_nine_parameters(case))
    model = base.add(entry)
    raw = model.disturb(case.truth)
    native, corrected = rows_of(model, raw), model.correct(raw)
    held = raw.assign(
        field=(("time", "axis"), native.field, {"units": "nT"}), field_direction=corrected["field_direction"]
    )
    turn = sensor_matrices(base, int(raw["tt2000"].values[0]))
    rows = DesignRows(held, native.residual, native.directions, turn, np.ones(len(native.residual)))
    found = design_matrix(terms, rows)
    at = 0
    for key in terms[0].parameters:
        parameter = entry.effect.parameters()[key]
        for index in range(parameter.size):
            small = settings.small_step * case.step(entry.effect, parameter)
            moved = [
                model.replace(_moved(entry, key, index, sign * small)).residual(raw) for sign in (1.0, -1.0)
            ]
            exact = (moved[0] - moved[1]) / (2.0 * small / parameter.step)
            off, size = (_rms(found[:, :, at] - exact), _rms(exact))
            if off > settings.column_part * size + settings.column_floor:
                yield (
                    f"the column of {terms[0].columns[at]} is off by {off:.3g} of {size:.3g} nT a step of "
                    f"{parameter.step:g}: the field is not linear in it, or is made from the reading without "
                    "follows_field = True"
                )
            at += 1


def _nine_parameters(case: _Case) -> list[ModelEffect]:
    """Return nine parameters of each vector sensor of the comparison, whose matrices change the columns."""
    sensors = sensors_of(case.mission, case.comparison)
    values = {
        "scale_factor": [1.002, 0.999, 1.001],
        "misalignment": [90.1, 89.8, 90.05],
        "offset": [3.0, -5.0, 8.0],
    }
    return [
        make_effect(
            {"effect": "vector_sensor", "name": f"nine_{name}", "sensor": name, **values},
            sensors,
            (),
            case.mission,
        )
        for name, sensor in sensors.items()
        if not sensor.is_scalar
    ]


def _moved(entry: ModelEffect, key: str, index: int, change: float) -> ModelEffect:
    timed = entry.parameters[key]
    value = timed.value.copy()
    value[index] += change
    return entry.with_parameters({**entry.parameters, key: replace(timed, value=value)})


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


@_check
def _is_linear_where_it_says_so(case: _Case) -> Iterator[str]:
    here = case.correction(case.corrected)
    for key, parameter in case.made.effect.parameters().items():
        if not parameter.linear or not np.isfinite(parameter.sigma):
            continue
        step = case.step(case.made.effect, parameter)
        for index in range(parameter.size):
            up, down = (
                case.correction(case.corrected, _moved(case.made, key, index, change))
                for change in (step, -step)
            )
            curvature, change = _rms(up + down - 2.0 * here), _rms(up - down)
            if curvature > 1e-2 * change + case.rounding:
                yield f"'{key}' is not linear over a step of {parameter.step:g}; state linear=False"
                return


@_check
def _keeps_gaps_where_they_are(case: _Case) -> Iterator[str]:
    """What is missing of a channel or of the reading is missing of the correction, and nothing else."""
    gap, reach = slice(180, 190), case.settings.reach
    whole = case.correction(case.corrected)
    acts = np.abs(whole - case.reading) > case.rounding
    for name in (*case.made.effect.channels, case.made.sensor.role):
        values = np.array(case.corrected[name].values, dtype=np.float64)
        values[gap] = np.nan
        found = case.correction(case.corrected.assign({name: case.corrected[name].copy(data=values)}))
        needed = np.ones_like(acts) if name == case.made.sensor.role else acts
        if np.isfinite(found[gap][needed[gap]]).any():
            yield (
                f"where '{name}' is missing (NaN) the correction is not; let NaN run through: no nan_to_num, "
                "no comparison that is False for NaN"
            )
        far = np.r_[0 : gap.start - reach, gap.stop + reach : len(found)]
        if not np.allclose(found[far], whole[far], rtol=0.0, atol=case.rounding, equal_nan=True):
            yield f"a gap in '{name}' changes samples more than {reach} s away; use each sample's own values"


@_check
def _survives_the_model_yaml(case: _Case) -> Iterator[str]:
    model = case.model(case.made)
    again = Model.parse(model.text, case.mission)
    if again.text != model.text:
        yield "read from the model YAML it writes another one; keep options in self.given as written"
    role = case.made.sensor.role
    same = np.array_equal(
        again.correct(case.truth)[role].values, model.correct(case.truth)[role].values, equal_nan=True
    )
    if not same:
        yield "read from the model YAML it gives other numbers; make everything from the options in prepare()"


@_check
def _survives_a_pickle(case: _Case) -> Iterator[str]:
    try:
        effect = pickle.loads(pickle.dumps(case.made.effect))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        yield f"it cannot be pickled ({error}); define the class at the top of a file, keep no lambda"
        return
    found = case.correction(case.corrected, replace(case.made, effect=effect))
    if not np.array_equal(found, case.correction(case.corrected), equal_nan=True):
        yield "after pickling it gives other numbers; keep its state in attributes"


@_check
def _refuses_unknown_options(case: _Case) -> Iterator[str]:
    options = {key: case.entry[key] for key in case.entry if key in case.kind.option_names()}
    try:
        case.kind("", **options, no_such_option=1)
    except ModelError:
        return
    yield "an unknown option is taken without a word; do not override __init__, use prepare()"
