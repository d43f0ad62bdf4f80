"""Fields the spacecraft makes at a sensor: torquers, magnetised parts, the solar array.

`panel_illumination` and `panel_weights_at` give the share of each solar panel in the light: by the Sun's
direction, or by the local time of the orbit (Yin 2010, section 3.4.1).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.effects.base import AXES, Effect, Parameter, Values, multiply
from inflight.effects.channels import MATRIX, weighted_vectors
from inflight.effects.families import channels_of_kind, options_of_channels
from inflight.errors import ModelError
from inflight.mission import Mission, Sensor

if TYPE_CHECKING:
    import xarray as xr

#: Days in which the local time falls by 24 h, and the hour at which the thesis' schedule begins.
PANEL_CYCLE_DAYS, PANEL_CYCLE_START_H = 260.5, 9.0

#: Outward normals in spacecraft axes: two sides that lean by 45 degrees, and the top.
SIDE_NORMALS = ((0.0, -(0.5**0.5), -(0.5**0.5)), (0.0, 0.5**0.5, -(0.5**0.5)))

TOP_NORMAL = (0.0, 0.0, -1.0)


def panel_weights_at(local_time: Floats) -> Floats:
    """Return the weights of first and second panel by the node's local time; (epoch, 2), of sum 1.

    Parameters
    ----------
    local_time : ndarray, shape (epoch,)
        h, of the ascending node. It falls: a cycle begins at 9 h and its quarters, 65.125 of 260.5
        days, end at 3, 21, 15 and 9 h.
    """
    return panel_weights_of_cycle(((PANEL_CYCLE_START_H - np.asarray(local_time)) % 24.0) / 24.0)


def panel_weights_of_cycle(turn: Floats) -> Floats:
    """Return the weights of first and second panel by the turns since a cycle began; (time, 2), of sum 1."""
    part = np.asarray(turn) % 1.0
    angle = 0.5 * np.pi * (np.clip(4 * part - 1, 0.0, 1.0) - np.clip(4 * part - 3, 0.0, 1.0))
    light = np.stack([np.sin(angle), np.cos(angle)], axis=1)
    return np.asarray(light / light.sum(axis=1, keepdims=True))


def panel_illumination(sun: Floats, normals: npt.ArrayLike, areas: npt.ArrayLike | None = None) -> Floats:
    """Return the share of each panel in the light; (time, panel), of sum 1, 0 where none is lit.

    Parameters
    ----------
    sun : ndarray, shape (time, 3)
        Unit vector to the Sun, axes of the normals.
    normals : array_like, shape (panel, 3)
    areas : array_like, shape (panel,), optional
        Currents at normal incidence relative to each other; equal when absent.

    Where the direction is NaN, so are the shares.
    """
    rows = np.asarray(normals, dtype=np.float64)
    size = np.ones(len(rows)) if areas is None else np.asarray(areas, dtype=np.float64)
    light = np.clip(sun @ rows.T, 0.0, None) * size
    # Sum and quotient in the quickest of their forms: this is asked for by every pass over every day.
    total = light @ np.ones(len(rows))
    return np.asarray(light / np.where(total == 0.0, 1.0, total)[:, None])


def _of_panels(count: int) -> tuple[str, ...]:
    return tuple(f"{axis}{panel}" for panel in range(count) for axis in AXES)


def _unit_rows(given: Any, name: str) -> Floats:
    """Return normals as unit vectors, shape (panel, 3)."""
    try:
        rows = np.asarray(given, dtype=np.float64).reshape(-1, 3)
        size = np.linalg.norm(rows, axis=1, keepdims=True)
    except (TypeError, ValueError):
        rows, size = np.empty((0, 3)), np.zeros((0, 1))
    if len(rows) < 2 or np.any(size == 0.0):
        raise ModelError(
            f"'{name}': normals are {given!r}", remedy="list two or more vectors of three numbers"
        )
    return np.asarray(rows / size)


def _areas(given: Any, count: int, name: str) -> Floats:
    """Return relative areas, shape (panel,): not negative, and some of them are there."""
    try:
        found = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (count,) or not (found >= 0.0).all() or not 0.0 < found.sum() < np.inf:
        raise ModelError(
            f"'{name}': areas are {given!r} for {count} panels",
            remedy="list one number for each of 'normals', 0 or more",
        )
    return found


class Torquer(Effect):
    """Stray field of the three magneto-torquers: ``matrix @ current`` (Yin 2010, section 2.3).

    Rows of the matrix are field axes, columns the coils; each sensor has its own matrix.
    """

    family = "torquer"
    channels = ("torquer_current",)
    matrix = Parameter("nT/A", MATRIX, sigma=5.0)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the stray field; (time, axis) nT."""
        return multiply(values["matrix"], self.channel(samples, "A"))

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return the currents; (time, source) A."""
        return self.channel(samples, "A")

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every three currents of torquers."""
        return options_of_channels(channels_of_kind(mission, "torquer_current", width=3))


