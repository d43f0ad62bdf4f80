"""A mission: instruments, channels, files, known periods and events, as one YAML a person writes.

`Mission.parse` validates a text and names line and key of whatever is wrong. It opens no file; the
catalog reads the text. See ``missions/template.yaml`` for every key with a comment.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    model_validator,
)
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError

from inflight.errors import MissionError
from inflight.time import parse_duration, parse_utc, to_tt2000
from inflight.units import parse_unit

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
    "sunlight",
    "frequency",
    "flag",
    "other",
]
Reader = Literal["cdf", "netcdf", "iaga2002", "table", "parquet", "npz", "mat"]


def _unit(text: Any) -> str:
    parse_unit(str(text))
    return str(text)


def _list(value: Any) -> Any:
    return value if value is None or isinstance(value, list) else [value]


def _utc(value: Any) -> int:
    return int(to_tt2000(parse_utc(value)))


#: A duration in the YAML (``10 s``), integer nanoseconds in Python.
Duration = Annotated[int, BeforeValidator(parse_duration)]
Unit = Annotated[str, BeforeValidator(_unit)]
#: A UTC time in the YAML, TT2000 nanoseconds in Python.
Instant = Annotated[int, BeforeValidator(_utc)]
Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Channel(_Strict):
    """One measured series: where it stands in a file, and what it is.

    `variable` names one variable (of shape (time,) or, with `axes`, (time, axis)); `variables` names
    one variable an axis.
    """

    variable: str | None = None
    variables: list[str] | None = None
    #: Position of this channel in a variable with several columns, when only one is wanted.
    column: int | None = None
    unit: Unit
    axes: list[str] | None = None
    kind: Kind = "other"
    #: Values that stand for "missing", beside the file's own fill value and NaN.
    fill: Annotated[list[float] | None, BeforeValidator(_list)] = None
    resolution: Annotated[float, Field(gt=0)] | None = None
    #: The field follows its channel by this much; negative when it leads.
    lag: Duration = 0
    #: Readings outside [low, high] are flagged OUT_OF_RANGE and not used.
    range: tuple[float, float] | None = None
    #: Frame of an attitude or a position: itrf, gcrf, nec, gse.
    frame: str | None = None
    description: str = ""

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
        """Names of the axes; empty for a channel of one number a time."""
        if self.axes is not None:
            return tuple(self.axes)
        if self.variables is not None and len(self.variables) == 3:
            return ("x", "y", "z")
        return tuple(self.variables or ())


class Files(_Strict):
    """Where an instrument's files are and how they are read; options are shared by all readers."""

    #: Path below the data folder with ``*``, ``?`` and ``{day:%Y%m%d}``, ``{start:...}``, ``{end:...}``.
    pattern: Annotated[list[str] | None, BeforeValidator(_list)] = None
    #: Take the files of another instrument.
    same_as: str | None = None
    reader: Reader | None = None
    #: Variable or columns that hold the time; columns are joined by a blank.
    time: Annotated[list[str] | None, BeforeValidator(_list)] = None
    #: strptime format of text times; without a date in it, the day comes from the file name.
    time_format: str | None = None
    #: What numeric times count: CF units ("seconds since 2000-01-01 12:00:00"), or "tt2000".
    time_unit: str | None = None
    #: Added to every stamp: 13 s when the stamps are 13 s early.
    clock_offset: Duration = 0
    #: The largest disagreement allowed between a file name's day and its rows' own.
    spill: Duration = 86_400_000_000_000
    drop: list[str] = []
    #: Times and fields of shape (report, sample) become one series.
    flatten: bool = False
    #: Expression over variables of the file; rows where it is false are flagged INSTRUMENT_FLAG.
    good_when: str | None = None
    delimiter: str | None = None
    decimal: Literal[".", ","] = "."
    encoding: str = "utf-8"
    skip: Annotated[int, Field(ge=0)] = 0
    #: Names of the columns when the file has no header line.
    columns: list[str] | None = None
    comment: str | None = None

    @model_validator(mode="after")
    def _pattern_or_same(self) -> Self:
        if (self.pattern is None) == (self.same_as is None):
            raise ValueError("give either 'pattern' or 'same_as'")
        if self.pattern is not None and self.reader is None:
            raise ValueError("'reader' is missing")
        return self


