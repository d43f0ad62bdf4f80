"""Tables of a pair of calibrated vector sensors, from the products of both.

Two fluxgates that a scalar sensor calibrates (`inflight.mission_fit.two_fluxgates`): the statistics of a day
are a few Gram matrices, and the tables are algebra of these: the relation of all days and of each day, and
which of the three sensors disagrees. Two spinning sensors: how the boom between them bends (Farrell et al.
1995, VI).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.catalog import Catalog, Day
from inflight.flags import UNUSABLE, Flag
from inflight.mission import Mission
from inflight.mission_fit import CLUSTER_S
from inflight.tasks.models import current_model
from inflight.tasks.pipelines.base import tables_in_use
from inflight.time import DAY, SECOND, Int64, day_bounds

if TYPE_CHECKING:
    import xarray as xr

#: Clusters of a day at most: two orbits each, and one cut at either end.
_MOST_CLUSTERS = int(DAY / SECOND / CLUSTER_S) + 2


def calibration_errors(
    cat: Catalog, mission: Mission, comparisons: Sequence[str], days: Sequence[Day]
) -> list[xr.Dataset]:
    """Return what the calibrations of both sensors do to the relation of each day.

    Returns
    -------
    list of Dataset
        With `covariance` (sensor, parameter, other), units of the relation's table, and `begin` (sensor), the
        start of the interval of the table, TT2000: days of one interval have one error. 0 for tables of one
        fit of all days.
    """
    import xarray as xr

    from inflight.calibration import day_parameters, reference_of
    from inflight.mission_fit import relation_covariance

    each = []
    for comparison in comparisons:
        sensor = mission.instruments[mission.comparisons[comparison].instruments()["vector"]]
        turn = scipy.spatial.transform.Rotation.from_quat(sensor.orientation)
        model = current_model(cat, mission, comparison).model
        own: list[tuple[int, Floats]] = []
        begin, end, found = 0, 0, (0, np.zeros((0, 0)))
        for day in days:
            start = day_bounds(day.day)[0]
            if not begin <= start < end:
                table = tables_in_use(cat, comparison, day)[1]
                inside = (table["start"].values <= start) & (start < table["end"].values)
                row = table.isel(interval=int(np.flatnonzero(inside)[-1]))
                begin, end = int(row["start"]), int(row["end"])
                nine = day_parameters(table, start, reference_of(model, start))
                name = 0 if table.attrs["kind"] == "continuous" else begin
                found = name, relation_covariance(nine.value, nine.covariance, turn)
            own.append(found)
        each.append(own)
    return [
        xr.Dataset(
            {
                "begin": ("sensor", np.array([one[0] for one in pair], dtype=np.int64)),
                "covariance": (("sensor", "parameter", "other"), np.stack([one[1] for one in pair])),
            }
        )
        for pair in zip(*each, strict=True)
    ]


def joint_errors(errors: Sequence[xr.Dataset]) -> Floats:
    """Return what the calibrations do to the relation of all days; intervals are independent."""
    total = np.zeros(errors[0]["covariance"].shape[1:])
    for sensor in range(errors[0].sizes["sensor"]):
        begin = np.array([int(one["begin"][sensor]) for one in errors])
        for interval in np.unique(begin):
            own = begin == interval
            each = [one["covariance"].values[sensor] for one, here in zip(errors, own, strict=True) if here]
            total += np.mean(own) ** 2 * np.mean(each, axis=0)
    return total


def relation_table(read: Sequence[xr.Dataset], errors: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the relation of all days together, with the errors of `calibration_errors`."""
    from inflight.mission_fit import relation_of

    return relation_of(*_grams(read)).table(joint_errors(errors))


