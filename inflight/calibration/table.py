"""Calibration tables: how much and when, with covariance and what is behind each number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.sensor import UNITS, Reference
from inflight.calibration.solution import Solution

#: Where a value comes from: codes of the variable `source`.
SOURCES = ("prior", "combination", "data")


@dataclass(frozen=True)
class Interval:
    """One row of a table: a half-open TT2000 span, its solution and what it was made from."""

    start: int
    end: int
    value: Floats
    covariance: Floats
    solution: Solution
    count: float
    before: float
    after: float
    blocks: int = 1


def calibration_table(
    rows: Sequence[Interval], reference: Reference, attributes: dict[str, str]
) -> xr.Dataset:
    """Return the table of several intervals.

    Returns
    -------
    xarray.Dataset
        dims interval, parameter, other: `value`, `sigma`, `covariance`, `prior`, `prior_sigma` in
        the units of `units` (parameter); `determined` (bool), `retained`, `source` (codes of
        `SOURCES`): *prior* never moved, *combination* moved only as part of a combination that the
        data determine, *data* determined by itself; `start`, `end` TT2000; `count`, `before`,
        `after` (nT rms), `directions` (number of combinations determined), `inflation`.
    """
    names = reference.columns
    of_rows, each = ("interval",), ("interval", "parameter")
    sigma = np.array([np.sqrt(np.diag(row.covariance)) for row in rows])
    scalars = {
        "count": [row.count for row in rows],
        "before": [row.before for row in rows],
        "after": [row.after for row in rows],
        "inflation": [row.solution.inflation for row in rows],
    }
    return xr.Dataset(
        {
            "value": (each, np.array([row.value for row in rows])),
            "sigma": (each, sigma),
            "covariance": ((*each, "other"), np.array([row.covariance for row in rows])),
            "determined": (each, np.array([row.solution.determined for row in rows])),
            "retained": (each, np.array([row.solution.retained for row in rows])),
            "source": (
                each,
                np.array([_sources(row.solution) for row in rows]),
                {"flag_meanings": " ".join(SOURCES)},
            ),
            "prior": ("parameter", reference.value),
            "prior_sigma": ("parameter", reference.sigma),
            "units": ("parameter", np.array(UNITS, dtype="U8")),
            "start": (of_rows, np.array([row.start for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "end": (of_rows, np.array([row.end for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "blocks": (of_rows, np.array([row.blocks for row in rows], dtype=np.int64)),
            "directions": (of_rows, np.array([len(row.solution.directions) for row in rows], dtype=np.int64)),
        }
        | {name: (of_rows, np.array(values, dtype=np.float64)) for name, values in scalars.items()},
        coords={"parameter": names, "other": names},
        attrs=attributes,
    )


def _sources(solution: Solution) -> np.ndarray[tuple[int], np.dtype[np.int8]]:
    return np.where(solution.determined, 2, np.where(solution.moved, 1, 0)).astype(np.int8)


def describe_directions(solution: Solution, names: Sequence[str], smallest: float = 0.2) -> list[str]:
    """Say in words which combinations the data determine, largest information first.

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
