"""What could be missing: candidates made from every channel, every geometry and every effect there is.

A *term* is one effect with its columns of the residual; a *candidate* is one or several terms that
stand or fall together. Candidates of one *mechanism* (the same cause with another lag or width) are
rivals in form only; candidates of different mechanisms are rivals in cause.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from inflight.effects import Effect, known_effects
from inflight.effects.families import family_of
from inflight.errors import InflightError
from inflight.mission import Mission
from inflight.model import Model, ModelEffect, make_effect
from inflight.sensors import Sensor, sensors_of
from inflight.time import SECOND

#: First-order responses tried of every channel, s; combinations of neighbours reach what lies between.
LAGS = (0.0, 60.0, 240.0, 1000.0, 4000.0)
#: Widths of the play operator tried, as parts of the channel's range.
WIDTHS = (0.15, 0.4)
#: Lags of placebos.
FEW_LAGS = (0.0, 240.0)
#: Kinds of channels that may act on a sensor's scale or by hysteresis; currents do neither.
THERMAL = frozenset({"temperature", "other", "voltage"})
#: Effects that only such channels are tried with.
OF_THERMAL = frozenset({"channel_scale", "channel_angle", "hysteresis"})
#: Channels that get placebos, and placebos of each: enough to show what a wrong channel explains.
MOST_PLACEBOS = 16
#: Effects that describe a shape in some coordinate and name no cause: taken when nothing else explains.
AGNOSTIC = frozenset(
    {
        "orbit_periodic",
        "sun_periodic",
        "local_time_periodic",
        "function_of_two",
        "day_night_series",
        "function_of_channel",
    }
)
#: Effects that the pass does not try by themselves: they need a time, which the search over blocks finds.
TIMED = frozenset({"offset_step", "offset_episode", "bias_step", "clock_step", "clock_episode", "scale_step"})
#: Effects of so many columns that a single channel would outweigh all others; a user adds them by name.
WIDE = frozenset({"function_of_channel", "function_of_two", "tolles_lawson"})


@dataclass(frozen=True)
class Term:
    """One effect, the parameters a fit may move, and their columns.

    Attributes
    ----------
    key : str
        Unique name.
    entry : ModelEffect
        The effect at the values it is linearised at.
    parameters : tuple of str
        Its parameters that have columns.
    sigma : tuple of float
        What is known beforehand of each column, physical units; inf when nothing.
    """

    key: str
    entry: ModelEffect
    parameters: tuple[str, ...]
    sigma: tuple[float, ...] = ()

    @property
    def columns(self) -> list[str]:
        """Names of the columns, ``key.parameter[axis]``."""
        kinds = self.entry.effect.parameters()
        return [
            f"{self.key}.{name}[{axis}]" if axis else f"{self.key}.{name}"
            for name in self.parameters
            for axis in (kinds[name].axes or ("",))
        ]

    @property
    def scale(self) -> list[float]:
        """Physical size of one unit of each column."""
        kinds = self.entry.effect.parameters()
        return [kinds[name].step for name in self.parameters for _ in range(kinds[name].size)]


@dataclass(frozen=True)
class Candidate:
    """Something that may be missing.

    Attributes
    ----------
    name, mechanism : str
        ``channel_field(heater)@lag=360s`` is of the mechanism ``channel_field(heater)``.
    family : str
        One of the families of `diagnose`.
    channels : tuple of str
        Base channels it is made from.
    terms : tuple of str
        Keys of its terms.
    lag_s : float
        Time constant of its response.
    agnostic : bool
        It describes a shape and names no cause.
    placebo : bool
        Made from a channel of another time: whatever it explains, it explains by chance.
    """

    name: str
    mechanism: str
    family: str
    channels: tuple[str, ...]
    terms: tuple[str, ...]
    lag_s: float = 0.0
    agnostic: bool = False
    placebo: bool = False


@dataclass(frozen=True)
class Told:
    """What is known of a channel before the pass.

    Attributes
    ----------
    mean, spread : float
        Over the span, channel units; `spread` is the range of nine tenths of its values.
    missing : float
        Part of the span it is missing.
    kind : str
        Of the mission's channel.
    """

    mean: float
    spread: float
    missing: float = 0.0
    kind: str = "other"


@dataclass
class Library:
    """Terms and candidates of one comparison.

    Attributes
    ----------
    base : list of Term
        What every calibration interval fits anew: the nine parameters.
    refined : list of Term
        Other parameters of the model that data may refine within their stated sigma.
    terms : dict of str to Term
        Terms of candidates.
    candidates : list of Candidate
        In a fixed order.
    placebos : dict of str to float
        Placebo channel -> seconds by which its channel is shifted.
    unscorable : list of dict
        What cannot be tried, and why.
    """

    base: list[Term] = field(default_factory=list)
    refined: list[Term] = field(default_factory=list)
    terms: dict[str, Term] = field(default_factory=dict)
    candidates: list[Candidate] = field(default_factory=list)
    placebos: dict[str, float] = field(default_factory=dict)
    unscorable: list[dict[str, str]] = field(default_factory=list)

    @property
    def all_terms(self) -> list[Term]:
        """Terms in the order of their columns: base, refined, candidates'."""
        return [*self.base, *self.refined, *self.terms.values()]

    @property
    def columns(self) -> list[str]:
        """Names of all columns, the residual not among them."""
        return [name for term in self.all_terms for name in term.columns]

    @property
    def channels(self) -> list[str]:
        """Every channel the terms need, derived ones and placebos included."""
        names = {name for term in self.all_terms for name in term.entry.effect.channels}
        return sorted(names)

    def columns_of(self, candidate: Candidate) -> list[str]:
        """Names of a candidate's columns."""
        return [name for key in candidate.terms for name in self.terms[key].columns]

    def add(self, candidate: Candidate, terms: Iterable[Term]) -> None:
        """Take in a candidate; terms that are there already are shared."""
        for term in terms:
            self.terms.setdefault(term.key, term)
        self.candidates.append(candidate)