def relation_day(products: Sequence[xr.Dataset], day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return the statistics of a day's two products, and a report.

    Returns
    -------
    xarray.Dataset
        `gram` (block, cluster, column, other) and `rows` (block, cluster) of `relation_grams`, `moments`
        (block, cluster, moment) of `three_cornered_hat_sums`, empty clusters last; `closure` (block) nT.

    Raises
    ------
    CalibrationError
        When a day has too few samples of both.
    """
    import xarray as xr

    from inflight.mission_fit import relation_grams, relation_of, three_cornered_hat_sums

    both = _good_samples(products, UNUSABLE)
    fields = [np.asarray(one["field_spacecraft"].values, dtype=np.float64) for one in both]
    main, other = (np.asarray(one["residual"].values, dtype=np.float64) for one in both)
    stamps = np.asarray(both[0]["tt2000"].values, dtype=np.int64)
    gram, rows = relation_grams(fields[0], fields[1], stamps)
    along = np.linalg.norm(fields[0], axis=1) - np.linalg.norm(fields[1], axis=1)
    closure = float(np.sqrt(np.nanmean((main - other - along) ** 2)))
    moments = three_cornered_hat_sums(main, other, stamps)
    found = xr.Dataset(
        {
            "gram": (("block", "cluster", "column", "other"), _padded(gram)[None], {"units": "nT2"}),
            "rows": (("block", "cluster"), _padded(rows)[None]),
            "moments": (("block", "cluster", "moment"), _padded(moments)[None]),
            "closure": ("block", np.array([closure]), {"units": "nT"}),
        }
        | _span_of(day)
    )
    return found, {"samples": int(stamps.size), "rms_nT": relation_of(gram, rows).rms}


def _good_samples(products: Sequence[xr.Dataset], bad: int) -> tuple[xr.Dataset, ...]:
    """Return the samples that products share where none of them has one of the `bad` flags."""
    import xarray as xr

    used = [product.isel(time=(product["flag"].values & np.uint32(bad)) == 0) for product in products]
    return tuple(xr.align(*used, join="inner"))


def _span_of(day: np.datetime64) -> dict[str, Any]:
    """Return `start` and `end` of a day's statistics, TT2000."""
    return {
        name: ("block", np.array([bound], dtype=np.int64), {"scale": "TT2000"})
        for name, bound in zip(("start", "end"), day_bounds(day), strict=True)
    }


def _padded(values: Floats) -> Floats:
    """Return clusters (cluster, ...) with empty ones behind them: a store's days are of one size."""
    return np.concatenate([values, np.zeros((_MOST_CLUSTERS - len(values), *values.shape[1:]))])


def _grams(read: Sequence[xr.Dataset]) -> tuple[Floats, Floats]:
    gram, rows = (np.concatenate([day[name].values[0] for day in read]) for name in ("gram", "rows"))
    return gram[rows > 0], rows[rows > 0]


def daily_relation_table(read: Sequence[xr.Dataset], errors: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the relation of each day by itself; dims interval, parameter: `value`, `sigma`, `units`."""
    import xarray as xr

    from inflight.mission_fit import relation_of

    tables = [
        relation_of(*_grams([day])).table(joint_errors([error]))
        for day, error in zip(read, errors, strict=True)
    ]
    each = ("interval", "parameter")
    return xr.Dataset(
        {
            "value": (each, np.stack([one["value"].values for one in tables])),
            "sigma": (each, np.stack([one["sigma"].values for one in tables])),
            "rms": ("interval", np.array([one.attrs["rms_nT"] for one in tables]), {"units": "nT"}),
            "units": tables[0]["units"],
            "start": ("interval", np.concatenate([day["start"].values for day in read])),
            "end": ("interval", np.concatenate([day["end"].values for day in read])),
        },
        coords={"parameter": tables[0]["parameter"].values},
    )


def corner_table(read: Sequence[xr.Dataset], _errors: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the variance of each of the three sensors' own error, nT^2; see `three_cornered_hat`."""
    from inflight.mission_fit import three_cornered_hat

    closure = float(np.sqrt(np.mean(np.concatenate([day["closure"].values for day in read]) ** 2)))
    moments = np.concatenate([day["moments"].values[0] for day in read])
    return three_cornered_hat(moments[moments[:, 0] > 0], closure=closure).table()


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
    import xarray as xr

    from inflight.spin import fit_spins, measure_boom_bending

    inboard, outboard = _good_samples(products, UNUSABLE | Flag.NO_PHASE | Flag.PHASE_JUMP)
    stamps = np.asarray(inboard["tt2000"].values, dtype=np.int64)
    phase = unwrap_phase(np.asarray(inboard["spin_phase"].values, dtype=np.float64), stamps)
    inner, outer = (
        fit_spins(stamps, np.asarray(one["field_sensor"].values, dtype=np.float64), phase)
        for one in (inboard, outboard)
    )
    found = measure_boom_bending(outer, inner)
    dataset = xr.Dataset(
        {
            "bend": ("block", found.value, {"units": "rad"}),
            "sigma": ("block", found.sigma, {"units": "rad"}),
            "fits": ("block", found.fits),
        }
        | _span_of(day)
    )
    return dataset, {"samples": int(stamps.size), "bend_rad": float(found.value[0])}


def unwrap_phase(phase: Floats, stamps: Int64) -> Floats:
    """Return a phase between 0 and 2 pi unwrapped; across gaps turns are counted at its usual rate; rad."""
    if phase.size < 2:
        return phase
    seconds = np.diff(stamps) / 1e9
    turned = np.diff(np.unwrap(phase))
    expected = float(np.median(turned / seconds)) * seconds
    step = expected + np.mod(turned - expected + np.pi, 2.0 * np.pi) - np.pi
    return np.asarray(phase[0] + np.concatenate([[0.0], np.cumsum(step)]))


def bending_table(read: Sequence[xr.Dataset], _errors: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the bend over days; dims interval, parameter (one): `value`, `sigma` rad, `fits`, and the span.

    The azimuths as mounted are those of the two pre-flight models: the bend is what is beyond them.
    """
    import xarray as xr

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
