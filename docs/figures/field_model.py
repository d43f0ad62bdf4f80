"""Figure of a sensor that is calibrated against a model of the Earth's field: true errors by component.

Run ``.venv/bin/python -m docs.figures.field_model FOLDER``: it simulates two missions in the folder, one of
which has a field that stays and that the model lacks, prints errors and stated ones and draws
docs/images/platform-magnetometer.png.
"""

from __future__ import annotations

import datetime as dt
import sys
from pathlib import Path

import numpy as np

from benchmarks.archive import simulated_workspace
from docs.figures.slow_corrections import draw
from docs.figures.stray_fields import TrueError, errors_figure
from inflight.arrays import Floats
from inflight.catalog import Catalog, Workspace
from inflight.simulate import SimulationSettings, simulate_day
from inflight.tasks.pipelines import reprocess

#: Only the sensor's own numbers are wrong, and the model lacks 5 nT of ionosphere and crust.
SETTINGS = SimulationSettings(
    seed=5,
    start=dt.date(2005, 1, 1),
    days=2,
    cadence=10,
    defects=(),
    without=tuple(
        sorted(set(SimulationSettings.standard_effects) - {"offset", "misalignment", "external_field"})
    ),
)
COMPARISON = "comparisons: {main: {kind: field_model, vector: fgm, external: 5}}\n"
#: A field as of the ring current, nT along Earth-fixed axes: as large as `external` states.
STAYS = (4.0, -3.0, 7.0)


def main(folder: Path) -> None:
    """Draw the figure from the simulated missions in a folder."""
    errors = {}
    for name, field in (("calibrated", (0.0, 0.0, 0.0)), ("a field stays", STAYS)):
        settings = SETTINGS.model_copy(update={"overrides": {"steady_field": field}})
        cat = simulated_workspace(folder / name.split()[-1], settings.days, settings=settings, workers=1)
        path = cat.workspace / "mission.yaml"
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        kept = [line for line in lines if not line.startswith(("comparisons:", "preflight:"))]
        path.write_text("".join([*kept, COMPARISON]), encoding="utf-8")
        reprocess(cat, Workspace.open(cat.workspace).mission())
        before, errors[name] = errors_of(cat, settings)
        errors = {"before": before} | errors
    for name, one in errors.items():
        sys.stdout.write(f"{name:14} {one.mean.round(3)} stated {one.stated.round(3)}\n")
    draw("platform-magnetometer.png", [errors_figure(errors)], 800)


def errors_of(cat: Catalog, settings: SimulationSettings) -> tuple[TrueError, TrueError]:
    """Return true errors with the pre-flight model and calibrated; half an hour's means, rms."""
    products = [cat.read_day("l2/field", day) for day in settings.day_list]
    truth = np.concatenate([simulate_day(settings, day).truth["FIELD"].values for day in settings.day_list])
    model, before, field, stated = (
        np.concatenate([one[name].values for one in products])
        for name in ("field_model", "residual_preflight", "field_spacecraft", "uncertainty")
    )
    size = round(1800 / settings.cadence)

    def error_of(off: Floats, sigma: Floats) -> TrueError:
        means = np.nanmean(off[: len(off) // size * size].reshape(-1, size, 3), axis=1)
        residual = float(np.sqrt(np.nanmean((off + truth - model) ** 2)))
        return TrueError(np.sqrt(np.nanmean(means**2, axis=0)), sigma, residual)

    # What a sensor is before it is calibrated, nothing states.
    calibrated = error_of(field - truth, np.sqrt(np.nanmean(stated**2, axis=0)))
    return error_of(model + before - truth, np.full(3, np.nan)), calibrated


if __name__ == "__main__":
    main(Path(sys.argv[1]))
