"""The level-2 product of a spinning sensor: the field in turning, payload, GSE and GSM axes.

Takes: samples that the model has corrected, the readings of the sensor's own equation, the twelve parameters
with their covariance, and the attitude. Makes (`field_uncertainty`) the error of each component by those of
all twelve, and (`make_spin_product`) the product with it, what each effect took out, and quality flags.
Despinning is eq. (1) of Farrell et al. (1995); the uncertainty is that of the parameters of eq. (9) of
Plaschke et al. (2019), to first order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.flags import UNUSABLE, Flag, flag_meanings
from inflight.frames import gse_to_gsm, payload_to_gse
from inflight.model import Model
from inflight.spin.equation import PARAMETER_NAMES, CalibrationParameters
from inflight.spin.fits import despin

_VECTOR, _SCALAR = ("time", "axis"), ("time",)

#: Step of the derivative of the field by each of the twelve: gains, angles in rad, offsets in nT.
_STEPS = {name: 1.0 if name.startswith("offset") else 1e-6 for name in PARAMETER_NAMES}


@dataclass(frozen=True)
class Attitude:
    """Where spin axis and Sun stand at samples; unit vectors, gse.

    Attributes
    ----------
    axis : ndarray, shape (time, 3)
        Of the rotation, right-handed; NaN where it is not known.
    sunward : ndarray, shape (time, 3)
        To the Sun as the spacecraft sees it.
    """

    axis: Floats
    sunward: Floats


def make_spin_product(
    model: Model,
    corrected: xr.Dataset,
    uncertainty: Floats,
    attitude: Attitude | None = None,
) -> xr.Dataset:
    """Return the level-2 product of one day of a turning sensor.

    Parameters
    ----------
    model : Model
        Bound to the calibration table that holds.
    corrected : xarray.Dataset
        Samples as measured, not folded, with `spin_phase`, that the model has corrected.
    uncertainty : ndarray, shape (time, axis)
        nT, as `field_uncertainty` gives it.
    attitude : Attitude, optional
        Without one there are no `field_gse` and `field_gsm`.

    Returns
    -------
    xarray.Dataset
        `field_sensor` (time, axis) nT in axes that turn with the spacecraft, z along the spin axis;
        `field_payload` despun; `spin_phase` (time) rad; ``correction_<effect>`` nT;
        `before_stray_field` like `field_payload`, with these terms still in; `uncertainty`
        (time, axis) nT, one sigma of the parameters, turning axes; `flag` (time) uint32. Without a phase
        `field_payload` is NaN and the flag is set. With an attitude `field_gse`, `field_gsm` (time, axis)
        nT; samples without one carry ``NO_ATTITUDE``.
    """
    flipped = np.asarray(corrected["flag"].values & np.uint32(Flag.FLIPPED)) > 0
    field = np.where(flipped[:, None], np.nan, np.asarray(corrected["field"].values))
    phase = np.asarray(corrected["spin_phase"].values, dtype=np.float64)
    flag = corrected["flag"].values.astype(np.uint32)
    flag[~np.isfinite(phase)] |= np.uint32(Flag.NO_PHASE)
    lost = ~np.isfinite(field).all(axis=1)
    flag[lost & (flag & np.uint32(UNUSABLE) == 0)] |= np.uint32(Flag.CHANNEL_MISSING)
    attributes = {"units": "nT", "long_name": "calibrated field"}
    variables: dict[str, tuple[tuple[str, ...], Floats, dict[str, object]]] = {
        "field_sensor": (_VECTOR, field, {**attributes, "frame": "spin-aligned, turning"}),
        "field_payload": (_VECTOR, despin(field, phase), {**attributes, "frame": "payload"}),
        "spin_phase": (
            _SCALAR,
            np.mod(phase, 2.0 * np.pi),
            {"units": "rad", "long_name": "phase of the spin"},
        ),
        "uncertainty": (
            _VECTOR,
            uncertainty,
            {"units": "nT", "long_name": "one sigma of the calibration", "frame": "spin-aligned, turning"},
        ),
    }
    flag_without_attitude = np.uint32(Flag.NO_ATTITUDE)
    if attitude is None:
        flag |= flag_without_attitude
    else:
        gse = payload_to_gse(variables["field_payload"][1], attitude.axis, attitude.sunward)
        gsm = gse_to_gsm(gse, np.asarray(corrected["tt2000"].values, dtype=np.int64))
        variables["field_gse"] = (_VECTOR, gse, {**attributes, "frame": "gse"})
        variables["field_gsm"] = (_VECTOR, gsm, {**attributes, "frame": "gsm"})
        known = np.isfinite(payload_to_gse(np.ones_like(gse), attitude.axis, attitude.sunward)).all(axis=1)
        flag[~known] |= flag_without_attitude
    terms = model.correction_terms(corrected)
    before = model.before_corrections(corrected, terms)
    if before is not None:
        before = np.where(flipped[:, None], np.nan, before)
        kind = {"units": "nT", "long_name": "calibrated field, nothing of the spacecraft's taken out"}
        variables["before_stray_field"] = (_VECTOR, despin(before, phase), {**kind, "frame": "payload"})
    for name, term in terms.items():
        kind = {"units": "nT", "long_name": f"taken out of the reading: {name}"}
        variables[f"correction_{name}"] = (_VECTOR if term.ndim == 2 else _SCALAR, term, dict(kind))
    masks, names = flag_meanings()
    out = xr.Dataset(variables, coords={"axis": ["x", "y", "z"]}, attrs={"comparison": model.comparison})
    out["flag"] = (_SCALAR, flag, {"flag_masks": masks, "flag_meanings": names})
    out["tt2000"] = (_SCALAR, corrected["tt2000"].values, {"units": "ns", "scale": "TT2000"})
    return out


def field_uncertainty(readings: Floats, parameters: CalibrationParameters, covariance: Floats) -> Floats:
    """Return the standard deviation of each component by the parameters' errors; (time, 3) nT.

    The field is linear in the readings, so the derivative by each parameter is one matrix and one shift.
    """
    rows = []
    for name, step in _STEPS.items():
        up, down = (
            parameters.changed({name: float(parameters.values()[PARAMETER_NAMES.index(name)] + sign * step)})
            for sign in (1.0, -1.0)
        )
        matrix = (up.matrix() - down.matrix()) / (2.0 * step)
        shift = (up.matrix() @ up.offset - down.matrix() @ down.offset) / (2.0 * step)
        rows.append(np.column_stack([matrix, -shift]))
    derivative = np.stack(rows)
    # Of each component a quadratic form of (reading, 1): four numbers squared, whatever the parameters.
    forms = np.einsum("pai,pq,qaj->aij", derivative, covariance, derivative)
    known = np.column_stack([readings, np.ones(len(readings))])
    variance = np.stack(
        [np.einsum("ti,ij,tj->t", known, form, known, optimize=True) for form in forms], axis=1
    )
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
