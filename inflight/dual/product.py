"""The level-2 product of two sensors: both readings, the correction apart, the field and its uncertainty.

Takes a model with aligned samples and a correction; makes the readings in spacecraft axes, and the product as
a Dataset. Its variables are listed at `dual_level2`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.dual.correction import Correction
from inflight.dual.gradiometer import GRADIOMETER_SETTINGS
from inflight.dual.mixing import difference_noise
from inflight.dual.readings import Readings, cells_of, white_covariance
from inflight.errors import SamplesError
from inflight.flags import UNUSABLE, Flag, flag_meanings
from inflight.model import Model, at_all_sensors

_VECTOR, _SCALAR = ("time", "axis"), ("time",)


def readings_of(model: Model, samples: xr.Dataset) -> tuple[Readings, npt.NDArray[np.uint32]]:
    """Return the readings of a dual comparison in spacecraft axes, and the flags of the samples.

    Parameters
    ----------
    model : Model
        Its effects are taken out of the readings first, all but fields added at the inboard sensor: a fit of
        the difference puts what a source adds to it there. Taken out, the difference would no longer show
        the source, and what it adds at the outboard sensor could not be estimated.
    samples : Dataset
        Aligned raw samples with `inboard`, `outboard` (time, axis), `flag` and `tt2000`.

    Returns
    -------
    Readings
        NaN where the flags make a sample unusable.
    ndarray of uint32, shape (time,)

    Raises
    ------
    SamplesError
        When no sample has both readings.
    """
    layout = model.known_layout
    kept = tuple(
        entry
        for entry in model.effects
        if not (entry.is_additive and any(one.sensor.role == "inboard" for one in at_all_sensors([entry])))
    )
    corrected = cast("xr.Dataset", replace(model, effects=kept, layout=layout).corrected(samples))
    flag = np.asarray(samples["flag"].values, dtype=np.uint32)
    bad = (flag & np.uint32(UNUSABLE)) != 0
    fields = []
    for role in ("inboard", "outboard"):
        in_spacecraft = layout.sensor(role).rotation.apply(
            np.asarray(corrected[role].values, dtype=np.float64)
        )
        fields.append(np.where(bad[:, None], np.nan, in_spacecraft))
    readings = Readings(np.asarray(samples["tt2000"].values, dtype=np.int64), fields[0], fields[1])
    if not readings.good.any():
        raise SamplesError(
            "no sample has readings of both sensors", remedy="look at the flags of both instruments' days"
        )
    return readings, flag


def outboard_noise(readings: Readings) -> Floats:
    """Return the variance of the outboard sensor's white noise; (axis,), nT^2.

    The ambient field changes from sample to sample, too, but is in both sensors: the noise is the outboard
    sensor's share of that of the difference, a half where the two cannot be told apart. It is at most what is
    white in the outboard reading.
    """
    outboard, difference = readings.outboard[readings.good], readings.difference[readings.good]
    shortest = cells_of(outboard, difference, longest=len(outboard))
    noise = difference_noise(shortest, readings.noise, GRADIOMETER_SETTINGS.leak_sigma)
    return np.minimum(noise.share * np.diag(noise.covariance), np.diag(white_covariance(outboard)))


def dual_level2(
    readings: Readings, correction: Correction, flag: npt.NDArray[np.uint32], comparison: str
) -> xr.Dataset:
    """Return the level-2 product of a span.

    Parameters
    ----------
    readings : Readings
        Spacecraft axes.
    correction : Correction
        For the same samples; it is in the product whether it is applied or not.
    flag : ndarray of uint32, shape (time,)
        Of the samples.

    Returns
    -------
    xarray.Dataset
        `inboard`, `outboard`, `correction`, `field_spacecraft` (time, axis) nT, spacecraft axes, with
        ``field = outboard - correction`` where attribute `applied` is ``yes`` and the correction is known;
        `uncertainty` (time, axis) nT, 1 sigma of the part of `field_spacecraft` that changes: white noise of
        the outboard sensor (`outboard_noise`) and the correction's error, NaN where the stray field is not
        known;
        `state`, `probability`, `flag`, `tt2000` (time). Attributes `method`, `applied`, `reason` and
        `constant_known`: two sensors alone do not show the stray field that never changes.
    """
    field = correction.corrected(readings.outboard)
    good = np.isfinite(readings.outboard).all(axis=1)
    noise = outboard_noise(readings)
    sigma = np.sqrt(noise + correction.sigma**2)
    if not correction.applied:
        sigma = np.full(field.shape, np.nan)
    bits = flag | correction.flag
    bits = np.where(correction.known | ~good, bits, bits | np.uint32(Flag.UNKNOWN_STATE)).astype(np.uint32)
    masks, names = flag_meanings()
    axes = "spacecraft"
    variables = {
        "inboard": (
            _VECTOR,
            readings.inboard,
            _vector_attrs("calibrated reading of the inboard sensor", axes),
        ),
        "outboard": (
            _VECTOR,
            readings.outboard,
            _vector_attrs("calibrated reading of the outboard sensor", axes),
        ),
        "correction": (
            _VECTOR,
            correction.field,
            _vector_attrs("stray field at the outboard sensor", axes) | {"applied": _yes(correction.applied)},
        ),
        "field_spacecraft": (
            _VECTOR,
            field,
            _vector_attrs("field of the outboard sensor less the correction", axes),
        ),
        "uncertainty": (_VECTOR, sigma, _vector_attrs("one sigma of the part that changes", axes)),
        "state": (_SCALAR, correction.state.astype(np.int32), {"unknown": -1, "transient": -2}),
        "probability": (_SCALAR, correction.probability, {"units": "1"}),
        "flag": (_SCALAR, bits, {"flag_masks": masks, "flag_meanings": names}),
        "tt2000": (_SCALAR, readings.stamps, {"units": "ns", "scale": "TT2000"}),
    }
    return xr.Dataset(
        variables,
        coords={"axis": ["x", "y", "z"]},
        attrs={
            "comparison": comparison,
            "method": correction.method,
            "applied": _yes(correction.applied),
            "reason": correction.reason,
            "constant_known": _yes(correction.constant_known and correction.applied),
        },
    )


def _vector_attrs(long_name: str, frame: str) -> dict[str, object]:
    return {"units": "nT", "long_name": long_name, "frame": frame}


def _yes(value: bool) -> str:
    return "yes" if value else "no"
