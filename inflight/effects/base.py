"""What an effect is: a class with parameters, the channels it needs, and the field it adds at a sensor.

`Effect.field` gives nT in the orthogonal axes of the vector sensor; `disturb` adds it to a reading and
`correct` takes it off, exact inverses of each other. Of a scalar sensor both act on the projection on the
field's direction. Where the field is made from the reading itself (`follows_field`), `disturb` solves
``reading = truth + field(reading)`` by repetition. `slope` gives rates of change with gaps respected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Protocol
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.errors import ModelError, SamplesError, did_you_mean
from inflight.frames import direction_of
from inflight.mission import Sensor
from inflight.samples import parse_channel
from inflight.time import GAP, SECOND, parse_duration, parse_utc, to_tt2000, to_utc, usual_step
from inflight.units import factor_and_offset, product_factor

if TYPE_CHECKING:
    import xarray as xr

    from inflight.mission import Mission


def snake_case(name: str) -> str:
    """Return ``ScalarBias`` as ``scalar_bias``."""
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")


def response_name(channel: str, lag: Any = None, width: Any = None) -> str:
    """Return the name of a channel's slow response or play, as `inflight.samples.derived` reads it.

    Parameters
    ----------
    channel : str
        A channel, or a derived one without the option that is added.
    lag : duration text, optional
        Time constant, such as ``600 s``.
    width : float, optional
        Full width of the play, in the channel's unit.

    Raises
    ------
    ModelError
        When it makes no channel's name.
    """
    name = channel
    if lag is not None:
        try:
            seconds = parse_duration(str(lag)) / SECOND
        except ValueError as error:
            raise ModelError(f"lag: {error}", channel=channel, remedy="write such as lag: 600 s") from None
        name += f"@lag={seconds:.12g}s" if seconds else ""
    if width is not None:
        try:
            name += f"@width={float(width):.12g}"
        except (TypeError, ValueError):
            raise ModelError(
                f"width: {width!r} is no number", channel=channel, remedy="give it in the channel's unit"
            ) from None
    return parse_channel(name).name if name else name


@dataclass(frozen=True)
class Parameter:
    """A number of an effect.

    Attributes
    ----------
    unit : str
        Unit of the value.
    axes : tuple of str, optional
        Names of the components; None for a single number.
    default : float or tuple of float
        Value that does nothing, or the nominal one.
    sigma : float
        What is known beforehand: standard deviation of the prior around `default`.
    bounds : tuple of float, optional
        Physical limits.
    step : float
        Typical size, the unit of finite differences and of scaled columns.
    linear : bool
        False when the correction is not linear over a typical step.
    bank : tuple of float, optional
        Grid of a parameter that is searched, not solved for (a lag, a width).
    per_channel : int
        Power of the first channel that the value is per: 1 for nT per unit of the channel. A model
        may then state the whole unit (``nT/A``), whatever unit the channel comes in.
    """

    unit: str
    axes: tuple[str, ...] | None = None
    default: float | tuple[float, ...] = 0.0
    sigma: float = float("inf")
    bounds: tuple[float, float] | None = None
    step: float = 1.0
    linear: bool = True
    bank: tuple[float, ...] | None = None
    per_channel: int = 0

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.axes) if self.axes else 1

    @property
    def default_values(self) -> Floats:
        """Default as an array over the axes."""
        return np.broadcast_to(np.asarray(self.default, dtype=np.float64), (self.size,)).copy()


__all__ = [
    "AXES",
    "CHANNEL_OPTIONS",
    "Effect",
    "Parameter",
    "Values",
    "best_field",
    "field_direction",
    "field_strength",
    "multiply",
    "with_field",
]

#: Values of an effect's parameters: each an array over the parameter's axes, or (time, axes).
Values = Mapping[str, Floats]

AXES = ("x", "y", "z")

#: Options of every effect with a channel: which one, and its slow response or play.
CHANNEL_OPTIONS = ("channel", "lag", "width")


@dataclass(frozen=True, kw_only=True)
class RepetitionSettings:
    """How the reading is found from the field where an effect follows the reading (`Effect.disturb`).

    Attributes
    ----------
    settled : float
        nT; it ends when no sample changes by more, and no less than the step before: rounding (derived).
    most_steps : int
        Steps after which it is refused (assumed; effects below a tenth of the field need less than 20).
    diverged : float
        nT; a change beyond this is no solution.
    refined : int
        Solutions of the equations, each of what the one before leaves (assumed).
    near_enough : float
        nT; what a solution of the equations may leave: a thousandth of the best instruments' noise (assumed).
    """

    settled: float = 1e-9
    most_steps: int = 80
    diverged: float = 1e9
    refined: int = 3
    near_enough: float = 1e-6


REPETITION_SETTINGS = RepetitionSettings()


class EffectOrigin(Protocol):
    """The file a user's effect comes from: see `inflight.effects.user_effects.EffectSource`."""

    @property
    def path(self) -> str:
        """The file, as the mission YAML names it."""

    @property
    def sha(self) -> str:
        """Hash of its text."""

    def classes(self) -> dict[str, type[Effect]]:
        """Return the effects it defines, by name."""


