"""How a boom bends between two spinning magnetometers, from their products (Farrell et al. 1995, VI)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.flags import UNUSABLE, Flag
from inflight.spin import fit_spins, measure_boom_bending
from inflight.time import Int64, day_bounds


def bending_day(products: Sequence[xr.Dataset], day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return by how much the outboard sensor is turned about the spin axis from the inboard one.

    Both are fitted turn by turn against the phase of the inboard one's product, at the samples they share.

    Parameters
    ----------
    products : sequence of Dataset
        Of the inboard sensor and of the outboard one.

    Returns
    -------
    xarray.Dataset
        `bend`, `sigma` (block) rad, positive from x to y; `fits` (block); `start`, `end` TT2000.

    Raises
    ------
    CalibrationError
        When fewer than ten turns have both.
    """
    bad = np.uint32(UNUSABLE | Flag.NO_PHASE | Flag.PHASE_JUMP)
    used = [one.isel(time=(one["flag"].values & bad) == 0) for one in products]
    inboard, outboard = xr.align(*used, join="inner")
    stamps = np.asarray(inboard["tt2000"].values, dtype=np.int64)
    phase = unwrapped(np.asarray(inboard["spin_phase"].values, dtype=np.float64), stamps)
    inner, outer = (
        fit_spins(stamps, np.asarray(one["field_sensor"].values, dtype=np.float64), phase)
        for one in (inboard, outboard)
    )
    found = measure_boom_bending(outer, inner)
    start, end = day_bounds(day)
    dataset = xr.Dataset(
        {
            "bend": ("block", found.value, {"units": "rad"}),
            "sigma": ("block", found.sigma, {"units": "rad"}),
            "fits": ("block", found.fits),
            "start": ("block", np.array([start], dtype=np.int64), {"scale": "TT2000"}),
            "end": ("block", np.array([end], dtype=np.int64), {"scale": "TT2000"}),
        }
    )
    return dataset, {"samples": int(stamps.size), "bend_rad": float(found.value[0])}


def unwrapped(phase: Floats, stamps: Int64) -> Floats:
    """Return a phase between 0 and two pi as one that runs on, counted across gaps at its usual rate; rad."""
    if phase.size < 2:
        return phase
    seconds = np.diff(stamps) / 1e9
    turned = np.diff(np.unwrap(phase))
    expected = float(np.median(turned / seconds)) * seconds
    step = expected + np.mod(turned - expected + np.pi, 2.0 * np.pi) - np.pi
    return np.asarray(phase[0] + np.concatenate([[0.0], np.cumsum(step)]))


def bending_table(read: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the bend over days; dims interval, parameter (one): `value`, `sigma` rad, `fits`, and the span.

    The azimuths as mounted are those of the two pre-flight models: the bend is what is beyond them.
    """
    each = ("interval", "parameter")
    both = {name: np.concatenate([day[name].values for day in read]) for name in ("bend", "sigma", "fits")}
    return xr.Dataset(
        {
            "value": (each, both["bend"][:, None]),
            "sigma": (each, both["sigma"][:, None]),
            "fits": ("interval", both["fits"]),
            "units": ("parameter", np.array(["rad"], dtype="U8")),
            "start": ("interval", np.concatenate([day["start"].values for day in read])),
            "end": ("interval", np.concatenate([day["end"].values for day in read])),
        },
        coords={"parameter": ["bend"]},
    )
