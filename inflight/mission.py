"""A mission: instruments, channels, files, known periods, comparisons and events, as one YAML.

`Mission.parse` validates a text and names line and key of whatever is wrong. It opens no file; the
catalog reads the text. ``missions/template.yaml`` shows every key with a comment. `Sensor` is a magnetometer
of a comparison as the physics needs it: a role, a place, an orientation.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Any, Literal, Self

import numpy as np
import scipy
from pydantic import AfterValidator, BeforeValidator, Field, PrivateAttr, ValidationError, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError

from inflight.errors import MissionError, did_you_mean
from inflight.instruments import (
    Channel,
    ClockStep,
    Duration,
    Files,
    Instant,
    Instrument,
    InstrumentSigma,
    Kind,
    Quaternion,
    Reader,
    Role,
    Strict,
    Unit,
    Vector3,
)
from inflight.main_field import IGRF
from inflight.time import SECOND, utc_text

__all__ = [
    "Channel",
    "ClockStep",
    "Comparison",
    "DualComparison",
    "Duration",
    "Event",
    "ExcludedInterval",
    "FieldModelComparison",
    "Files",
    "Instant",
    "Instrument",
    "InstrumentSigma",
    "Kind",
    "Mission",
    "PlatformComparison",
    "Positions",
    "Quaternion",
    "Reader",
    "ReleaseHeader",
    "Role",
    "ScalarComparison",
    "SpinAxis",
    "SpinComparison",
    "Unit",
    "Vector3",
    "ZeroLevelComparison",
]


class Positions(Strict):
    """What the instruments' positions are measured in and from."""

    unit: Unit = "m"
    axis_along_boom: Literal["x", "y", "z"] | None = None
    origin: str = ""


class Event(Strict):
    """Something that happened at a known time: a reset, a manoeuvre, a switch-over."""

    at: Instant
    name: str
    kind: str = "event"


class ExcludedInterval(Strict):
    """Readings of an instrument that no fit takes: from when to when (half-open), who says so, and why."""

    instrument: str
    start: Instant
    end: Instant
    author: str = Field(min_length=1)
    reason: str = Field(min_length=1)

    @model_validator(mode="after")
    def _rises(self) -> Self:
        if self.end <= self.start:
            raise ValueError(f"exclusions: that of {self.instrument!r} ends before it begins")
        return self

    @property
    def words(self) -> str:
        """The interval with its reason and author."""
        return (
            f"{self.instrument} {utc_text(self.start)} to {utc_text(self.end)}: {self.reason} ({self.author})"
        )


def _values(value: Any) -> Any:
    return value if isinstance(value, list) else [value]


class MeasuringRange(Strict):
    """One range of an instrument that measures in several: a channel tells which, and when."""

    #: Channel that tells the range; each reading holds until the next.
    channel: str
    #: What it reads in this range.
    value: Annotated[list[float], BeforeValidator(_values), Field(min_length=1)]

    @property
    def words(self) -> str:
        """The range in words: ``fgm_range = 2 or 3``."""
        return f"{self.channel} = {' or '.join(f'{one:g}' for one in self.value)}"


class ScalarComparison(Strict):
    """|B_vector| minus the field strength of an absolute instrument (one row a sample, nT)."""

    kind: Literal["scalar"]
    vector: str
    scalar: str
    #: Only what the vector instrument measured in this range: each range has a comparison, and so a
    #: calibration table, of its own.
    range: MeasuringRange | None = None
    #: The instrument whose stamps carry the comparison; the slower of the two when absent.
    base: str | None = None
    #: Model file this comparison begins with, relative to the mission YAML.
    preflight: str | None = None
    #: How the nine parameters of a span are found: exact least squares, or one pass from the pre-flight
    #: values of a published form: of the difference (Yin 2010, eq. 2.7) or the squares (``F^2 = P M + Q``).
    estimate: Literal["exact", "difference", "squares"] = "exact"

    def instruments(self) -> dict[str, str]:
        """Return role in the comparison -> instrument."""
        return {"vector": self.vector, "scalar": self.scalar}


class Body(Strict):
    """The box in which all of a spacecraft's units stand; origin and unit of `positions`."""

    middle: Vector3 = (0.0, 0.0, 0.0)
    #: Its whole lengths along the spacecraft's axes.
    size: Vector3

    @model_validator(mode="after")
    def _has_a_size(self) -> Self:
        if min(self.size) <= 0:
            raise ValueError("'size' must be three positive lengths")
        return self


