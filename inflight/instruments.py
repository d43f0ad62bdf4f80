"""Instruments as a mission YAML describes them: channels, files, and how the files are read."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    field_validator,
    model_validator,
)

from inflight.expression import Expression
from inflight.time import parse_duration, parse_utc, to_tt2000
from inflight.units import require_unit

Role = Literal["vector", "scalar", "housekeeping", "attitude", "orbit"]

Kind = Literal[
    "temperature",
    "solar_current",
    "battery_current",
    "camera_current",
    "torquer_current",
    "current",
    "voltage",
    "heater",
    "attitude",
    "position",
    "sun_direction",
    "sun_pulse",
    "spin_phase",
    "spin_axis",
    "sunlight",
    "frequency",
    "flag",
    "other",
]

Reader = Literal["cdf", "netcdf", "iaga2002", "table", "parquet", "npz", "mat"]


def _unit(text: Any) -> str:
    require_unit(str(text))
    return str(text)


def _list(value: Any) -> Any:
    return value if value is None or isinstance(value, list) else [value]


def _utc(value: Any) -> int:
    return int(to_tt2000(parse_utc(value)))


_FIELD = re.compile(r"\{([^{}:]*):?([^{}]*)\}")

#: strftime directives a file pattern may hold.
DIRECTIVES = "YymdjHMSbB"


def _pattern(pattern: str) -> str:
    for name, layout in _FIELD.findall(pattern):
        directives = re.findall(r"%(.?)", layout)
        if name not in ("day", "start", "end") or not directives or set(directives) - set(DIRECTIVES):
            raise ValueError(
                f"'{{{name}:{layout}}}' is none of {{day:...}}, {{start:...}}, {{end:...}} with strftime "
                f"directives of %{', %'.join(DIRECTIVES)}"
            )
    if set("{}") & set(_FIELD.sub("", pattern)):
        raise ValueError("a brace is not closed")
    return pattern


def _expression(text: str) -> str:
    Expression(text)
    return text


#: A duration in the YAML (``10 s``), integer nanoseconds in Python.
Duration = Annotated[int, BeforeValidator(parse_duration)]

Unit = Annotated[str, BeforeValidator(_unit)]

#: A UTC time in the YAML, TT2000 nanoseconds in Python.
Instant = Annotated[int, BeforeValidator(_utc)]

Pattern = Annotated[str, AfterValidator(_pattern)]

Vector3 = tuple[float, float, float]

Quaternion = tuple[float, float, float, float]


class Strict(BaseModel):
    """Base of everything a YAML describes: unknown keys are errors, nothing changes after parsing."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Channel(Strict):
    """One measured series: its place in a file, and what it is.

    `variable` names one variable (of shape (time,) or, with `axes`, (time, axis)); `variables` names
    one variable an axis.
    """

    variable: str | None = None
    variables: list[str] | None = None
    #: Position of this channel in a variable with several columns, when only one is used.
    column: int | None = None
    unit: Unit
    #: Unit of the numbers in the file, where the file states none or a wrong one.
    file_unit: Unit | None = None
    #: The file's numbers times this are in its unit: for numbers in counts, or off by a power of ten.
    factor: Annotated[float, Field(gt=0)] = 1.0
    #: Names in the file's order; x, y, z (and w) are archived in this order whatever the file's, and a
    #: minus turns a column round: ``[-y, x, z]``.
    axes: list[str] | None = None
    kind: Kind = "other"
    #: Values that stand for "missing", beside the file's own fill value and NaN.
    fill: Annotated[list[float] | None, BeforeValidator(_list)] = None
    resolution: Annotated[float, Field(gt=0)] | None = None
    #: The field follows its channel by this much; negative when it leads.
    lag: Duration = 0
    #: Readings are averaged over this long, centred: the mean of a slow channel has less noise than one
    #: reading, and noise in a channel makes its coefficient too small.
    smooth: Duration = 0
    #: Readings outside [low, high] are flagged OUT_OF_RANGE and not used.
    range: tuple[float, float] | None = None
    #: The same reading more often in a row is a stale one: all but its first become missing.
    most_repeats: Annotated[int, Field(ge=1)] | None = None
    #: Frame of an attitude, a spin axis or a position: itrf, gcrf, gei, nec, gse, gsm.
    frame: str | None = None
    description: str = ""

    @field_validator("variable", mode="before")
    @classmethod
    def _one_name(cls, value: Any) -> Any:
        if isinstance(value, list):
            names = ", ".join(map(str, value))
            raise ValueError(f"one name is expected; several are written as variables: [{names}]")
        return value

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.variable is None) == (self.variables is None):
            raise ValueError("give either 'variable' or 'variables'")
        if self.variables is not None and self.axes is not None and len(self.variables) != len(self.axes):
            raise ValueError(f"{len(self.variables)} variables for {len(self.axes)} axes")
        return self

    @property
    def sources(self) -> list[str]:
        """Names of the variables in the file."""
        return [self.variable] if self.variable is not None else list(self.variables or [])

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Names of the axes as archived; empty for a channel of one number a time."""
        if self.axes is not None:
            return _archived_axes(self.axes) or tuple(self.axes)
        if self.variables is not None and len(self.variables) == 3:
            return ("x", "y", "z")
        return tuple(self.variables or ())

    @property
    def columns(self) -> tuple[list[int], list[float]] | None:
        """Column of the file and sign of each archived axis; None where they are as in the file."""
        names = _archived_axes(self.axes or ())
        if self.axes is None or names == tuple(self.axes) or not names:
            return None
        plain = [axis.removeprefix("-") for axis in self.axes]
        order = [plain.index(axis) for axis in names]
        return order, [-1.0 if self.axes[place].startswith("-") else 1.0 for place in order]


def _archived_axes(axes: Sequence[str]) -> tuple[str, ...]:
    """Return x, y, z (and w) for any order and signs of these; nothing for other names."""
    plain = sorted(axis.removeprefix("-") for axis in axes)
    return next((known for known in (("x", "y", "z"), ("x", "y", "z", "w")) if plain == sorted(known)), ())


class ClockStep(Strict):
    """What is added to the stamps of a file from one stamp on."""

    #: First stamp, as the file writes it, that the offset is for; all stamps when absent.
    since: Instant | None = None
    offset: Duration


def _clock_steps(value: Any) -> Any:
    return value if isinstance(value, list) else [{"offset": value}]


class Files(Strict):
    """Where an instrument's files are and how they are read; options are shared by all readers."""

    #: Path below the data folder with ``*``, ``?`` and ``{day:%Y%m%d}``, ``{start:...}``, ``{end:...}``.
    pattern: Annotated[list[Pattern] | None, BeforeValidator(_list)] = None
    #: Take the files of another instrument; whatever else is given here wins over its options.
    same_as: str | None = None
    reader: Reader | None = None
    #: Variable or columns that hold the time; columns are joined by a blank.
    time: Annotated[list[str] | None, BeforeValidator(_list)] = None
    #: strptime format of text times; without a date in it, the day comes from the file name.
    time_format: str | None = None
    #: What numeric times count: CF units ("seconds since 2000-01-01 12:00:00"), or "tt2000".
    time_unit: str | None = None
    #: For files without any times: the first row's time; the rows follow at the cadence.
    time_start: Instant | None = None
    #: Which sample of a report (from 0) stamps it, where times have shape (report, sample).
    time_column: Annotated[int | None, Field(ge=0)] = None
    #: Added to every stamp: 13 s when the stamps are 13 s early; or a list of steps, each since its stamp.
    clock_offset: Annotated[list[ClockStep], BeforeValidator(_clock_steps)] = Field(default_factory=list)
    #: Rows farther than this outside the span a file's name states are dropped and reported.
    spill: Duration = 86_400_000_000_000
    #: Variables of the file that are never read.
    drop: list[str] = Field(default_factory=list)
    #: Times and fields of shape (report, sample) become one series.
    flatten: bool = False
    #: Expression over variables of the file; rows where it is false are flagged INSTRUMENT_FLAG.
    good_when: Annotated[str, AfterValidator(_expression)] | None = None
    delimiter: str | None = None
    decimal: Literal[".", ","] = "."
    encoding: str = "utf-8"
    skip: Annotated[int, Field(ge=0)] = 0
    #: Names of the columns when the file has no header line.
    columns: list[str] | None = None
    comment: str | None = None

    @model_validator(mode="after")
    def _pattern_or_same(self) -> Self:
        if self.pattern is None and self.same_as is None:
            raise ValueError("give 'pattern', or 'same_as' to take another instrument's files")
        if self.same_as is None and self.reader is None:
            raise ValueError("'reader' is missing")
        return self


