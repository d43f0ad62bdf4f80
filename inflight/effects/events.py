"""Steps and episodes of an offset, a scale factor, an angle, a bias, or a clock.

A step holds from option ``at`` on, an episode from ``from`` until ``to``; UTC, half-open. Any parameter of
any effect may also change at events, by ``time: event`` in the model; these classes are for the search, and
for a single change.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.effects.base import AXES, Effect, Parameter, Values
from inflight.effects.sensors import (
    ANGLES,
    VECTOR_ROLES,
    ScalarBias,
    ScaledReading,
    TimeShift,
    add_angles,
    subtract_angles,
)
from inflight.errors import ModelError
from inflight.mission import Mission, Sensor
from inflight.time import to_utc

if TYPE_CHECKING:
    import xarray as xr


class _Dated(Effect):
    """An effect that holds within a span of time."""

    empirical = True

    def prepare(self) -> None:
        """Read the options: a step has ``at``, an episode ``from`` and ``to``."""
        if "at" in self.options:
            self._start, self._end = self.instant("at"), np.iinfo(np.int64).max
            return
        self._start, self._end = self.instant("from"), self.instant("to")
        if self._start >= self._end:
            raise ModelError(
                f"'{self.name}' ends before it begins", remedy="state 'from' before 'to', both in UTC"
            )

    def inside(self, samples: xr.Dataset) -> npt.NDArray[np.bool_]:
        """Return where the effect holds; (time,)."""
        t = samples["tt2000"].values
        return np.asarray((t >= self._start) & (t < self._end))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return, for a step, one candidate for every event the mission names."""
        if "at" not in cls.options:
            return []
        return [{"at": f"{to_utc(event.at)}Z"} for event in mission.events]


class OffsetEpisode(_Dated):
    """A constant field for a while: ``vector`` where ``from <= t < to``, else 0."""

    family = "offset_step"
    options: ClassVar[tuple[str, ...]] = ("from", "to")
    vector = Parameter("nT", AXES, sigma=10.0)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the field within the span, 0 elsewhere; (time, axis) nT."""
        return np.where(self.inside(samples)[:, None], values["vector"], 0.0)


class OffsetStep(OffsetEpisode):
    """A constant field from one moment on: ``vector`` where ``t >= at``, else 0.

    A reset, a switch, a part that was magnetised.
    """

    options = ("at",)


class _DatedReading(_Dated):
    """An effect of a scalar instrument, the class named after this one, that holds within a span only."""

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading as the instrument gives it; (time,) nT."""
        return np.where(self.inside(samples), super().disturb(reading, samples, values, sensor), reading)

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading without the effect; (time,) nT."""
        return np.where(self.inside(samples), super().correct(reading, samples, values, sensor), reading)


class ClockEpisode(_DatedReading, TimeShift):
    """A scalar instrument's time shift for a while: ``F + seconds dF/dt`` in the span, as `time_shift`."""

    options: ClassVar[tuple[str, ...]] = ("from", "to")


class ClockStep(ClockEpisode):
    """A scalar instrument's time shift from one moment on: ``F + seconds dF/dt`` from then."""

    options = ("at",)


class BiasStep(_DatedReading, ScalarBias):
    """A scalar instrument's bias from one moment on: corrected ``F - bias`` where ``t >= at``."""

    options: ClassVar[tuple[str, ...]] = ("at",)


class ScaleEpisode(_Dated, ScaledReading):
    """Scale factors that differ for a while: the corrected reading is ``1 + change`` of it within the span.

    The factor multiplies the reading less `about`, the nominal offset.
    """

    family = "sensor"
    options: ClassVar[tuple[str, ...]] = ("from", "to")
    change = Parameter("1", AXES, step=1e-6, sigma=1e-3)
    about = Parameter("nT", AXES)

    def factor(self, samples: xr.Dataset, values: Values) -> Floats:
        """Return 1 and the change within the span, 1 elsewhere; (time, axis)."""
        return np.where(self.inside(samples)[:, None], 1.0 + values["change"], 1.0)


class ScaleStep(ScaleEpisode):
    """Scale factors that change at one moment: the corrected reading is ``1 + change`` of it from then."""

    options = ("at",)


class AngleEpisode(_Dated):
    """Misalignment angles that differ for a while: ``a = a0 + change`` within the span.

    To first order in the change d of an angle, which is small: ``cos(a0 + d) - cos(a0) = -d`` (Yin
    2010, eq. 2.5). `about` is the nominal offset.
    """

    family = "sensor"
    acts_on = VECTOR_ROLES
    options: ClassVar[tuple[str, ...]] = ("from", "to")
    change = Parameter("deg", ANGLES, step=1e-4, sigma=0.1)
    about = Parameter("nT", AXES)

    def _change(self, samples: xr.Dataset, values: Values) -> Floats:
        return np.where(self.inside(samples)[:, None], values["change"], 0.0)

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading of a sensor with the angles of outside the span; (time, axis) nT."""
        return subtract_angles(reading, values["about"], self._change(samples, values))

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading with the changed angles; (time, axis) nT."""
        return add_angles(reading, values["about"], self._change(samples, values))


class AngleStep(AngleEpisode):
    """Misalignment angles that change at one moment: ``a = a0 + change`` from then."""

    options = ("at",)
