"""Calibration tables: how much and when, with covariance and what is behind each number.

Takes the solutions of intervals; makes the table's Dataset, and the step that the calibrated field makes
where one interval ends and the next begins.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from inflight.arrays import Floats
from inflight.calibration.extrapolation import with_learnt_spans
from inflight.calibration.scalar import PARAMETER_GROUPS, PARAMETER_UNITS, ParameterPrior
from inflight.errors import CalibrationError
from inflight.lsq import Solution
from inflight.time import Int64

if TYPE_CHECKING:
    import xarray as xr

#: Where a value comes from: codes of the variable `source`.
VALUE_ORIGINS = ("prior", "combination", "data")


@dataclass(frozen=True)
class Interval:
    """One row of a table: a half-open TT2000 span, its solution and what it was made from.

    `learnt` is the part of the span that has data, half-open TT2000; empty where nothing has. `held` is by
    how much one sigma of each number that the model holds moves the parameters (number, parameter).
    """

    start: int
    end: int
    learnt: tuple[int, int]
    value: Floats
    covariance: Floats
    solution: Solution
    count: float
    before: float
    after: float
    blocks: int = 1
    held: Floats = field(default_factory=lambda: np.zeros((0, 0)))


def calibration_table(
    rows: Sequence[Interval], reference: ParameterPrior, attributes: dict[str, str]
) -> xr.Dataset:
    """Return the table of several intervals.

    Returns
    -------
    xarray.Dataset
        dims interval, parameter, other: `value`, `sigma`, `covariance`, `prior`, `prior_sigma` in
        the units of `units` (parameter); where numbers of the model have errors, too, `conditional_sigma` and
        `conditional_covariance` for given values of these; `determined` (bool), `retained`, `source` (codes
        of `VALUE_ORIGINS`): *prior* never moved, *combination* moved only as part of a combination that the
        data determine, *data* determined by itself; `start`, `end` TT2000; `count`, `before`,
        `after` (nT rms), `directions` (number of combinations determined), `inflation`; `learnt_start`,
        `learnt_end`: see `inflight.calibration.extrapolation`.
    """
    import xarray as xr

    names = reference.columns
    of_rows, each = ("interval",), ("interval", "parameter")
    conditional = np.array([row.covariance for row in rows])
    covariance = np.array(
        [row.covariance + row.held.T @ row.held if row.held.size else row.covariance for row in rows]
    )
    determined, moved = (
        np.array([getattr(row.solution, name) for row in rows]) for name in ("determined", "moved")
    )
    scalars = {
        "count": [row.count for row in rows],
        "before": [row.before for row in rows],
        "after": [row.after for row in rows],
        "inflation": [row.solution.inflation for row in rows],
    }
    table = xr.Dataset(
        {
            "value": (each, np.array([row.value for row in rows])),
            "sigma": (each, np.sqrt(np.einsum("ijj->ij", covariance))),
            "covariance": ((*each, "other"), covariance),
            "determined": (each, determined),
            "retained": (each, np.array([row.solution.retained for row in rows])),
            "source": (
                each,
                np.where(determined, 2, np.where(moved, 1, 0)).astype(np.int8),
                {"flag_meanings": " ".join(VALUE_ORIGINS)},
            ),
            "prior": ("parameter", reference.value),
            "prior_sigma": ("parameter", reference.sigma),
            "units": ("parameter", np.array(PARAMETER_UNITS, dtype="U8")),
            "start": (of_rows, np.array([row.start for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "end": (of_rows, np.array([row.end for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "blocks": (of_rows, np.array([row.blocks for row in rows], dtype=np.int64)),
            "directions": (of_rows, np.array([len(row.solution.directions) for row in rows], dtype=np.int64)),
        }
        | {name: (of_rows, np.array(values, dtype=np.float64)) for name, values in scalars.items()},
        coords={"parameter": names, "other": names},
        attrs=attributes,
    )
    if any(row.held.size for row in rows):
        table = table.assign(
            conditional_sigma=(each, np.sqrt(np.einsum("ijj->ij", conditional))),
            conditional_covariance=((*each, "other"), conditional),
        )
    learnt = np.array([row.learnt for row in rows], dtype=np.int64)
    return with_learnt_spans(table, learnt[:, 0], learnt[:, 1])


def rows_within(table: xr.Dataset, start: int, end: int) -> xr.Dataset:
    """Return the intervals of a table that reach into a half-open TT2000 span.

    Their noise, `after`, is that of `noise_of_rows` of the whole table.
    """
    inside = np.flatnonzero((table["start"].values < end) & (start < table["end"].values))
    after = ("interval", noise_of_rows(table)[inside], table["after"].attrs)
    return table.isel(interval=inside).assign(after=after)


def noise_of_rows(table: xr.Dataset) -> Floats:
    """Return the noise of each interval, nT: the median of the others' where its own data do not tell."""
    noise = np.array(table["after"].values, dtype=np.float64)
    known = np.isfinite(noise)
    if known.any():
        noise[~known] = np.median(noise[known])
    return noise


