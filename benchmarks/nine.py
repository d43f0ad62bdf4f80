"""Nine parameters a day: against scipy as a user would write it, and against reading the channels."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.archive import simulated_workspace
from benchmarks.measured import Row, timed
from benchmarks.rivals import naive_fit
from inflight.calibration import ParameterPrior, fit_block, reference_of, remove_other_effects, usable_samples
from inflight.catalog import Catalog, Day, Workspace
from inflight.tasks import current_model
from inflight.tasks.archive import ArchiveIndex, load_samples, needs_of
from inflight.threads import one_thread
from inflight.time import day_bounds

#: The fits begin so far from the solution: 20 ppm, 7 arcsec, 0.5 nT, as after some weeks of ageing.
_AWAY = np.array([2e-5, -2e-5, 2e-5, 2e-3, -2e-3, 2e-3, 0.5, -0.5, 0.5])


def nine_parameters(keep: Path | None = None) -> list[Row]:
    """Return the row of the fit of a day; `keep` is the folder of simulated archives."""
    with tempfile.TemporaryDirectory() as scratch:
        return [_fitted(simulated_workspace((keep or Path(scratch)) / "archive-10", 10))]


def _fitted(cat: Catalog, days: int = 6) -> Row:
    """Return the row of the fit of a day of 86 400 samples, one thread."""
    mission = Workspace.open(cat.workspace).mission()
    model = current_model(cat, mission).model
    needs = needs_of(mission, model)
    index = ArchiveIndex.of(cat, needs)
    rows = []
    with one_thread():
        for day in index.complete_days(needs)[:days]:
            samples = load_samples(cat, mission, model, day, needs, index)
            reading, additive, scalar = remove_other_effects(model, samples)
            good = usable_samples(samples, reading, additive, scalar)
            prior = reference_of(model, sum(day_bounds(day)) // 2)
            fit = fit_block(reading, additive, scalar, good, prior)
            near = ParameterPrior(fit.value + _AWAY, prior.sigma)
            own = timed(lambda: fit_block(reading, additive, scalar, good, near, prior), 9)  # noqa: B023
            slow = timed(lambda: naive_fit(reading[good], additive[good], scalar[good], near.value))  # noqa: B023
            records = [index.days[("l1/fgm", day)], index.days[("l1/ovm", day)]]
            read = timed(lambda: _read(cat, records), 9)  # noqa: B023
            rows.append((np.median(own), np.median(slow), np.median(read)))
    own_s, slow_s, read_s = np.array(rows).T
    return Row(
        what="nine parameters of a day, one thread",
        seconds=own_s.tolist(),
        floor_s=float(np.median(read_s)),
        floor="nine parameters: field and scalar of the day read and decoded",
        naive_s=float(np.median(slow_s)),
        naive="nine parameters: scipy's least_squares with a numerical Jacobian",
    )


def _read(cat: Catalog, records: list[Day]) -> None:
    for record in records:
        cat.read(record, ["field", "flag"])
