"""Nine parameters a day: against scipy as a user would write it, and against reading the channels."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from inflight.arrays import Floats
from inflight.calibration import ParameterPrior, fit_block, reference_of, remove_other_effects, usable_samples
from inflight.catalog import Catalog, Day, Workspace
from inflight.tasks import current_model
from inflight.tasks.archive import ArchiveIndex, load_samples, needs_of
from inflight.time import day_bounds

#: The fits begin so far from the solution: 20 ppm, 7 arcsec, 0.5 nT, as after some weeks of ageing.
_AWAY = np.array([2e-5, -2e-5, 2e-5, 2e-3, -2e-3, 2e-3, 0.5, -0.5, 0.5])


def naive(reading: Floats, additive: Floats, scalar: Floats, start: Floats) -> Floats:
    """Fit with scipy's default least squares, numerical Jacobian and no scaling but the units'."""

    def residual(p: Floats) -> Floats:
        cos = np.cos(np.deg2rad(p[3:6]))
        k = np.array([[p[0], cos[0], cos[1]], [0.0, p[1], cos[2]], [0.0, 0.0, p[2]]])
        return np.linalg.norm((reading - p[6:]) @ k.T - additive, axis=1) - scalar

    return np.asarray(least_squares(residual, start, x_scale=[1e-5] * 3 + [1e-3] * 3 + [1.0] * 3).x)


def timed(work: Callable[[], object], repeats: int = 1) -> float:
    """Return the median wall time of some work, milliseconds."""
    spent = []
    for _ in range(repeats):
        begun = time.perf_counter()
        work()
        spent.append(time.perf_counter() - begun)
    return float(np.median(spent)) * 1e3


def nine_parameters(cat: Catalog, days: int = 6) -> list[str]:
    """Return the lines to print."""
    mission = Workspace.open(cat.workspace).mission()
    model = current_model(cat, mission).model
    needs = needs_of(mission, model)
    index = ArchiveIndex.of(cat, needs)
    rows, worst = [], 0.0
    with threadpool_limits(1):
        for day in index.complete_days(needs)[:days]:
            samples = load_samples(cat, mission, model, day, needs, index)
            reading, additive, scalar = remove_other_effects(model, samples)
            good = usable_samples(samples, reading, additive, scalar)
            prior = reference_of(model, sum(day_bounds(day)) // 2)
            fit = fit_block(reading, additive, scalar, good, prior)
            near = ParameterPrior(fit.value + _AWAY, prior.sigma)
            own = timed(lambda: fit_block(reading, additive, scalar, good, near, prior), 9)  # noqa: B023
            slow = timed(lambda: naive(reading[good], additive[good], scalar[good], near.value))  # noqa: B023
            records = [index.days[("l1/fgm", day)], index.days[("l1/ovm", day)]]
            read = timed(lambda: _read(cat, records), 9)  # noqa: B023
            whole = timed(lambda: load_samples(cat, mission, model, day, needs, index), 5)  # noqa: B023
            rows.append((own, slow, read, whole, _bytes(cat.workspace, records)))
            found = naive(reading[good], additive[good], scalar[good], fit.value)
            worst = max(worst, float(np.max(np.abs(found - fit.value) / fit.sigma)))
    own, slow, read, whole, size = np.median(rows, axis=0)
    return [
        f"nine parameters, one day of 86 400 s, one thread (median of {len(rows)} days)",
        f"  robust fit with covariance              {own:8.2f} ms   {1e3 / own:7.0f} days/s",
        f"  scipy least_squares, as a user writes it {slow:7.1f} ms   {slow / own:7.1f} times longer",
        f"  read and decode field and scalar        {read:8.2f} ms   the fit takes {own / read:.2f} of it",
        f"  read, decode, align all the model needs {whole:8.2f} ms",
        f"  bytes of field and scalar on disk       {size / 1e6:8.2f} MB",
        f"  largest difference to scipy's result    {worst:8.2f} sigma (it is not robust)",
    ]


def _read(cat: Catalog, records: list[Day]) -> None:
    for record in records:
        cat.read(record, ["field", "flag"])


def _bytes(workspace: Path, records: list[Day]) -> int:
    """Return the bytes of the chunks that hold field and flag of some days."""
    total = 0
    for record in records:
        store = workspace / record.segment
        width = record.rows[0]
        for name in ("field", "flag", "tt2000"):
            chunks = sorted(path for path in (store / name / "c").rglob("*") if path.is_file())
            total += chunks[0].stat().st_size if chunks and width >= 0 else 0
    return total