def make_library(
    mission: Mission,
    model: Model,
    channels: Mapping[str, Told],
    geometry: Sequence[str],
    shifts: Mapping[str, float],
    base: Sequence[Term],
    shortest: float,
    fixed: Sequence[Term] = (),
) -> Library:
    """Return everything that may be tried on a comparison.

    Parameters
    ----------
    model : Model
        The present model; what it holds free is refined, not tried.
    channels : mapping of str to Told
        Every channel of one number a time.
    geometry : sequence of str
        Coordinates the samples hold, such as ``orbit_phase`` and ``sunlit``.
    shifts : mapping of str to float
        Placebo name -> seconds.
    base : sequence of Term
        The calibration's own terms.
    shortest : float
        Shortest period the library's cadence shows, s.
    fixed : sequence of Term
        Parameters of the vector sensor that the model holds fixed.
    """
    library = Library(base=list(base), refined=_refined(model, base), placebos=dict(shifts))
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
            _offer(library, mission, model, label, given, there, channels, shortest)
    for term in fixed:
        key = f"{term.key}.{term.parameters[0]}"
        own = replace(term, key=key)
        library.add(Candidate(key, key, "sensor", (), (key,)), [own])
    _offer_placebos(library, mission, model, shifts)
    return library


def _refined(model: Model, base: Sequence[Term]) -> list[Term]:
    """Terms of the model's own parameters that a stated sigma lets data refine."""
    own = {term.entry.name for term in base}
    found = []
    for entry in model.effects:
        if entry.name in own:
            continue
        term = term_of(entry, f"model:{entry.name}", free_only=True)
        if term.parameters:
            found.append(term)
    return found


def term_of(entry: ModelEffect, key: str, free_only: bool = False) -> Term:
    """Return the term of an effect: its parameters that a fit may move.

    Parameters
    ----------
    free_only : bool
        Only parameters the model leaves free, with their stated sigma; else all that have a prior.
    """
    kinds = entry.effect.parameters()
    names, sigma = [], []
    for name, kind in kinds.items():
        timed = entry.parameters[name]
        if free_only and not (timed.free and timed.time == "constant" and np.all(timed.sigma[:, 0] > 0)):
            continue
        if not free_only and not np.isfinite(kind.sigma):
            continue
        names.append(name)
        sigma += list(timed.sigma[:, 0]) if free_only else [np.inf] * kind.size
    return Term(key, entry, tuple(names), tuple(float(one) for one in sigma))


def _offer(
    library: Library,
    mission: Mission,
    model: Model,
    label: str,
    options: Mapping[str, Any],
    there: set[str],
    channels: Mapping[str, Told],
    shortest: float,
) -> None:
    """Add the candidates of one effect with one choice of options."""
    kind = known_effects(model.own)[label]
    for sensor in _sensors(kind, mission, model):
        entry = _made({"effect": label, "sensor": sensor.name, **options}, mission, model)
        if entry is None:
            continue
        used = [name for name in entry.effect.channels if name]
        missing = [name for name in used if name not in there]
        mechanism = _mechanism(label, options)
        family = family_of(entry.effect, mission)
        if missing:
            library.unscorable.append(
                {"name": mechanism, "family": family, "reason": f"{', '.join(missing)} is not there"}
            )
            continue
        if _in_model(model, entry):
            continue
        if "period" in options and _seconds(options["period"]) < 2.0 * shortest:
            continue
        _expand(library, mission, model, label, dict(options), entry, mechanism, family, channels)


