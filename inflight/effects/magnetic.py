"""Fields made by the field itself: soft magnetic parts, eddy currents, cross-talk between axes."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.effects.base import AXES, Effect, Parameter, Values, best_field, multiply
from inflight.effects.channels import MATRIX
from inflight.effects.rates import slope
from inflight.effects.vector_sensor import ANGLES, VECTOR_ROLES
from inflight.mission import Mission
from inflight.sensors import Sensor

#: Components of a symmetric matrix: its diagonal, then above it.
SYMMETRIC = ("xx", "yy", "zz", "xy", "xz", "yz")


class Induced(Effect):
    """Field proportional to the ambient one an axis: soft magnetic material, cross-talk of a sensor."""

    family = "induced"
    acts_on = ("scalar", "vector", "inboard", "outboard")
    follows_field = True
    diagonal = Parameter("1", AXES, step=1e-6, sigma=5e-5)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``diagonal * B``; (time, axis) nT (Yin 2010, section 2.5, the q terms)."""
        return np.asarray(best_field(samples) * values["diagonal"])

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is."""
        return [{}]


class SoftIron(Induced):
    """`induced` with coupling between the axes: a full symmetric matrix times the field.

    The matrix of a body without currents is symmetric (Leliak 1961, eq. 12).
    """

    coupling = Parameter("1", ANGLES, step=1e-6, sigma=5e-5)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``matrix @ B``; (time, axis) nT."""
        parts = np.broadcast_arrays(values["diagonal"], values["coupling"])
        return _symmetric(np.concatenate(parts, axis=-1), best_field(samples))


class Eddy(Effect):
    """Field of eddy currents an axis, in seconds: ``diagonal * dB/dt``.

    The sensor sees the field late by `diagonal`; on the boom axis and across it differently.
    """

    family = "eddy"
    follows_field = True
    diagonal = Parameter("s", AXES, step=1e-2, sigma=0.3)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``diagonal * dB/dt``; (time, axis) nT, NaN where no neighbour tells the rate."""
        diagonal = values["diagonal"]
        return np.where(diagonal == 0.0, 0.0, _field_rate(samples) * diagonal)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is."""
        return [{}]


class TollesLawson(Effect):
    """Permanent, induced and eddy-current field of a platform (Tolles and Lawson; Leliak 1961).

    ``permanent + induced @ B + eddy @ dB/dt`` with 3, 6 and 9 coefficients; rows of `eddy` are field
    axes. Of a scalar sensor's eighteen columns two are the field strength and its rate, which change
    little on the way: expect them to be badly determined.
    """

    family = "induced"
    acts_on = ("scalar", "vector", "inboard", "outboard")
    follows_field = True
    permanent = Parameter("nT", AXES, step=1.0, sigma=1e3)
    induced = Parameter("1", SYMMETRIC, step=1e-6, sigma=0.1)
    eddy = Parameter("s", MATRIX, step=1e-2, sigma=1.0)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the sum of the three; (time, axis) nT."""
        induced = _symmetric(values["induced"], best_field(samples))
        return np.asarray(values["permanent"] + induced + multiply(values["eddy"], _field_rate(samples)))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is, for a platform that turns in the field."""
        return [{}] if _compares(mission, "platform") else []


class CrossTalk(Effect):
    """Each axis reads some of the others: ``reading = (1 + C) E`` with six numbers beside the diagonal.

    Components are named by what reads and what is read: xy is what axis x reads of y. It acts on the
    reading as the electronics pass it on, offsets included.
    """

    family = "sensor"
    acts_on = VECTOR_ROLES
    follows_field = True
    coupling = Parameter("1", ("xy", "xz", "yx", "yz", "zx", "zy"), step=1e-6, sigma=1e-3)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``C @ E``; (time, axis) nT."""
        ex, ey, ez = best_field(samples).T
        c = np.moveaxis(values["coupling"], -1, 0)
        return np.stack([c[0] * ey + c[1] * ez, c[2] * ex + c[3] * ez, c[4] * ex + c[5] * ey], axis=1)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is: a field strength alone tells it not from the nine."""
        return [{}] if _compares(mission, "dual") else []


def _compares(mission: Mission, kind: str) -> bool:
    return any(comparison.kind == kind for comparison in mission.comparisons.values())


def _symmetric(parts: Floats, field: Floats) -> Floats:
    """Return a symmetric matrix, (6,) or (time, 6) ordered as `SYMMETRIC`, times vectors; (time, 3)."""
    xx, yy, zz, xy, xz, yz = np.moveaxis(parts, -1, 0)
    bx, by, bz = field.T
    return np.stack(
        [xx * bx + xy * by + xz * bz, xy * bx + yy * by + yz * bz, xz * bx + yz * by + zz * bz], axis=1
    )


def _field_rate(samples: xr.Dataset) -> Floats:
    """Return dB/dt of the best present field; (time, axis) nT/s."""
    # The reading is found from the field by repetition, which a finer form would make diverge earlier.
    return slope(best_field(samples), samples["tt2000"].values, order=2)
