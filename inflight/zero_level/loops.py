"""Compiled loops over the readings of intervals: their likelihood under offsets, and sums over neighbours.

An offset is tried a hundred times along each axis, and stepped to dozens of times from each start: every
pass over the readings counts.
"""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.compiled import compiled
from inflight.zero_level.intervals import Bools


@compiled
def likelihoods(field: Floats, offsets: Floats, least_variance: float) -> Floats:  # pragma: no cover
    """Return the mean of a sample's log-likelihood in each interval under each offset; (offset, interval).

    Up to a constant; see `combination.log_likelihood`.

    Parameters
    ----------
    field : ndarray, shape (interval, sample, 3)
        nT; NaN where missing.
    offsets : ndarray, shape (offset, 3)
        nT.
    least_variance : float
        Least variances, of the variance of all components.
    """
    intervals, samples = field.shape[0], field.shape[1]
    out = np.empty((offsets.shape[0], intervals))
    size = np.empty(samples)
    for o in range(offsets.shape[0]):
        for k in range(intervals):
            count, volume, middle = 0, 0.0, 0.0
            mx, my, mz = 0.0, 0.0, 0.0
            xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for s in range(samples):
                if not np.isfinite(field[k, s, 0]):
                    continue
                x = field[k, s, 0] - offsets[o, 0]
                y = field[k, s, 1] - offsets[o, 1]
                z = field[k, s, 2] - offsets[o, 2]
                b = max(np.sqrt(x * x + y * y + z * z), 1e-9)
                size[count] = b
                count += 1
                middle += b
                volume += np.log(b)
                x, y, z = x / b, y / b, z / b
                mx, my, mz = mx + x, my + y, mz + z
                xx, xy, xz = xx + x * x, xy + x * y, xz + x * z
                yy, yz, zz = yy + y * y, yz + y * z, zz + z * z
            middle, volume = middle / count, 2.0 * volume / count
            squeezed = 0.0
            for s in range(count):
                squeezed += (size[s] - middle) ** 2
            squeezed /= count
            # Two directions across the mean direction; the mean has no part in them.
            length = max(np.sqrt(mx * mx + my * my + mz * mz), 1e-300)
            mx, my, mz = mx / length, my / length, mz / length
            if abs(mx) < 0.6:
                ux, uy, uz = 0.0, mz, -my
            else:
                ux, uy, uz = -mz, 0.0, mx
            length = max(np.sqrt(ux * ux + uy * uy + uz * uz), 1e-300)
            ux, uy, uz = ux / length, uy / length, uz / length
            vx, vy, vz = my * uz - mz * uy, mz * ux - mx * uz, mx * uy - my * ux
            # Their second moments: how the direction turns.
            px, py, pz = xx * ux + xy * uy + xz * uz, xy * ux + yy * uy + yz * uz, xz * ux + yz * uy + zz * uz
            qx, qy, qz = xx * vx + xy * vy + xz * vz, xy * vx + yy * vy + yz * vz, xz * vx + yz * vy + zz * vz
            a, c = (ux * px + uy * py + uz * pz) / count, (vx * qx + vy * qy + vz * qz) / count
            mixed = (vx * px + vy * py + vz * pz) / count
            half, apart = 0.5 * (a + c), np.hypot(0.5 * (a - c), mixed)
            least = least_variance * max(squeezed + middle**2 * (a + c), 1e-300)
            floor = least / middle**2
            plane = np.log(max(half + apart, floor)) + np.log(max(half - apart, floor))
            out[o, k] = -0.5 * (np.log(max(squeezed, least)) + plane) - volume
    return out


@compiled
def neighbour_sums(
    field: Floats, neighbours: Bools, offset: Floats
) -> tuple[Floats, Floats, Floats, Floats]:  # pragma: no cover
    """Return sums over the pairs of neighbours in each interval, of readings less an offset.

    With the change dB of the size and dn of the direction, and B the geometric mean of both sizes.

    Parameters
    ----------
    field : ndarray, shape (interval, sample, 3)
        nT; NaN where missing.
    neighbours : ndarray of bool, shape (interval, sample - 1)
        Pairs without a gap.
    offset : ndarray, shape (interval, 3)
        nT.

    Returns
    -------
    both : ndarray, shape (interval, 3)
        ``sum dB dn``, nT.
    rotation : ndarray, shape (interval, 3, 3)
        ``sum dn dn^T``.
    squeezed : ndarray, shape (interval,)
        ``sum dB^2 / B^2``.
    along : ndarray, shape (interval, 3, 3)
        ``sum n n^T dB^2 / B^2``, n the direction of the pair's mean.
    """
    intervals, samples = field.shape[0], field.shape[1]
    both, rotation = np.zeros((intervals, 3)), np.zeros((intervals, 3, 3))
    squeezed, along = np.zeros(intervals), np.zeros((intervals, 3, 3))
    turn, unit = np.zeros(3), np.zeros(3)
    for k in range(intervals):
        before, x0, y0, z0 = 0.0, 0.0, 0.0, 0.0
        for s in range(samples):
            x, y, z = (
                field[k, s, 0] - offset[k, 0],
                field[k, s, 1] - offset[k, 1],
                field[k, s, 2] - offset[k, 2],
            )
            size = np.sqrt(x * x + y * y + z * z)
            if s > 0 and neighbours[k, s - 1] and before > 0.0 and size > 0.0:
                change = size - before
                turn[0], turn[1], turn[2] = (
                    x / size - x0 / before,
                    y / size - y0 / before,
                    z / size - z0 / before,
                )
                unit[0], unit[1], unit[2] = 0.5 * (x + x0), 0.5 * (y + y0), 0.5 * (z + z0)
                part = change * change / (size * before)
                squeezed[k] += part
                part /= max(unit[0] ** 2 + unit[1] ** 2 + unit[2] ** 2, 1e-300)
                for i in range(3):
                    both[k, i] += change * turn[i]
                    for j in range(3):
                        rotation[k, i, j] += turn[i] * turn[j]
                        along[k, i, j] += part * unit[i] * unit[j]
            before, x0, y0, z0 = size, x, y, z
    return both, rotation, squeezed, along