class DualComparison(Strict):
    """Difference of two vector sensors in spacecraft axes (three rows a sample, nT)."""

    kind: Literal["dual"]
    inboard: str
    outboard: str
    #: Instrument that gives the ambient field in spacecraft axes for some of the time, such as a model or a
    #: spacecraft nearby: then the part of the stray field that never changes is known, too.
    ambient: str | None = None
    #: Where the units are mounted: geometry then gives the outboard sensor's part of the difference.
    body: Body | None = None
    base: str | None = None
    preflight: str | None = None

    def instruments(self) -> dict[str, str]:
        """Return role in the comparison -> instrument."""
        return {"inboard": self.inboard, "outboard": self.outboard}


class SpinAxis(Strict):
    """How a spinning spacecraft lies in space, from a time on."""

    #: The axis is known from here on; for all times when absent.
    since: Instant | None = None
    #: gse, gsm, gei (equator and equinox of date), gcrf (of J2000) or itrf.
    frame: Literal["gse", "gsm", "gei", "gcrf", "itrf"] = "gcrf"
    #: Of the rotation, right-handed: a vector, or right ascension and declination (the frame's), degrees.
    direction: tuple[float, float] | Vector3

    @model_validator(mode="after")
    def _points_somewhere(self) -> Self:
        if not any(self.direction) and len(self.direction) == 3:
            raise ValueError("a direction of (0, 0, 0) points nowhere")
        return self


def _axes(value: Any) -> Any:
    return [value] if isinstance(value, Mapping) else value


class NearEarthModel(Strict):
    """The model of the Earth's field that tells a spinning sensor's gains, third angle and third offset.

    Needs positions and the spin axis.
    """

    #: As of a comparison of kind ``field_model``.
    model: str = "igrf"
    #: What the model lacks and what stays in a window, one sigma along each payload axis.
    external: Annotated[float, Field(gt=0)] = 20.0
    #: Taken up to this distance from the Earth's centre, Earth radii.
    within: Annotated[float, Field(gt=1.0)] = 3.0


class SpinComparison(Strict):
    """Spin tones of one vector sensor (two rows a sample of the synthetic turns, nT).

    `periods` must state the spin's.
    """

    kind: Literal["spin"]
    vector: str
    #: Channel of kind ``sun_pulse`` or ``spin_phase``; the only one of these kinds when absent.
    phase: str | None = None
    #: Angle of the spacecraft's x axis from the Sun at a pulse, degrees.
    phase_at_pulse: float = 0.0
    #: Spin axis: a channel of kind ``spin_axis``, or where it lay since when. Without it products are in
    #: turning and payload axes only.
    spin_axis: Annotated[str | list[SpinAxis] | None, BeforeValidator(_axes)] = None
    #: What makes a day's parameters: all sub-intervals together, the mean of selected ones (Plaschke et al.
    #: 2019), or slope and intercept with beta and phi (Farrell et al. 1995).
    estimate: Literal["joint", "selection", "farrell"] = "joint"
    #: What tells eclipses, in which nothing is estimated: a channel that is not 0 in the shadow (of kind
    #: ``sunlight``: 0 in the shadow), or ``computed`` from the position.
    eclipse: str | None = None
    #: Time after an eclipse in which temperatures relax and nothing is estimated either.
    after_eclipse: Duration = 0
    #: Values of their own from one perigee to the next: no interval of a table holds two orbits.
    cut_at: Literal["perigee"] | None = None
    #: What tells the parameters that leave no tone, near perigee; they keep their ground values when absent.
    field_model: NearEarthModel | None = None
    #: Turns that are folded into one, about.
    turns: Annotated[int, Field(ge=8, le=2000)] = 100
    base: str | None = None
    preflight: str | None = None

    def instruments(self) -> dict[str, str]:
        """Return role in the comparison -> instrument."""
        return {"vector": self.vector}


def _rising(band: tuple[float, float]) -> tuple[float, float]:
    if not 0.0 < band[0] < band[1]:
        raise ValueError(f"band {list(band)} is no pair of rising frequencies above 0 Hz")
    return band


