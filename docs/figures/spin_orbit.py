"""Figure of a spinning sensor near the Earth: errors of the field without and with what the orbit does to it.

Run ``.venv/bin/python -m docs.figures.spin_orbit FOLDER``: it simulates two days of a THEMIS-like mission in
the folder, one with offsets that follow eclipses and one whose spin axis moves at perigee, prints the errors
of the field in the sensor's axes with what is stated, and draws docs/images/spin-orbit.png.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from docs.figures.slow_corrections import draw
from docs.figures.stray_fields import TrueError, errors_figure
from inflight.catalog import Catalog, Workspace
from inflight.mission import Mission
from inflight.simulate.spinning import SpinningSettings, simulate_spinning_day
from inflight.spin import respin
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.pipelines import ReprocessSettings, reprocess

DAY = "2012-03-01"
#: What is wrong, and the keys of the comparison that take it into account.
CASES = {
    "eclipse_shift": ("eclipse", ("eclipse: shadow", "after_eclipse: 3 h")),
    "perigee_turn": ("perigee", ("cut_at: perigee",)),
}


def main(folder: Path) -> None:
    """Draw the figure from the simulated missions in a folder."""
    errors = {}
    for effect, (name, keys) in CASES.items():
        settings = SpinningSettings(
            days=1,
            seed=3,
            without=("zero_drift",),
            include=(effect,),
            overrides={"cadence": 0.5, "apogee": 8.0},
        )
        made = Workspace.create(folder / name, "themis")
        simulate(settings, made.data, workers=1)
        path = made.root / "mission.yaml"
        text = path.read_text(encoding="utf-8").replace("cadence: 250 ms", "cadence: 500 ms")
        path.write_text(text, encoding="utf-8")
        cat, day = Catalog(made.root), simulate_spinning_day(settings, DAY)
        ingest(cat, made.mission(), made.data)
        truth = respin(day.truth["FIELD"].values, day.truth["PHASE"].values)
        dark = np.repeat(day.instruments["slow"]["SHADOW"].values > 0, 20)
        # In light, and more than two hours after a shadow.
        used = np.convolve(dark, np.ones(14_401))[: dark.size] < 0.5
        line = "    spin_axis: spin_axis\n"
        for label, more in ((f"{name}: before", ()), (f"{name}: after", keys)):
            mission = Mission.parse(text.replace(line, line + "".join(f"    {key}\n" for key in more)))
            reprocess(cat, mission, settings=ReprocessSettings(table="daily"))
            product = cat.read(cat.days("l2/field", states=("published",))[0])
            errors[label] = error_of(
                product["field_sensor"].values - truth, used, product["uncertainty"].values
            )
    for name, one in errors.items():
        sys.stdout.write(f"{name:16} {(1e3 * one.mean).round(1)} stated {(1e3 * one.stated).round(1)} pT\n")
    draw("spin-orbit.png", [errors_figure(errors)], 800)


def error_of(off: np.ndarray, used: np.ndarray, stated: np.ndarray) -> TrueError:
    """Return the error of half an hour's means in the sensor's axes: what turns with the sensor; rms, nT."""
    size = 3600
    kept = np.where(used[:, None], off, np.nan)[: len(off) // size * size].reshape(-1, size, 3)
    full = np.isfinite(kept).all(axis=(1, 2))
    means = kept[full].mean(axis=1)
    sigma = np.sqrt(np.nanmean(stated[used] ** 2, axis=0))
    return TrueError(np.sqrt(np.mean(means**2, axis=0)), sigma, float(np.sqrt(np.mean(off[used] ** 2))))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
