"""Fields of the spacecraft at both sensors: torquers by their laboratory matrices, all else as dipoles."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from inflight.simulate.dipole import extrapolate_dipole
from inflight.simulate.grid import Float
from inflight.simulate.parameters import Parameters, Vector
from inflight.simulate.power import Currents
from inflight.simulate.torquers import mean_current

#: Field per ampere at the vector sensor and at the scalar sensor, nT/A.
Pair = tuple[Float, Float]


def coefficients(parameters: Parameters) -> dict[str, Pair]:
    """Return what each current source makes at the two sensors.

    The numbers of `parameters` hold at the vector sensor; a dipole at the source's position gives
    the scalar sensor's (Yin 2010, after eq. 3.1, without its assumption of the boom axis).

    Returns
    -------
    dict
        ``panel_left``, ``panel_right``, ``panel_top``, ``battery``, ``camera``, ``heater`` ->
        (vector sensor, scalar sensor), each of shape (3,), nT/A, spacecraft axes.
    """
    sources: dict[str, tuple[Vector, Vector]] = {
        "battery": (parameters.battery_field, parameters.battery_position),
        "camera": (parameters.camera_field, parameters.camera_position),
        "heater": (parameters.heater_field, parameters.heater_position),
    }
    for name, field, position in zip(
        ("left", "right", "top"), parameters.panel_fields, parameters.panel_positions, strict=True
    ):
        sources[f"panel_{name}"] = (field, position)
    vector, scalar = parameters.vector_position, parameters.scalar_position
    return {
        name: (np.array(field), extrapolate_dipole(field, position, vector, scalar))
        for name, (field, position) in sources.items()
    }


def remanent_fields(seconds: Float, parameters: Parameters) -> Pair:
    """Return the remanent field at vector and scalar sensor, each (time, 3), nT.

    ``eta (0, mean I_y, mean I_z)`` at the scalar sensor (Yin 2010, 3.4.4): the body's moment is
    what the mean torquer current compensates, so both drift together.
    """
    at_scalar = parameters.remanent_per_current * mean_current(seconds, parameters) * [0.0, 1.0, 1.0]
    basis = [
        extrapolate_dipole(
            axis, parameters.remanent_position, parameters.scalar_position, parameters.vector_position
        )
        for axis in np.eye(3)
    ]
    return at_scalar @ np.array(basis), at_scalar


def stray_fields(
    seconds: Float, flow: Currents, torquer: Float, parameters: Parameters, effects: Collection[str]
) -> Pair:
    """Return the field of the spacecraft at vector and scalar sensor.

    Parameters
    ----------
    seconds : ndarray, shape (time,)
        TT2000, s.
    flow : Currents
        Currents of the power system at these times, A.
    torquer : ndarray, shape (time, 3)
        Torquer currents, A.
    parameters, effects : Parameters, collection of str
        The spacecraft, and which effects act.

    Returns
    -------
    (ndarray, ndarray), each of shape (time, 3)
        nT, spacecraft axes.
    """
    per_ampere = coefficients(parameters)
    used: list[tuple[Float, Pair]] = []
    if "solar_array" in effects:
        panels = (per_ampere[f"panel_{name}"] for name in ("left", "right", "top"))
        used += [(flow.panels[:, index], pair) for index, pair in enumerate(panels)]
    for effect, current, source in (
        ("battery", flow.battery, "battery"),
        ("star_camera", flow.camera, "camera"),
        ("heater", flow.heater, "heater"),
    ):
        if effect in effects:
            used.append((current, per_ampere[source]))
    fields = np.zeros((seconds.size, 6))
    if used:
        fields += np.column_stack([current for current, _ in used]) @ np.array(
            [np.concatenate(pair) for _, pair in used]
        )
    if "torquer" in effects:
        fields += torquer @ np.vstack([parameters.torquer_vector, parameters.torquer_scalar]).T
    if "remanent" in effects:
        fields += np.hstack(remanent_fields(seconds, parameters))
    return fields[:, :3], fields[:, 3:]