class _ParametersOf:
    """``parameters()`` of a class, and of an effect whose options decide how many numbers it has."""

    def __get__(self, effect: Effect | None, kind: type[Effect]) -> Callable[[], dict[str, Parameter]]:
        return partial(_parameters_of, effect, kind)


def _parameters_of(effect: Effect | None, kind: type[Effect]) -> dict[str, Parameter]:
    """Return the parameters that a class and its bases state, those of the effect's options instead.

    Those of the class are kept: a pass asks for them hundreds of times a day.
    """
    if kind not in _stated:
        _stated[kind] = {
            key: value
            for base in reversed(kind.__mro__)
            for key, value in vars(base).items()
            if isinstance(value, Parameter)
        }
    return _stated[kind] | (effect.sized if effect is not None else {})


_stated: WeakKeyDictionary[type, dict[str, Parameter]] = WeakKeyDictionary()


class Effect:
    """One physical cause of disagreement between sensors.

    Subclasses set `family`, `channels` and class attributes of type `Parameter`, and override
    `field`. Effects inside an instrument's equation override `disturb` and `correct`, which must be
    exact inverses of each other.

    Parameters
    ----------
    name : str, optional
        Name in the model; the registered name when absent.
    **options : Any
        The effect's own options, as written in the model YAML (such as ``channel``).
    """

    family: str = "unknown"
    #: True when the kind of the first channel decides the family: see `inflight.effects.families`.
    family_by_channel: ClassVar[bool] = False
    #: Roles of the sensors it may act on, the usual one first.
    acts_on: ClassVar[tuple[str, ...]] = ("vector", "inboard", "outboard", "scalar")
    #: Kinds of comparisons whose residual shows it; all when empty.
    seen_in: ClassVar[tuple[str, ...]] = ()
    #: Names in the samples; an option ``channel`` replaces the first one.
    channels: tuple[str, ...] = ()
    #: Options the YAML may give in addition to parameters.
    options: ClassVar[tuple[str, ...]] = CHANNEL_OPTIONS
    #: True when the field it adds is made from the field at the sensor.
    follows_field: ClassVar[bool] = False
    #: Parameters of several sources (see `along_axes`) are listed source by source (x0, y0, z0, x1, ...);
    #: otherwise axis by axis, as the rows of a matrix are.
    source_first: ClassVar[bool] = False
    #: Each axis of the corrected reading depends on the reading and the parameters of that axis alone.
    axis_by_axis: ClassVar[bool] = False
    #: It describes a shape in time, or in a coordinate, and names no cause. Any effect that was put into a
    #: model for what it looks like may state so: option ``empirical: true``.
    empirical: bool = False
    #: The user's file the class comes from; None for the library and for packages.
    source: ClassVar[EffectOrigin | None] = None
    #: Parameters of the class, by name; of an effect, those its options make of them.
    parameters = _ParametersOf()

    def __init__(self, name: str = "", **options: Any) -> None:
        #: Parameters whose number the options decide; they replace those of the class.
        self.sized: dict[str, Parameter] = {}
        #: Stated units of parameters that are per unit of a channel.
        self.units: dict[str, str] = {}
        known = self.option_names()
        self.empirical = bool(options.pop("empirical", type(self).empirical))
        for key in options:
            if key not in known:
                raise ModelError(
                    f"effect '{self.label()}' has no option and no parameter '{key}'"
                    f"{did_you_mean(key, [*known, *self.parameters()])}",
                    remedy=f"it has options {', '.join(known) or 'none'}, "
                    f"parameters {', '.join(self.parameters()) or 'none'}",
                )
        self.name = name or self.label()
        self.given = dict(options)
        if self.channels and not self.channels[0]:
            self.required("channel")
        if set(CHANNEL_OPTIONS) & set(options):
            first = str(options.get("channel", self.channels[0] if self.channels else ""))
            first = response_name(first, options.get("lag"), options.get("width"))
            self.channels = (first, *self.channels[1:])
        self.prepare()

    def prepare(self) -> None:
        """Read the options; called once, for subclasses to override."""

    def reach_s(self, cadence_s: float) -> float:
        """Return how far before and after a sample lies what its field is made from, s; 0 unless overridden.

        A day is corrected with so much of its neighbours, so that the field does not step at midnight. Slow
        responses and plays of channels are no part of it: they come with their own past.
        """
        del cadence_s
        return 0.0

    def require_complete(self) -> None:
        """Raise `ModelError` when an option is missing that only a search may leave open."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle so that a worker makes the class anew where it is a user's own."""
        kind = type(self) if self.source is None else (self.source, self.label())
        return _rebuild, (kind, self.__dict__)

    @classmethod
    def label(cls) -> str:
        """Registered name: the class name in snake case."""
        return snake_case(cls.__name__)

    @classmethod
    def option_names(cls) -> tuple[str, ...]:
        """Options the YAML may give: those of the class, and of its channel when it has one."""
        own = [key for key in cls.options if key not in CHANNEL_OPTIONS]
        return (*(CHANNEL_OPTIONS if cls.channels else ()), *own)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the options of one candidate for every channel of the kind the effect is made from."""
        return []

    @classmethod
    def is_plain_field(cls) -> bool:
        """Return True when it only adds a field that nothing but channels and time decide."""
        return cls.correct is Effect.correct and not cls.follows_field

    def duration(self, key: str) -> int:
        """Return an option that is a duration, nanoseconds.

        Raises
        ------
        ModelError
            When the option is missing or no duration above 0.
        """
        try:
            found = parse_duration(str(self.required(key)))
        except ValueError as error:
            raise ModelError(f"'{self.name}': {key}: {error}", remedy="write such as 20 s") from None
        if found <= 0:
            raise ModelError(f"'{self.name}': {key} is {self.given[key]}", remedy="state one above 0")
        return found

    def instant(self, key: str) -> int:
        """Return an option that is a UTC date or time, as TT2000 nanoseconds.

        Raises
        ------
        ModelError
            When the option is missing or no time.
        """
        try:
            found = int(to_tt2000(parse_utc(self.required(key))))
        except ValueError as error:
            raise ModelError(f"'{self.name}': {key}: {error}", remedy="write such as 2008-08-27") from None
        self.given[key] = f"{to_utc(found)}Z"
        return found

    def required(self, key: str) -> Any:
        """Return an option that must be stated; an error names it otherwise."""
        if self.given.get(key) is None:
            raise ModelError(
                f"effect '{self.name}' needs the option '{key}'", remedy="state it beside 'effect'"
            )
        return self.given[key]

    def whole_number(self, key: str, default: int, most: int) -> int:
        """Return an option that is a whole number from 1 to `most`.

        Raises
        ------
        ModelError
            When it is none.
        """
        found = self.given.get(key, default)
        if not isinstance(found, int) or not 1 <= found <= most:
            raise ModelError(
                f"'{self.name}': {key} is {found!r}", remedy=f"state a whole number from 1 to {most}"
            )
        return found

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return what the cause adds at `sensor`; (time, axis) nT in the vector sensor's orthogonal axes."""
        raise NotImplementedError(f"{type(self).__name__} adds no field")

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return what multiplies each axis of a parameter in `field`; (time,), of several (time, source).

        To be defined beside `field`, where that is a sum of parameters (axis) times one series each, or of
        parameters of several sources (in the order `source_first` says) times as many: columns are then made
        of the series, without a field for every one.
        """
        raise NotImplementedError(f"the field of {type(self).__name__} is no series times a vector")

    @classmethod
    def acts_along_axes(cls) -> bool:
        """Return True when `along_axes` is defined with the `field` in use."""
        owner = next(kind for kind in cls.__mro__ if "field" in vars(kind))
        return owner is not Effect and "along_axes" in vars(owner)

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading with the effect in it; (time, axis) or, for a scalar sensor, (time,) nT."""
        if self.follows_field and not sensor.is_scalar:
            return self._reading_of(reading, samples, values, sensor)
        return reading + self._at(samples, values, sensor)

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading without the effect; the exact inverse of `disturb`.

        At a vector sensor an effect that follows the field is made from the reading itself.
        """
        if self.follows_field and not sensor.is_scalar:
            return reading - self.field(with_field(samples, reading), values, sensor)
        return reading - self._at(samples, values, sensor)

    def _reading_of(self, truth: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading that `correct` turns into the truth, by repetition; (time, axis) nT."""
        reading, last = truth, np.inf
        for _ in range(REPETITION_SETTINGS.most_steps):
            more = truth + self.field(with_field(samples, reading), values, sensor) - reading
            change = float(np.nanmax(np.abs(more), initial=0.0))
            if change == 0.0 or last <= change < REPETITION_SETTINGS.settled:
                return np.asarray(reading + more)
            if change > REPETITION_SETTINGS.diverged:
                break
            reading, last = reading + more, change
        # What follows the field's rate may go ever further round: as linear equations it is solved at once.
        solved = self._solved(truth, samples, values, sensor)
        if solved is not None:
            return solved
        raise ModelError(
            f"effect '{self.name}' is too strong to be told from the field it follows",
            remedy="check the unit and the size of its parameters",
        )

    def _solved(self, truth: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats | None:
        """Return the reading that `correct` turns into the truth, by GMRES; None where that finds none."""
        from scipy.sparse.linalg import LinearOperator, gmres

        known = np.isfinite(truth)
        none = self.field(with_field(samples, np.where(known, 0.0, np.nan)), values, sensor)

        def less_field(flat: Floats) -> Floats:
            field = np.where(known, flat.reshape(truth.shape), np.nan)
            made = self.field(with_field(samples, field), values, sensor) - none
            return np.where(known, np.nan_to_num(field - made), 0.0).ravel()

        right = np.where(known, np.nan_to_num(truth + none), 0.0).ravel()
        operator = LinearOperator((right.size, right.size), matvec=less_field, dtype=np.float64)
        found = np.nan_to_num(truth).ravel()
        for _ in range(REPETITION_SETTINGS.refined):
            # What rounding left of the solution before is solved for in turn.
            left = right - less_field(found)
            found = (
                found + gmres(operator, left, rtol=1e-9, restart=REPETITION_SETTINGS.most_steps, maxiter=2)[0]
            )
        reading = np.where(known, found.reshape(truth.shape), np.nan)
        off = reading - self.field(with_field(samples, reading), values, sensor) - truth
        worst = float(np.nanmax(np.abs(off), initial=0.0))
        return reading if worst < REPETITION_SETTINGS.near_enough else None

    def _at(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return what the field adds to the reading: itself, or its projection on the field direction."""
        field = self.field(samples, values, sensor)
        if not sensor.is_scalar:
            return field
        return np.asarray(np.einsum("ta,ta->t", field_direction(samples), field))

    @property
    def is_additive(self) -> bool:
        """True when the effect only adds a field that does not depend on the reading."""
        return type(self).is_plain_field()

    def drive(self, samples: xr.Dataset, key: str, index: int = 0, about: Floats | float = 0.0) -> Floats:
        """Return the channel that multiplies a parameter; (time,) or (time, axis).

        The parameter's value times this is in the parameter's own unit, nT for a field: the unit a
        model states (``nT/A``) and the channel's (``mA``) are made to agree.

        Parameters
        ----------
        key : str
            The parameter.
        index : int
            Which of the effect's channels.
        about : float or ndarray
            What is taken off first, in the channel's unit.

        Raises
        ------
        SamplesError
            When the channel is missing, or the units do not agree.
        """
        parameter = self.parameters()[key]
        power = max(parameter.per_channel, 1)
        series = self.series(samples, index) - about
        series = series if power == 1 else series**power
        stated = self.units.get(key, parameter.unit)
        if stated == parameter.unit:
            return series
        unit = str(samples[self.channels[index]].attrs.get("units", "1"))
        try:
            return series * product_factor(stated, unit, power, parameter.unit)
        except ValueError as error:
            raise SamplesError(
                f"'{self.name}.{key}': {error}",
                channel=self.channels[index],
                remedy=f"state a unit that times the channel's is {parameter.unit}",
            ) from None

    def series(self, samples: xr.Dataset, index: int = 0) -> Floats:
        """Return a channel of this effect as it is, in its own unit; (time,) or (time, axis)."""
        name = self.channels[index]
        return self.channel(
            samples, str(samples[name].attrs.get("units", "1")) if name in samples else "1", index
        )

    def channel(self, samples: xr.Dataset, unit: str, index: int = 0) -> Floats:
        """Return a channel of this effect in `unit`; (time,) or (time, axis).

        Raises
        ------
        SamplesError
            When the channel is missing or has another dimension.
        """
        name = self.channels[index]
        if name not in samples:
            raise SamplesError(
                f"effect '{self.name}' needs a channel the samples have not",
                channel=name,
                remedy="name it in the mission YAML, or drop the effect from the model",
            )
        series = samples[name]
        try:
            factor, offset = factor_and_offset(str(series.attrs.get("units", unit)), unit)
        except ValueError as error:
            raise SamplesError(str(error), channel=name, remedy="correct the channel's unit") from None
        values = np.asarray(series.values, dtype=np.float64)
        return values * factor + offset if offset else values * factor


def _rebuild(kind: type[Effect] | tuple[EffectOrigin, str], state: dict[str, Any]) -> Effect:
    if isinstance(kind, tuple):
        source, label = kind
        kind = source.classes()[label]
    effect = kind.__new__(kind)
    effect.__dict__.update(state)
    return effect


def best_field(samples: xr.Dataset) -> Floats:
    """Return the best present field estimate; (time, axis) nT, vector sensor axes.

    Raises
    ------
    SamplesError
        When there is none yet: the effect is one of those that it is made with.
    """
    if "field" not in samples:
        raise SamplesError(
            "the field is not known before the vector sensor's readings are corrected",
            channel="field",
            remedy="set follows_field = True in the effect's class: the reading then stands for the field",
        )
    return np.asarray(samples["field"].values, dtype=np.float64)


def with_field(samples: xr.Dataset, field: Floats) -> xr.Dataset:
    """Return samples that hold a field estimate (time, axis), nT, and its direction for all who ask."""
    dims = ("time", "axis")
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = field / np.sqrt(np.einsum("ta,ta->t", field, field))[:, None]
    return samples.assign(
        field=(dims, field, {"units": "nT", "frame": "sensor"}), field_direction=(dims, unit, {"units": "1"})
    )


def field_direction(samples: xr.Dataset) -> Floats:
    """Return the unit vector of the best present field estimate; (time, axis), vector sensor axes."""
    if "field_direction" in samples:
        return np.asarray(samples["field_direction"].values, dtype=np.float64)
    return direction_of(best_field(samples))


def multiply(flat: Floats, vectors: Floats) -> Floats:
    """Return matrix times vector at each time; (time, 3).

    Parameters
    ----------
    flat : ndarray, shape (9,) or (time, 9)
        Matrix, row by row, constant or at each time.
    vectors : ndarray, shape (time, 3)
    """
    if flat.ndim == 1:
        # This way round each axis of the product is one run of memory.
        return np.asarray((flat.reshape(3, 3) @ vectors.T).T)
    return np.asarray(np.einsum("tij,tj->ti", flat.reshape(-1, 3, 3), vectors))


def field_strength(samples: xr.Dataset) -> Floats:
    """Return |B| of the best present field estimate; (time,) nT."""
    field = best_field(samples)
    return np.asarray(np.sqrt(np.einsum("ta,ta->t", field, field)))


#: Steps are equal when they differ by less than this part of the usual one.
_EVEN = 1e-3


def reach_of_rate(effect: Effect, cadence_s: float) -> float:
    """Return `Effect.reach_s` of an effect that follows a rate: two neighbours on either side."""
    del effect
    return 2.0 * cadence_s


def time_derivative(values: Floats, tt2000: npt.NDArray[np.int64], order: int = 4) -> Floats:
    """Return the rate of change, a second; NaN where a sample has no neighbour.

    Of fourth order where two neighbours on either side are equally far, else central, one-sided at the
    ends of gap-free runs: a field that swings within some samples must not seem to change too slowly.

    Parameters
    ----------
    values : ndarray, shape (time,) or (time, axis)
        NaN where missing.
    tt2000 : ndarray, shape (time,)
        Stamps, nanoseconds.
    order : int
        4, or 2 for the plain form throughout.
    """
    if len(values) < 2:
        return np.full_like(values, np.nan)
    step = np.diff(tt2000) / SECOND
    usual = usual_step(tt2000) / SECOND
    apart = step > GAP * usual
    shape = (-1,) + (1,) * (values.ndim - 1)
    change = np.diff(values, axis=0) / step.reshape(shape)
    change[apart] = np.nan
    complete = bool(np.isfinite(change.sum()))
    if complete:
        sides = np.concatenate([change[:1], 0.5 * (change[:-1] + change[1:]), change[-1:]])
    else:
        missing = np.full_like(values[:1], np.nan)
        before, after = np.concatenate([missing, change]), np.concatenate([change, missing])
        both = 0.5 * (before + after)
        sides = np.where(np.isfinite(both), both, np.where(np.isfinite(before), before, after))
    if len(values) < 5 or order < 4:
        return sides
    outer = change[:-3] + change[3:]
    inner = change[1:-2] + change[2:-1]
    fine = (7.0 * inner - outer) / 12.0
    # Uneven steps, by more than a stamp's rounding, keep the plain form.
    is_even = bool(np.ptp(step) < _EVEN * usual)
    if not is_even:
        fours = [step[first : step.size - 3 + first] for first in range(4)]
        uneven = np.maximum.reduce(fours) - np.minimum.reduce(fours) >= _EVEN * usual
        fine[uneven] = np.nan
    if complete and is_even:
        sides[2:-2] = fine
        return sides
    sides[2:-2] = np.where(np.isfinite(fine), fine, sides[2:-2])
    return sides


def knots_of(effect: Effect, key: str) -> Floats:
    """Return an option that lists at least two rising numbers.

    Raises
    ------
    ModelError
        When it does not.
    """
    given = effect.required(key)
    try:
        knots = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        knots = np.empty(0)
    if knots.ndim != 1 or knots.size < 2 or not np.all(np.diff(knots) > 0):
        raise ModelError(
            f"'{effect.name}': {key} is {given!r}",
            remedy="list two or more rising numbers, in units of what it is a function of",
        )
    effect.given[key] = knots.tolist()
    return knots