def for_given_numbers(table: xr.Dataset) -> xr.Dataset:
    """Return a table whose errors are those for given values of the numbers that the model holds.

    What is off by the same in all intervals makes no step between two of them, and no weights.
    """
    if "conditional_covariance" not in table:
        return table
    return table.assign(sigma=table["conditional_sigma"], covariance=table["conditional_covariance"])


def describe_directions(solution: Solution, names: Sequence[str], smallest: float = 0.2) -> list[str]:
    """Return as text which combinations the data determine, largest information first.

    Parameters
    ----------
    solution : Solution
        Of one interval.
    names : sequence of str
        The parameters.
    smallest : float
        Parts below this share of a combination are left out of the sentence.
    """
    sentences = []
    for vector in solution.directions:
        parts = [
            f"{share:+.2f} {name.split('.', 1)[-1]}"
            for share, name in sorted(zip(vector, names, strict=True), key=lambda part: -abs(part[0]))
            if abs(share) >= smallest
        ]
        sentences.append(" ".join(parts))
    return sentences


#: Field strength of the steps unless another is asked for, nT: that of the thesis' figures.
STRENGTH = 50_000.0

_AXES = ("x", "y", "z"), ("xy", "xz", "yz"), ("x", "y", "z")


@dataclass(frozen=True)
class BoundarySteps:
    """Steps of the calibrated field at boundaries between intervals; nT.

    Attributes
    ----------
    at : ndarray of int64, shape (boundary,)
        TT2000.
    mean, rms : ndarray, shape (boundary,)
        Step of |B| (after less before), mean and rms over directions of the field.
    sigma : ndarray, shape (boundary,)
        Standard deviation of the mean from those of both intervals; 0 where it was not given.
    strength : float
        nT.
    """

    at: Int64
    mean: Floats
    rms: Floats
    sigma: Floats
    strength: float

    def table(self) -> xr.Dataset:
        """Return the steps: dim boundary; `value` is the mean over directions."""
        import xarray as xr

        return xr.Dataset(
            {
                "value": ("boundary", self.mean),
                "sigma": ("boundary", self.sigma),
                "rms": ("boundary", self.rms),
                "units": ("boundary", np.full(self.at.size, "nT")),
                "at": ("boundary", self.at, {"scale": "TT2000"}),
            },
            attrs={"strength_nT": self.strength},
        )