class PlatformComparison(Strict):
    """In-band scalar field with the vector sensor as direction only (one row a sample, nT)."""

    kind: Literal["platform"]
    scalar: str
    vector: str
    base: str | None = None
    preflight: str | None = None
    #: Hz, lowest and highest: slower is the field of the Earth, faster is noise. The usual band of
    #: aeromagnetic compensation when absent.
    band: Annotated[tuple[float, float], AfterValidator(_rising)] = (0.1, 0.9)

    def instruments(self) -> dict[str, str]:
        """Return role in the comparison -> instrument."""
        return {"scalar": self.scalar, "vector": self.vector}


ZeroLevelMethod = Literal["davis-smith", "wang-pan", "mirror mode", "minimum correlation", "hedgecock"]


class ZeroLevelComparison(Strict):
    """A vector sensor against nature: its zero level from fluctuations of the field (three rows, nT).

    The readings are in axes in which the offset stands still: those of the sensor, or despun ones where the
    mission states a period `spin`, with the axes that do not turn in `axes`.
    """

    kind: Literal["zero_level"]
    vector: str
    #: Comparison whose product is taken in place of the readings: what was corrected already.
    product: str | None = None
    #: Axes whose zero level is asked for.
    axes: tuple[Literal["x", "y", "z"], ...] = ("x", "y", "z")
    #: What is known beforehand, nT: it lies within `bound` of `start` along each axis.
    start: Vector3 = (0.0, 0.0, 0.0)
    bound: Annotated[float, Field(gt=0.0)] = 10.0
    #: Of one name that method alone, held against the same other offsets; `hedgecock` only where named.
    methods: tuple[ZeroLevelMethod, ...] = ("davis-smith", "wang-pan", "mirror mode", "minimum correlation")
    #: The spacecraft turns the sensor right round within an interval.
    turns: bool = False
    #: Fluctuations are taken within intervals of this length.
    interval: Duration = 900 * SECOND
    #: Readings are averaged over about so long first; a thirtieth of an interval when absent.
    average: Duration | None = None
    #: Readings of which a delivered mean (`averaging` of the instrument) was made, where they are not as good
    #: as continuous.
    sampling: Duration | None = None
    #: Makes a table of zero levels of steps of this length, too, as published ones have.
    step: Duration | None = None
    base: str | None = None
    preflight: str | None = None

    @model_validator(mode="after")
    def _times_fit(self) -> Self:
        if not self.axes:
            raise ValueError("'axes' names none: leave the key out for all three")
        if not self.methods or len(set(self.methods)) < len(self.methods):
            raise ValueError("'methods' names none or one twice: leave the key out for all that are combined")
        for name, least in (("interval", 1), ("average", 1), ("sampling", 1), ("step", self.interval)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(
                    f"'{name}' must be {'longer than 0' if least == 1 else 'an interval or more'}"
                )
        return self

    def instruments(self) -> dict[str, str]:
        """Return role in the comparison -> instrument."""
        return {"vector": self.vector}


class FieldModelComparison(Strict):
    """A vector sensor minus a model of the Earth's field, in spacecraft axes (three rows a sample, nT).

    Needs positions over the Earth and an attitude.
    """

    kind: Literal["field_model"]
    vector: str
    #: ``igrf``, or a file of coefficients (SHC format, as CHAOS is published) beside the mission YAML. A new
    #: version of a file needs a new name: what was made with the old one is then made anew.
    model: str = "igrf"
    #: What the model lacks and what stays, as the field of the ring current: one sigma along each Earth-fixed
    #: axis. It enters the errors of the twelve parameters.
    external: Annotated[float, Field(ge=0)] = 20.0
    base: str | None = None
    preflight: str | None = None

    def instruments(self) -> dict[str, str]:
        """Return role in the comparison -> instrument."""
        return {"vector": self.vector}


Comparison = Annotated[
    ScalarComparison
    | DualComparison
    | SpinComparison
    | PlatformComparison
    | FieldModelComparison
    | ZeroLevelComparison,
    Field(discriminator="kind"),
]


def _short_and_long(text: str) -> str:
    short, _, long = text.partition(">")
    if text and not (re.fullmatch(r"[A-Za-z0-9-]+", short) and long.strip()):
        raise ValueError(
            "expected a short name, '>' and the whole one, as in 'CHAMP>Challenging Minisatellite'"
        )
    return text


def _field_and_part(text: str) -> str:
    if text and len([part for part in text.split(">") if part.strip()]) != 2:
        raise ValueError("expected a field, '>' and its part, as in 'Space Physics>Magnetospheric Science'")
    return text


class ReleaseHeader(Strict):
    """What the files of a release say of the mission: the words of ISTP's global attributes."""

    #: Short and whole name of what flew; file names begin with the short one.
    source_name: Annotated[str, AfterValidator(_short_and_long)] = ""
    project: str = ""
    discipline: Annotated[str, AfterValidator(_field_and_part)] = ""
    pi_name: str = ""
    pi_affiliation: str = ""
    rules_of_use: str = ""
    instrument_type: str = "Magnetic Fields (space)"
    #: The short name of what flew when absent.
    mission_group: str = ""
    doi: str = ""
    link: str = ""


#: Keys of `ReleaseHeader` without which ISTP has no file.
_NEEDED_FOR_FILES = ("source_name", "project", "discipline", "pi_name", "pi_affiliation", "rules_of_use")


class Mission(Strict):
    """A whole mission, immutable; `text` is what it was read from."""

    mission: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]
    description: str = ""
    #: Repeated wherever a figure made from the data is shown.
    acknowledgement: str = ""
    periods: dict[str, Duration] = Field(default_factory=dict)
    positions: Positions = Positions()
    instruments: dict[str, Instrument]
    comparisons: dict[str, Comparison]
    #: Model file with the pre-flight calibration, relative to the mission YAML; for the comparison it
    #: names, unless that states one of its own.
    preflight: str | None = None
    events: list[Event] = Field(default_factory=list)
    exclusions: list[ExcludedInterval] = Field(default_factory=list)
    #: Python files with the user's own effects.
    effects: list[str] = Field(default_factory=list)
    release: ReleaseHeader = ReleaseHeader()
    _text: str = PrivateAttr(default="")

    @model_validator(mode="after")
    def _excluded_instruments(self) -> Self:
        for one in self.exclusions:
            if one.instrument not in self.instruments:
                raise ValueError(
                    f"exclusions: no instrument {one.instrument!r}"
                    f"{did_you_mean(one.instrument, self.instruments)}"
                )
        return self

    @model_validator(mode="after")
    def _references(self) -> Self:
        for name, instrument in self.instruments.items():
            other = instrument.files.same_as
            if other is not None and (other not in self.instruments or self.instruments[other].files.same_as):
                raise ValueError(
                    f"instruments.{name}.files.same_as: no instrument {other!r} with files of its own"
                )
        for name, comparison in self.comparisons.items():
            named = comparison.instruments() | ({"base": comparison.base} if comparison.base else {})
            if comparison.kind == "dual" and comparison.ambient:
                self._check_ambient(name, comparison.ambient)
            if comparison.kind == "zero_level" and comparison.product:
                self._check_product(name, comparison.vector, comparison.product)
            for role, instrument_name in named.items():
                if instrument_name not in self.instruments:
                    raise ValueError(f"comparisons.{name}.{role}: there is no instrument {instrument_name!r}")
            for role in ("vector", "scalar"):
                sensor = comparison.instruments().get(role)
                if sensor and self.instruments[sensor].role != role:
                    has = self.instruments[sensor].role
                    raise ValueError(f"comparisons.{name}.{role}: {sensor!r} has role {has!r}")
        return self

    def _check_product(self, comparison: str, instrument: str, product: str) -> None:
        """Raise ValueError unless a comparison has a product of an instrument in axes that stand still."""
        found = self.comparisons.get(product)
        if found is None or found.kind not in ("scalar", "dual"):
            kinds = "there is no such comparison" if found is None else f"it is of kind {found.kind!r}"
            raise ValueError(
                f"comparisons.{comparison}.product: {product!r} is no comparison of kind 'scalar' or 'dual':"
                f" {kinds}"
            )
        measured = found.instruments()["vector" if found.kind == "scalar" else "outboard"]
        if measured != instrument:
            raise ValueError(
                f"comparisons.{comparison}.product: the product of {product!r} is of {measured!r}, not of"
                f" {instrument!r}"
            )

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        for name, comparison in self.comparisons.items():
            if comparison.kind == "scalar" and comparison.range:
                self._check_range(name, comparison.range.channel)
        return self

    def _check_range(self, comparison: str, channel: str) -> None:
        """Raise ValueError unless the mission has a channel of one number a time by this name."""
        homes = [(name, one) for name, one, _ in self.channel_instruments()]
        found = [
            self.instruments[name].channels[one] for name, one in homes if channel in (one, f"{name}.{one}")
        ]
        if len(found) != 1:
            known = [one for _, one in homes] if not found else [".".join(home) for home in homes]
            raise ValueError(
                f"comparisons.{comparison}.range.channel: {len(found)} channels are called {channel!r}"
                f"{did_you_mean(channel, known)}"
            )
        if found[0].axis_names:
            raise ValueError(f"comparisons.{comparison}.range.channel: {channel!r} has several axes")

    def _check_ambient(self, comparison: str, instrument: str) -> None:
        """Raise ValueError unless an instrument can give the ambient field of a comparison."""
        found = self.instruments.get(instrument)
        if found is None or found.role != "vector":
            raise ValueError(
                f"comparisons.{comparison}.ambient: there is no instrument {instrument!r} of role 'vector'"
            )
        if found.channels["field"].frame not in (None, "sensor", "spacecraft"):
            raise ValueError(
                f"comparisons.{comparison}.ambient: the field of {instrument!r} is in"
                f" {found.channels['field'].frame!r}, and is needed in the spacecraft's axes"
            )

    @classmethod
    def parse(cls, text: str, source: str = "mission.yaml") -> Mission:
        """Read a mission from YAML text.

        Parameters
        ----------
        text : str
            The YAML.
        source : str
            Name used in errors.

        Raises
        ------
        MissionError
            Naming `source`, line and key of everything that is wrong.
        """
        tree = _load_yaml(text, source)
        try:
            mission = cls.model_validate(_plain(tree))
        except ValidationError as error:
            raise MissionError(
                "\n".join(_describe(tree, item) for item in error.errors()),
                file=source,
                remedy="'inflight new template' writes a mission that shows every key",
            ) from None
        mission._text = text
        return mission

    @property
    def text(self) -> str:
        """The YAML this mission was read from."""
        return self._text

    @property
    def sha(self) -> str:
        """sha256 of the YAML text."""
        return hashlib.sha256(self._text.encode()).hexdigest()

    @property
    def companions(self) -> list[str]:
        """Further files the mission names: pre-flight models, effects and coefficients of field models."""
        models = [self.preflight, *(comparison.preflight for comparison in self.comparisons.values())]
        fields = [one.model for one in self.comparisons.values() if one.kind == "field_model"]
        fields = [name for name in fields if name != IGRF]
        return list(dict.fromkeys([*filter(None, models), *self.effects, *fields]))

    def missing_release_keys(self) -> list[str]:
        """Return the keys that CDF and NetCDF files need and the YAML leaves out."""
        named = {key: getattr(self, key) for key in ("description", "acknowledgement")}
        named |= {f"release.{key}": getattr(self.release, key) for key in _NEEDED_FOR_FILES}
        return [key for key, value in named.items() if not value.strip()]

    def files(self, instrument: str) -> Files:
        """Return how an instrument's files are found; `same_as` is resolved, its own options win."""
        own = self.instruments[instrument].files
        if own.same_as is None:
            return own
        shared = self.instruments[own.same_as].files
        overrides = {key: getattr(own, key) for key in own.model_fields_set if key != "same_as"}
        # Durations are already nanoseconds here, so the copy must not be validated again.
        return shared.model_copy(update=overrides)

    def channel_instruments(self) -> Iterator[tuple[str, str, Channel]]:
        """Yield (instrument, channel name, channel) of every channel but the fields themselves."""
        for name, instrument in self.instruments.items():
            for channel_name, channel in instrument.channels.items():
                if channel_name != "field":
                    yield name, channel_name, channel


