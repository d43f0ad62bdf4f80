"""A second fluxgate on the boom: its own sensor in the same ambient field and near the same dipoles."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import numpy as np
import scipy

from inflight.simulate.dipole import extrapolate_dipole
from inflight.simulate.grid import Float
from inflight.simulate.parameters import Matrix, Parameters, Vector

#: Extra effects that only the first fluxgate has: what is at, or in, one sensor.
_FIRST_ONLY = frozenset(
    {
        "day_night",
        "unrecorded_heater",
        "eddy",
        "hysteresis",
        "adc_temperature",
        "offset_steps",
        "offset_drift",
    }
)


def second_effects(effects: Collection[str]) -> frozenset[str]:
    """Return the effects that act on the second fluxgate."""
    return frozenset(effects) - _FIRST_ONLY


def as_second(parameters: Parameters) -> Parameters:
    """Return parameters in which the second fluxgate takes the place of the first.

    Its place decides what each dipole makes there (Yin 2010, after eq. 3.1); torquers are taken as
    dipoles at the origin of the boom's axis, where only their distance counts.
    """

    def at_second(field: Vector, position: Vector) -> Vector:
        first, second = parameters.vector_position, parameters.second_position
        return _vector(extrapolate_dipole(field, position, first, second))

    panels = zip(parameters.panel_fields, parameters.panel_positions, strict=True)
    coils = np.array(
        [at_second(_vector(coil), (0.0, 0.0, 0.0)) for coil in np.array(parameters.torquer_vector).T]
    )
    return dataclasses.replace(
        parameters,
        vector_position=parameters.second_position,
        scale_constant=parameters.second_scale_constant,
        scale_log=parameters.second_scale_log,
        offset=parameters.second_offset,
        angles=parameters.second_angles,
        temperature_linear=parameters.second_temperature_linear,
        torquer_vector=_matrix(coils.T),
        panel_fields=_matrix(np.array([at_second(field, position) for field, position in panels])),
        battery_field=at_second(parameters.battery_field, parameters.battery_position),
        camera_field=at_second(parameters.camera_field, parameters.camera_position),
        heater_field=at_second(parameters.heater_field, parameters.heater_position),
    )


def in_second_axes(field: Float, parameters: Parameters) -> Float:
    """Return a field (time, 3) in spacecraft axes in the axes of the second fluxgate, nT."""
    turn = scipy.spatial.transform.Rotation.from_rotvec(parameters.second_rotation, degrees=True)
    return np.asarray(turn.inv().apply(field))


def _vector(values: Float) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _matrix(values: Float) -> Matrix:
    x, y, z = (_vector(row) for row in values)
    return x, y, z
