"""Truth for estimators, written apart from them: daily tables, orbits in a dipole, noise with memory."""

import numpy as np
import xarray as xr

from inflight.calibration import NormalEquations, ParameterPrior, fit_block
from inflight.time import from_mjd2000

NINE = [f"vector_sensor.scale_factor[{axis}]" for axis in "xyz"]
NINE += [f"vector_sensor.misalignment[{pair}]" for pair in ("xy", "xz", "yz")]
NINE += [f"vector_sensor.offset[{axis}]" for axis in "xyz"]
SCALES = NINE[:3]
#: CHAMP's published law (Yin 2010, section 3.3).
LA, LB = np.array([1.00025304, 1.00111601, 1.00102659]), np.array([2.8960e-4, 2.9990e-4, 2.9850e-4])
REST = np.array([90.02613, 90.05986, 90.03873, 26.970, 19.843, 21.625])
PRIOR_SIGMA = np.array([0.005] * 3 + [0.5] * 3 + [100.0] * 3)


def wandering(count, memory, generator):
    """Unit-variance series whose correlation falls to 1/e after `memory` steps."""
    keep = np.exp(-1.0 / memory)
    out = np.empty(count)
    out[0] = generator.normal()
    for index in range(1, count):
        out[index] = keep * out[index - 1] + np.sqrt(1 - keep**2) * generator.normal()
    return out


def nine_at(mjd, growth=LB, origin=150.0):
    """The nine parameters at a day."""
    return np.concatenate([LA + growth * np.log(mjd - origin), REST])


def table_of(mjd, value, sigma, names, width=1.0):
    """A table of intervals that begin at `mjd`; value (interval, parameter)."""
    sigmas = np.broadcast_to(sigma, value.shape)
    return xr.Dataset(
        {
            "value": (("interval", "parameter"), value),
            "sigma": (("interval", "parameter"), sigmas),
            "start": ("interval", from_mjd2000(mjd)),
            "end": ("interval", from_mjd2000(mjd + width)),
        },
        coords={"parameter": list(names)},
    )


def polar_field(count=720, day=0):
    """Field in axes along flight, across, down of a polar orbit in a dipole that turns with the Earth; nT."""
    t = day * 86_400.0 + np.arange(count) * 86_400.0 / count
    u, incline, spin, tilt = (
        2 * np.pi * t / 5580.0,
        np.deg2rad(87.3),
        2 * np.pi * t / 86_164.0,
        np.deg2rad(10),
    )
    up = np.stack([np.cos(u), np.sin(u) * np.cos(incline), np.sin(u) * np.sin(incline)], axis=1)
    along = np.stack([-np.sin(u), np.cos(u) * np.cos(incline), np.cos(u) * np.sin(incline)], axis=1)
    pole = np.stack([np.sin(tilt) * np.cos(spin), np.sin(tilt) * np.sin(spin), np.cos(tilt) + 0 * t], axis=1)
    field = -24_000.0 * (3 * np.sum(pole * up, axis=1, keepdims=True) * up - pole)
    across = np.cross(-up, along)
    return np.stack([np.sum(field * axis, axis=1) for axis in (along, across, -up)], axis=1)


def matrix_of(nine):
    xy, xz, yz = np.cos(np.deg2rad(nine[3:6]))
    return np.array([[nine[0], xy, xz], [0, nine[1], yz], [0, 0, nine[2]]])


def day_equations(mjd, nine, generator, noise=0.1, shift=0.0):
    """One day's equations as a reprocessing leaves them; `shift` moves the scalar in time, s."""
    field = polar_field(day=mjd)
    strength = np.linalg.norm(field, axis=1)
    reading = np.linalg.solve(matrix_of(nine), field.T).T + nine[6:]
    scalar = strength + noise * generator.normal(size=strength.size) + shift * np.gradient(strength, 120.0)
    reference = ParameterPrior(nine_at(1000.0), PRIOR_SIGMA)
    good = np.ones(strength.size, dtype=bool)
    fit = fit_block(reading, np.zeros((1, 3)), scalar, good, reference, sub_blocks=24)
    span = tuple(int(edge) for edge in from_mjd2000(np.array([mjd, mjd + 1.0])))
    attributes = {"comparison": "main", "model": "m", "filter": "raw"}
    return NormalEquations.from_fit(fit, reference, span, attributes)


def joined(parts):
    rows = xr.concat([part.dataset.drop_vars("scale") for part in parts], "block", join="exact")
    return NormalEquations(rows.assign(scale=parts[0].dataset["scale"]))
