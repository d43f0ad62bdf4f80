"""Level-2: the calibrated field with its corrections apart, uncertainty and quality, one day at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.robust import BIWEIGHT_WIDTH, robust_sigma
from inflight.calibration.sensor import Reference, sensor_reading, usable
from inflight.effects.base import strength
from inflight.errors import ModelError, SamplesError
from inflight.estimators.distribution import Distribution
from inflight.estimators.distribution import distribute as distribute_residual
from inflight.flags import UNUSABLE, Flag, meanings
from inflight.geometry import latitude_longitude, rotate, to_nec
from inflight.model import Model
from inflight.time import to_utc

_VECTOR, _SCALAR = ("time", "axis"), ("time",)
_Variables = dict[str, tuple[tuple[str, ...], Floats, dict[str, object]]]


@dataclass(frozen=True)
class Parameters:
    """The nine parameters that hold for a day, and how sure they are; physical units."""

    value: Floats
    covariance: Floats
    all_determined: bool
    noise: float


def level2(
    model: Model,
    samples: xr.Dataset,
    parameters: Parameters,
    raw: Model,
    widening: Floats | None = None,
    distribute: bool | None = None,
) -> xr.Dataset:
    """Return the level-2 product of one day.

    Parameters
    ----------
    model : Model
        Bound to the calibration table that holds.
    samples : xarray.Dataset
        Aligned raw samples: `vector`, `scalar`, channels; `attitude` (time, quaternion) and
        `position` (time, axis) when they exist.
    parameters : Parameters
        For uncertainties and flags.
    raw : Model
        The pre-flight model, for the residual before calibration.
    widening : ndarray, shape (time, axis), optional
        What missing channels add to the variance, nT^2, sensor axes: see `inflight.substitution`.
    distribute : bool, optional
        The slow part of the residual, laid along the field (Yin 2010, eq. 3.7): True takes it out, False
        only tells it, None leaves it out. It hides what the model does not know; its size is in the product.

    Returns
    -------
    xarray.Dataset
        `field_sensor`, `field_spacecraft`, `field_nec` (time, axis) nT; `scalar` (time) nT;
        `residual`, `residual_preflight` (time) nT, |B_vector| - F; ``correction_<effect>`` nT, what
        was taken out (vector sensors: orthogonal axes of the sensor; scalar sensors: along the
        field); ``correction_distribution`` (time, axis) nT, sensor axes, when asked for, with
        attribute `applied`; `uncertainty` (time, axis) nT, 1 sigma, sensor axes, NaN where a missing
        channel makes it unknown; `flag` (time) uint32;
        `latitude`, `longitude` when the position is known.
    """
    found = model.corrected(samples)
    light = cast("xr.Dataset", found)
    field, scalar = (np.asarray(found[name].values) for name in ("field", "scalar"))
    residual = strength(light) - scalar
    reading = sensor_reading(model, samples)
    flag = _quality(samples, reading, field, scalar, residual, parameters)
    spread = _distribution(field, residual, samples, flag) if distribute is not None else None
    if spread is not None and distribute:
        field = field - spread.correction
    sensor = next(entry.sensor for entry in model.effects if entry.sensor.role == "vector")
    body = rotate(field, np.asarray(sensor.orientation))
    before, sigma = raw.residual(samples)[:, 0], _widened(_uncertainty(reading, parameters), widening)
    variables: _Variables = {
        "field_sensor": (_VECTOR, field, _told("calibrated field", "sensor")),
        "field_spacecraft": (_VECTOR, body, _told("calibrated field", "spacecraft")),
        "scalar": (_SCALAR, scalar, _told("calibrated field strength of the scalar sensor")),
        "residual": (_SCALAR, residual, _told("|B_vector| - F after calibration")),
        "residual_preflight": (_SCALAR, before, _told("|B_vector| - F with the pre-flight model")),
        "uncertainty": (_VECTOR, sigma, _told("one sigma", "sensor")),
    }
    variables |= _corrections(model, light, spread, distribute)
    flag = _geometry(variables, samples, body, flag)
    return _product(variables, flag, samples, model.comparison)


def _corrections(
    model: Model, corrected: xr.Dataset, spread: Distribution | None, distribute: bool | None
) -> _Variables:
    """Return what was taken out of the readings, effect by effect, and what distributes the residual."""
    out: _Variables = {}
    for name, term in model.correction_terms(corrected).items():
        told = _told(f"taken out of the reading: {name}", "sensor" if term.ndim == 2 else "")
        out[f"correction_{name}"] = (_VECTOR if term.ndim == 2 else _SCALAR, term, told)
    if spread is not None:
        told = _told("slow part of the residual along the field (Yin 2010, eq. 3.7)", "sensor")
        told |= {"applied": "yes" if distribute else "no", "period_s": spread.period, "rms_nT": spread.rms}
        out["correction_distribution"] = (_VECTOR, spread.correction, told)
    return out


def _product(
    variables: _Variables,
    flag: np.ndarray[tuple[int], np.dtype[np.uint32]],
    samples: xr.Dataset,
    comparison: str,
) -> xr.Dataset:
    masks, names = meanings()
    told = {"flag_masks": masks, "flag_meanings": names}
    stamps = (_SCALAR, samples["tt2000"].values, {"units": "ns", "scale": "TT2000"})
    return xr.Dataset(
        {**variables, "flag": (_SCALAR, flag, told), "tt2000": stamps},
        coords={"axis": ["x", "y", "z"]},
        attrs={"comparison": comparison},
    )


def _distribution(
    field: Floats, residual: Floats, samples: xr.Dataset, flag: np.ndarray[tuple[int], np.dtype[np.uint32]]
) -> Distribution | None:
    """Return what (3.7) would take out; None where samples are too slow for its filter."""
    good = (flag & np.uint32(UNUSABLE | Flag.OUTLIER)) == 0
    try:
        return distribute_residual(field, residual, np.asarray(samples["tt2000"].values), good)
    except SamplesError:
        return None


def _told(what: str, frame: str = "") -> dict[str, object]:
    told: dict[str, object] = {"units": "nT", "long_name": what}
    return told | {"frame": frame} if frame else told


def _quality(
    samples: xr.Dataset,
    reading: Floats,
    field: Floats,
    scalar: Floats,
    residual: Floats,
    known: Parameters,
) -> np.ndarray[tuple[int], np.dtype[np.uint32]]:
    flag = samples["flag"].values.astype(np.uint32)
    missing = np.uint32(Flag.VECTOR_MISSING | Flag.SCALAR_MISSING)
    lost = ~(np.isfinite(reading.sum(axis=1)) & np.isfinite(field.sum(axis=1)) & np.isfinite(scalar))
    flag[lost & (flag & missing == 0)] |= np.uint32(Flag.CHANNEL_MISSING)
    good = usable(samples, reading, field, scalar) & np.isfinite(residual)
    if good.any():
        # Half the weight of the biweight is lost at this many sigmas.
        half = BIWEIGHT_WIDTH * np.sqrt(1.0 - np.sqrt(0.5))
        centre = float(np.median(residual[good]))
        wide = half * robust_sigma(residual[good] - centre, floor=1e-6)
        flag[good & (np.abs(residual - centre) > wide)] |= np.uint32(Flag.OUTLIER)
    if not known.all_determined:
        flag |= np.uint32(Flag.PRIOR_PARAMETERS)
    return flag


def _uncertainty(reading: Floats, known: Parameters) -> Floats:
    """Propagate the parameters' covariance and the residual's noise; (time, axis) nT, sensor axes.

    B = K (E - E0): a row of K and the offsets enter each component.
    """
    cos = np.cos(np.deg2rad(known.value[3:6]))
    slope = -np.sin(np.deg2rad(known.value[3:6])) * np.pi / 180.0
    k = known.value[:3]
    e = reading - known.value[6:]
    one = np.ones(len(e))
    # (parameters of the row, their derivatives): x has scale, two angles and three offsets.
    rows = (
        (
            [0, 3, 4, 6, 7, 8],
            [e[:, 0], slope[0] * e[:, 1], slope[1] * e[:, 2], -k[0] * one, -cos[0] * one, -cos[1] * one],
        ),
        ([1, 5, 7, 8], [e[:, 1], slope[2] * e[:, 2], -k[1] * one, -cos[2] * one]),
        ([2, 8], [e[:, 2], -k[2] * one]),
    )
    out = np.empty_like(e)
    for axis, (index, parts) in enumerate(rows):
        derivative = np.stack(parts, axis=1)
        covariance = known.covariance[np.ix_(index, index)]
        out[:, axis] = np.einsum("ti,ij,tj->t", derivative, covariance, derivative, optimize=True)
    return np.sqrt(np.maximum(out, 0.0) + known.noise**2)


def _widened(sigma: Floats, variance: Floats | None) -> Floats:
    return sigma if variance is None else np.sqrt(sigma**2 + variance)


def _geometry(
    variables: _Variables,
    samples: xr.Dataset,
    body: Floats,
    flag: np.ndarray[tuple[int], np.dtype[np.uint32]],
) -> np.ndarray[tuple[int], np.dtype[np.uint32]]:
    """Add NEC axes, latitude and longitude as far as attitude and position are there."""
    position = None
    if "position" in samples:
        position = np.asarray(samples["position"].values, dtype=np.float64)
        latitude, longitude = latitude_longitude(position)
        variables["latitude"] = (_SCALAR, latitude, {"units": "deg", "long_name": "geocentric latitude"})
        variables["longitude"] = (_SCALAR, longitude, {"units": "deg", "long_name": "longitude"})
    if "attitude" not in samples:
        return flag | np.uint32(Flag.NO_ATTITUDE)
    attitude = np.asarray(samples["attitude"].values, dtype=np.float64)
    frame = str(samples["attitude"].attrs.get("frame", ""))
    nec = to_nec(body, attitude, position, frame)
    variables["field_nec"] = (_VECTOR, nec, _told("calibrated field", "nec"))
    lost = np.uint32(Flag.NO_ATTITUDE) * ~np.isfinite(nec.sum(axis=1))
    return np.asarray(flag | lost.astype(np.uint32), dtype=np.uint32)


def day_parameters(table: xr.Dataset, tt2000: int, reference: Reference) -> Parameters:
    """Return what a calibration table says of an instant.

    Raises
    ------
    ModelError
        When no interval of the table holds the instant.
    """
    inside = (table["start"].values <= tt2000) & (tt2000 < table["end"].values)
    if not inside.any():
        raise ModelError(
            f"the calibration table holds nothing at {to_utc(tt2000)}",
            remedy="reprocess the span with its table",
        )
    row = table.isel(interval=int(np.flatnonzero(inside)[-1])).sel(
        parameter=reference.columns, other=reference.columns
    )
    free = reference.sigma > 0
    return Parameters(
        np.asarray(row["value"].values, dtype=np.float64),
        np.asarray(row["covariance"].values, dtype=np.float64),
        bool(np.all(row["determined"].values[free])),
        _noise(table, row),
    )


def _noise(table: xr.Dataset, row: xr.Dataset) -> float:
    """Return the noise that holds; the median of the others' where an interval's own data tell none."""
    after = table["after"].values
    own, known = float(row["after"]), after[np.isfinite(after)]
    return own if np.isfinite(own) or not known.size else float(np.median(known))