def sphere() -> tuple[Floats, Floats]:
    """Return 14 directions (direction, 3) and weights that average polynomials of degree 5 exactly."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) / np.sqrt(3.0)
    return np.concatenate([axes, corners]), np.repeat([1 / 15, 3 / 40], [6, 8])


def table_boundary_steps(
    table: xr.Dataset, strength: float = STRENGTH, directions: Floats | None = None
) -> BoundarySteps:
    """Return the steps at the boundaries of a table of nine parameters.

    Parameters
    ----------
    table : xarray.Dataset
        dims interval, parameter(, other): `value`, `start`; `covariance` or `sigma` for the steps' errors.
    strength : float
        Field strength, nT.
    directions : ndarray, shape (direction, 3), optional
        Unit vectors, such as those of an orbit; all directions alike when absent.

    Raises
    ------
    CalibrationError
        When the table has not the nine parameters of a vector sensor, or fewer than two intervals.
    """
    order = nine_columns([str(name) for name in table["parameter"].values])
    value = table["value"].values[:, order]
    if len(value) < 2:
        raise CalibrationError("one interval has no boundary", remedy="use a table of two or more")
    mean, rms = _steps(value[:-1], value[1:], strength, directions)
    # The change of the mean strength for one unit of each parameter.
    small = np.array([1e-6] * 3 + [1e-3] * 3 + [1e-1] * 3)
    changed = value[0] + np.diag(small)
    slope = _steps(np.broadcast_to(value[0], changed.shape), changed, strength, directions)[0] / small
    table = for_given_numbers(table)
    if "covariance" in table:
        covariance = table["covariance"].values[:, order][:, :, order]
    else:
        own = table["sigma"].values[:, order] if "sigma" in table else np.zeros(value.shape)
        covariance = np.einsum("ti,ij->tij", own**2, np.eye(9))
    variance = np.einsum("i,tij,j->t", slope, covariance, slope)
    sigma = np.sqrt(variance[1:] + variance[:-1])
    return BoundarySteps(np.asarray(table["start"].values[1:], dtype=np.int64), mean, rms, sigma, strength)


def trend_jumps(
    at: Callable[[Int64], Floats],
    boundaries: Int64,
    strength: float = STRENGTH,
    directions: Floats | None = None,
) -> BoundarySteps:
    """Return the steps of continuous parameters: from one nanosecond before each boundary to it.

    Parameters
    ----------
    at : callable
        From TT2000 (time,) to nine parameters (time, 9): scale factors, angles (deg), offsets (nT).
    """
    mean, rms = _steps(at(boundaries - 1), at(boundaries), strength, directions)
    return BoundarySteps(boundaries, mean, rms, np.zeros(boundaries.size), strength)


def nine_columns(names: list[str]) -> list[int]:
    """Return the places of the nine parameters of a vector sensor among names.

    Raises
    ------
    CalibrationError
    """
    endings = [
        f".{part}[{axis}]" for part, axes in zip(PARAMETER_GROUPS, _AXES, strict=True) for axis in axes
    ]
    found = [[index for index, name in enumerate(names) if name.endswith(end)] for end in endings]
    if any(len(one) != 1 for one in found):
        raise CalibrationError(
            f"{len(names)} parameters, not the nine of a vector sensor", remedy="give a calibration table"
        )
    return [one[0] for one in found]


def calibrated_field(value: Floats, field: Floats) -> Floats:
    """Return K (E - E0) of nine parameters (time, 9) for readings E (direction, 3), nT.

    Yin (2010), eq. 2.5, angles in degrees; (time, direction, 3).
    """
    cosine = np.cos(np.deg2rad(value[:, 3:6]))
    k = np.zeros((len(value), 3, 3))
    k[:, [0, 1, 2], [0, 1, 2]] = value[:, :3]
    k[:, [0, 0, 1], [1, 2, 2]] = cosine
    free = field[None] - value[:, None, 6:]
    return np.asarray(np.einsum("tij,tdj->tdi", k, free))


def _strengths(value: Floats, field: Floats) -> Floats:
    """Return the strength of `calibrated_field`; (time, direction)."""
    return np.asarray(np.linalg.norm(calibrated_field(value, field), axis=2))


def _steps(
    before: Floats, after: Floats, strength: float, directions: Floats | None
) -> tuple[Floats, Floats]:
    """Return mean and rms over directions of the step of |B| between parameters (time, 9); (time,) nT."""
    if directions is None:
        unit, share = sphere()
    else:
        unit, share = directions, np.full(len(directions), 1.0 / len(directions))
    step = _strengths(after, strength * unit) - _strengths(before, strength * unit)
    return step @ share, np.sqrt(step**2 @ share)