class Instrument(_Strict):
    """One instrument with its own cadence and files."""

    role: Role
    cadence: Duration
    files: Files
    channels: dict[str, Channel]
    #: Metres from the origin that `positions` describes, spacecraft axes.
    position: Vector3 | None = None
    #: Quaternion x, y, z, w that turns sensor axes into spacecraft axes.
    orientation: Quaternion = (0.0, 0.0, 0.0, 1.0)

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


class Positions(_Strict):
    """What the instruments' positions are measured in and from."""

    unit: Unit = "m"
    axis_along_boom: Literal["x", "y", "z"] | None = None
    origin: str = ""


class Event(_Strict):
    """Something that happened at a known time: a reset, a manoeuvre, a switch-over."""

    at: Instant
    name: str
    kind: str = "event"


class ScalarComparison(_Strict):
    """|B_vector| minus the field strength of an absolute instrument (one row a sample, nT)."""

    kind: Literal["scalar"]
    vector: str
    scalar: str
    #: The instrument whose stamps carry the comparison; the slower of the two when absent.
    base: str | None = None

    def instruments(self) -> dict[str, str]:
        """Return role in the comparison -> instrument."""
        return {"vector": self.vector, "scalar": self.scalar}


class DualComparison(_Strict):
    """Difference of two vector sensors in spacecraft axes (three rows a sample, nT)."""

    kind: Literal["dual"]
    inboard: str
    outboard: str
    base: str | None = None

    def instruments(self) -> dict[str, str]:
        """Return role in the comparison -> instrument."""
        return {"inboard": self.inboard, "outboard": self.outboard}


class SpinComparison(_Strict):
    """Spin tones of one vector sensor (six rows an interval, nT)."""

    kind: Literal["spin"]
    vector: str
    base: str | None = None

    def instruments(self) -> dict[str, str]:
        """Return role in the comparison -> instrument."""
        return {"vector": self.vector}


class PlatformComparison(_Strict):
    """In-band scalar field with the vector sensor as direction only (one row a sample, nT)."""

    kind: Literal["platform"]
    scalar: str
    vector: str
    base: str | None = None

    def instruments(self) -> dict[str, str]:
        """Return role in the comparison -> instrument."""
        return {"scalar": self.scalar, "vector": self.vector}


Comparison = Annotated[
    ScalarComparison | DualComparison | SpinComparison | PlatformComparison, Field(discriminator="kind")
]


class Mission(_Strict):
    """A whole mission, immutable; `text` is what it was read from."""

    mission: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]
    description: str = ""
    #: Repeated wherever a figure made from the data is shown.
    acknowledgement: str = ""
    periods: dict[str, Duration] = {}
    positions: Positions = Positions()
    instruments: dict[str, Instrument]
    comparisons: dict[str, Comparison]
    #: Model file with the pre-flight calibration, relative to the mission YAML.
    preflight: str | None = None
    events: list[Event] = []
    #: Python files with the user's own effects.
    effects: list[str] = []
    _text: str = PrivateAttr(default="")

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
            for role, instrument_name in named.items():
                if instrument_name not in self.instruments:
                    raise ValueError(f"comparisons.{name}.{role}: there is no instrument {instrument_name!r}")
            for role in ("vector", "scalar"):
                wanted = comparison.instruments().get(role)
                if wanted and self.instruments[wanted].role != role:
                    raise ValueError(
                        f"comparisons.{name}.{role}: {wanted!r} has role {self.instruments[wanted].role!r}"
                    )
        return self

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
                remedy="missions/template.yaml shows every key",
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

    def files(self, instrument: str) -> Files:
        """Return how an instrument's files are found; `same_as` is resolved, its own options win."""
        own = self.instruments[instrument].files
        if own.same_as is None:
            return own
        shared = self.instruments[own.same_as].files
        overrides = own.model_dump(exclude_unset=True, exclude={"same_as"})
        # Durations are already nanoseconds here, so the copy must not be validated again.
        return shared.model_copy(update=overrides)

    def channel_instruments(self) -> Iterator[tuple[str, str, Channel]]:
        """Yield (instrument, channel name, channel) of every channel but the fields themselves."""
        for name, instrument in self.instruments.items():
            for channel_name, channel in instrument.channels.items():
                if channel_name != "field":
                    yield name, channel_name, channel


def _load_yaml(text: str, source: str) -> Any:
    try:
        tree = YAML(typ="rt").load(text)
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
            "line 1: the file holds no keys", file=source, remedy="start from missions/template.yaml"
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