@lru_cache(maxsize=4)
def _tree_of(text: str) -> Any:
    """Return the nodes of a YAML text, which nobody changes: a command reads its mission several times."""
    return YAML(typ="rt").load(text)


def _load_yaml(text: str, source: str) -> Any:
    try:
        tree = _tree_of(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f"line {mark.line + 1}: " if mark else ""
        raise MissionError(
            f"{line}not YAML: {error.problem or error.context}",
            file=source,
            remedy="check indentation and quotes",
        ) from None
    if not isinstance(tree, Mapping):
        raise MissionError(
            "line 1: the file holds no keys",
            file=source,
            remedy="start from what 'inflight new template' writes",
        )
    return tree


def _plain(node: Any) -> Any:
    """Strip ruamel's round-trip types, which pydantic would refuse in strict places."""
    if isinstance(node, Mapping):
        return {str(key): _plain(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_plain(value) for value in node]
    return node


def _describe(tree: Any, item: Any) -> str:
    """Say line, key and trouble of one pydantic error."""
    path, message = list(item["loc"]), item["msg"].removeprefix("Value error, ")
    named = _NAMED_PLACE.match(message)
    if not path and named:
        path, message = named[1].split("."), named[2]
    line, walked = _line_of(tree, path)
    if item["type"] == "extra_forbidden":
        known = {key for kind in Strict.__subclasses__() for key in kind.model_fields}
        message = f"there is no key {path[-1]!r} here{did_you_mean(str(path[-1]), known - {path[-1]})}"
    found = item.get("input")
    shown = f" (found {found!r})" if isinstance(found, str | int | float | bool) else ""
    return f"line {line}: {'.'.join(walked) or 'mission'}: {message}{shown}"


#: How `Mission._references` names the place of a wrong reference.
_NAMED_PLACE = re.compile(r"(?s)^([\w-]+(?:\.[\w-]+)+): (.*)$")


def _line_of(tree: Any, path: list[Any]) -> tuple[int, list[str]]:
    """Follow a path as far as the YAML has it; return its line (from 1) and the keys walked.

    Pydantic's locations also hold tags of unions and names of types, which the YAML has not: they
    are passed over. A last part that is not there is the key that is missing.
    """
    line, walked, node = 1, [], tree
    for part in path:
        if isinstance(node, Mapping) and part in node:
            line = node.lc.key(part)[0] + 1  # type: ignore[attr-defined]
        elif isinstance(node, list) and isinstance(part, int) and part < len(node):
            line = node.lc.item(part)[0] + 1  # type: ignore[attr-defined]
        elif isinstance(node, Mapping) and part is path[-1]:
            walked.append(str(part))
            continue
        else:
            continue
        walked.append(str(part))
        node = node[part]
    return line, walked


@dataclass(frozen=True)
class Sensor:
    """One magnetometer of a comparison.

    Attributes
    ----------
    name : str
        Instrument in the mission YAML.
    role : str
        Its role in the comparison: vector, scalar, inboard, outboard.
    position : tuple of float, optional
        Metres from the assumed dipole, spacecraft axes.
    orientation : tuple of float
        Quaternion x, y, z, w that turns sensor axes into spacecraft axes.
    dipole_reduction : float, optional
        Field of the assumed dipole here relative to its field at the first vector sensor,
        ``(r_first / r_here) ** 3`` (1 at that sensor; None while a position is unknown).
    sigma : InstrumentSigma
        How well position (m), orientation (deg) and moments of readings (ns) are known.
    """

    name: str
    role: str
    position: tuple[float, float, float] | None = None
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    dipole_reduction: float | None = None
    sigma: InstrumentSigma = field(default_factory=InstrumentSigma)

    @property
    def is_scalar(self) -> bool:
        """True for an instrument that reads the field strength."""
        return self.role == "scalar"

    @property
    def rotation(self) -> scipy.spatial.transform.Rotation:
        """Rotation from sensor to spacecraft axes."""
        return scipy.spatial.transform.Rotation.from_quat(self.orientation)


def sensors_of(mission: Mission, comparison: str = "main") -> dict[str, Sensor]:
    """Return the sensors of a comparison by instrument name.

    Raises
    ------
    KeyError
        When the mission has no such comparison.
    """
    roles = mission.comparisons[comparison].instruments()
    first = mission.instruments[next(iter(roles.values()))]
    sensors = {}
    for role, name in roles.items():
        instrument = mission.instruments[name]
        reduction = None
        if first.position is not None and instrument.position is not None:
            here, there = np.linalg.norm(instrument.position), np.linalg.norm(first.position)
            reduction = float((there / here) ** 3) if here > 0 else None
        sensors[name] = Sensor(
            name, role, instrument.position, instrument.orientation, reduction, instrument.sigma
        )
    return sensors