class Remanent(Effect):
    """Constant field of the spacecraft's magnetised parts at one sensor: ``vector``."""

    family = "remanent"
    vector = Parameter("nT", AXES, sigma=1.0)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the constant vector; (time, axis) nT."""
        return np.asarray(np.broadcast_to(values["vector"], (samples.sizes["time"], 3)))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is."""
        return [{}]


class RemanentMoment(Effect):
    """Field of the body's magnetic moment, which the torquers cancel on average (Yin 2010, section 3.4.4).

    ``eta (0, mean I_y, mean I_z)``, with the mean of the torquers' currents over a cycle of local time from a
    table (``current: {time: table, table: main-torquer-mean}``). Along the boom the sign would turn; the mean
    I_x is taken as 0. It is corrected with the torquers' own field, and instead of a constant remanent field.
    """

    family = "remanent"
    eta = Parameter("nT/A", sigma=20.0)
    current = Parameter("A", AXES)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``eta (0, I_y, I_z)``; (time, axis) nT."""
        made = values["eta"] * values["current"] * np.array([0.0, 1.0, 1.0])
        return np.asarray(np.broadcast_to(made, (samples.sizes["time"], 3)))


class SolarArray(Effect):
    """Stray field of the solar current, whose loops change with the panel that is lit.

    The coefficient of each time is the mean of the panels', weighted by the light on each: option
    ``normals`` lists the panels' outward normals in vector sensor axes, and the weight is the cosine
    of the Sun's direction from each, times its own of ``areas`` where these are given (currents at
    normal incidence relative to each other). Without normals the weights follow the local time of the
    orbit (Yin 2010, section 3.4.1): from ``since``, when the ascending node was at 9 h and falling, the
    second panel for a quarter of ``cycle``, then ``sin th, cos th`` of first and second with th rising to
    90 degrees, then the first, then th falling. Components are named by axis and panel: x0, y0, z0, x1, ...
    """

    family = "solar"
    channels: tuple[str, ...] = ("solar_current",)
    options = ("channel", "lag", "normals", "areas", "since", "cycle")
    source_first = True
    panels = Parameter("nT/A", _of_panels(2), sigma=1.0, step=1e-2)

    def prepare(self) -> None:
        """Read the panels' normals and areas, or when the schedule began."""
        self._normals: Floats | None = None
        self._areas: Floats | None = None
        self._since, self._cycle = 0, 1
        if "normals" in self.given:
            self._normals = _unit_rows(self.given["normals"], self.name)
            if "areas" in self.given:
                self._areas = _areas(self.given["areas"], len(self._normals), self.name)
            self.channels = (self.channels[0], "sun_direction")
            self.sized = {"panels": replace(type(self).panels, axes=_of_panels(len(self._normals)))}
        elif "areas" in self.given:
            raise ModelError(
                f"'{self.name}' has areas and no normals", remedy="list the panels' normals, or drop 'areas'"
            )
        else:
            self._since = self.instant("since")
            self.given.setdefault("cycle", "260.5 d")
            self._cycle = self.duration("cycle")

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``current * sum of light * panel``; (time, axis) nT."""
        return weighted_vectors(self.along_axes(samples, "panels"), values["panels"])

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return the current times the light on each panel; (time, source) A."""
        current = self.channel(samples, "A")
        if self._normals is None:
            light = panel_weights_of_cycle((samples["tt2000"].values - self._since) / self._cycle)
        else:
            light = panel_illumination(self.series(samples, 1), self._normals, self._areas)
        return np.asarray(current[:, None] * light)