class InstrumentSigma(Strict):
    """How well it is known what an instrument states of itself; 0 of what is taken as exact."""

    #: Of each coordinate, in the unit of `positions`.
    position: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    #: Of a turn about each axis, degrees.
    orientation: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    #: Of the moments of its readings.
    delay: Annotated[Duration, Field(ge=0)] = 0


class Instrument(Strict):
    """One instrument with its own cadence and files.

    `position`, `orientation` and `delay` may be written with their sigma, as parameters of effects are:
    ``orientation: {value: [0, 0, 0, 1], sigma: 0.05}``.
    """

    role: Role
    cadence: Duration
    files: Files
    channels: dict[str, Channel]
    #: Metres from the origin that `positions` describes, spacecraft axes.
    position: Vector3 | None = None
    #: Quaternion x, y, z, w that turns sensor axes into spacecraft axes.
    orientation: Quaternion = (0.0, 0.0, 0.0, 1.0)
    #: Readings are means over this long: so that two instruments are compared by the same means.
    averaging: Duration = 0
    #: Which moment of that time a stamp is.
    stamp: Literal["start", "centre", "end"] = "centre"
    #: A filter makes readings late by this much: they belong before their stamps.
    delay: Duration = 0
    #: Of `position`, `orientation` and `delay`; stands beside them in the YAML.
    sigma: InstrumentSigma = InstrumentSigma()

    @model_validator(mode="before")
    @classmethod
    def _values_with_sigma(cls, given: Any) -> Any:
        if not isinstance(given, Mapping):
            return given
        if "sigma" in given and not isinstance(given["sigma"], InstrumentSigma):
            raise ValueError(
                "a sigma stands beside its value: orientation: {value: [0, 0, 0, 1], sigma: 0.05}"
            )
        plain, sigma = dict(given), {}
        for name in InstrumentSigma.model_fields:
            entry = given.get(name)
            if isinstance(entry, Mapping):
                if set(entry) != {"value", "sigma"}:
                    found = ", ".join(map(str, entry)) or "nothing"
                    raise ValueError(f"'{name}' has {found}, write {name}: {{value: ..., sigma: ...}}")
                plain[name], sigma[name] = entry["value"], entry["sigma"]
        return plain | {"sigma": InstrumentSigma.model_validate(sigma)} if sigma else plain

    @model_validator(mode="after")
    def _has_its_field(self) -> Self:
        if self.cadence <= 0:
            raise ValueError("'cadence' must be positive")
        if self.role in ("vector", "scalar") and "field" not in self.channels:
            raise ValueError(f"a {self.role} instrument needs a channel named 'field'")
        if self.role == "vector" and len(self.channels["field"].axis_names) != 3:
            raise ValueError("the 'field' of a vector instrument needs three axes")
        if not np.isclose(np.linalg.norm(self.orientation), 1.0, atol=1e-6):
            raise ValueError("'orientation' must be a quaternion of length 1")
        return self

    @model_validator(mode="after")
    def _has_moments(self) -> Self:
        for name in ("averaging", "delay"):
            if getattr(self, name) < 0:
                raise ValueError(f"'{name}' must not be negative")
        if self.stamp != "centre" and not self.averaging:
            raise ValueError(f"'stamp: {self.stamp}' needs 'averaging', what a reading is the mean over")
        return self

    @property
    def moment_ns(self) -> int:
        """What is added to a stamp, ns, for the moment of its reading: the middle of its averaging."""
        return {"start": 1, "centre": 0, "end": -1}[self.stamp] * (self.averaging // 2) - self.delay