def _expand(
    library: Library,
    mission: Mission,
    model: Model,
    label: str,
    options: dict[str, Any],
    entry: ModelEffect,
    mechanism: str,
    family: str,
    channels: Mapping[str, Told],
) -> None:
    """Add an effect with every lag or width of its bank."""
    base = _base_channels(entry.effect.channels)
    common = {"mechanism": mechanism, "family": family, "channels": base, "agnostic": label in AGNOSTIC}
    lone = options.get("channel")
    if label in OF_THERMAL and lone in channels and channels[lone].kind not in THERMAL:
        return
    given = {"effect": label, "sensor": entry.sensor.name, **options}
    if label == "channel_field" and lone in channels:
        for lag in LAGS:
            made = _made(given | ({"lag": f"{lag:g} s"} if lag else {}), mission, model)
            if made is not None:
                term = term_of(made, f"{mechanism}@lag={lag:g}s" if lag else mechanism)
                library.add(Candidate(term.key, terms=(term.key,), lag_s=lag, **common), [term])
    elif label == "hysteresis" and lone in channels:
        _offer_plays(library, mission, model, given, channels[lone].spread, common)
    else:
        term = term_of(entry, mechanism)
        if term.parameters:
            library.add(Candidate(term.key, terms=(term.key,), **common), [term])


def _offer_plays(
    library: Library,
    mission: Mission,
    model: Model,
    given: dict[str, Any],
    spread: float,
    common: dict[str, Any],
) -> None:
    """Add a channel with its play of several widths; the channel's own columns are those of its plain field."""
    plain = _made(
        {"effect": "channel_field", "sensor": given["sensor"], "channel": given["channel"]}, mission, model
    )
    if plain is None:
        return
    direct = term_of(plain, f"channel_field({given['channel']})")
    for part in WIDTHS:
        width = float(f"{part * spread:.3g}")
        made = _made(given | {"width": width}, mission, model)
        if made is not None:
            key = f"{common['mechanism']}@width={width:g}"
            own = Term(key, made, ("play",), (np.inf,) * 3)
            library.add(Candidate(key, terms=(direct.key, key), **common), [direct, own])


def _offer_placebos(library: Library, mission: Mission, model: Model, shifts: Mapping[str, float]) -> None:
    """Add the plain field of shifted channels, with a few lags."""
    kind = known_effects(model.own)["channel_field"]
    sensors = _sensors(kind, mission, model)
    for name in shifts:
        for lag in FEW_LAGS:
            channel, number = name.split("~")
            derived = f"{channel}@lag={lag:g}s~{number}" if lag else name
            entry = _made(
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


def _sensors(kind: type[Effect], mission: Mission, model: Model) -> list[Sensor]:
    """The sensor an effect's candidates act on: one is enough, the data give the difference only."""
    sensors = list(sensors_of(mission, model.comparison).values())
    wanted = getattr(kind, "acts_on", ("vector", "inboard", "scalar"))
    if mission.comparisons[model.comparison].kind == "platform":
        # The vector sensor gives the direction only: whatever is seen is at the scalar sensor.
        wanted = ("scalar",)
    for role in wanted:
        found = [sensor for sensor in sensors if sensor.role == role]
        if found:
            return found[:1]
    return []


def _made(entry: Mapping[str, Any], mission: Mission, model: Model) -> ModelEffect | None:
    try:
        return make_effect(entry, sensors_of(mission, model.comparison), model.own, mission)
    except InflightError:
        return None


def _in_model(model: Model, entry: ModelEffect) -> bool:
    """Return True when the model has this cause already and leaves it free."""
    for own in model.effects:
        same = type(own.effect) is type(entry.effect) and own.effect.channels == entry.effect.channels
        if same and own.effect.given == entry.effect.given and own.sensor.role == entry.sensor.role:
            return any(timed.free for timed in own.parameters.values())
    return False


def _mechanism(label: str, options: Mapping[str, Any]) -> str:
    told = [str(value) for key, value in options.items() if key not in ("lag", "width")]
    return f"{label}({', '.join(told)})" if told else label


def _base_channels(names: Sequence[str]) -> tuple[str, ...]:
    from inflight.derived import base_channels

    return tuple(dict.fromkeys(base for name in names if name for base in base_channels(name)))


def _seconds(period: Any) -> float:
    from inflight.time import parse_duration

    return parse_duration(period) / SECOND if isinstance(period, str) else float(period)


def renamed(candidate: Candidate, **changes: Any) -> Candidate:
    """Return a copy of a candidate with some fields changed."""
    return replace(candidate, **changes)
