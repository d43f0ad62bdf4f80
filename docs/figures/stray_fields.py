"""Figure of a current that both sensors see: true errors of the field by what is stated of its place.

Run ``.venv/bin/python -m docs.figures.stray_fields FOLDER``: it simulates the mission of the page on stray
fields in the folder, fits it with each place, prints the errors and draws docs/images/stray-fields.png.
"""

from __future__ import annotations

import datetime as dt
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bokeh.models import FixedTicker
from bokeh.plotting import figure

from benchmarks.archive import simulated_workspace
from docs.make_pictures import screenshot
from inflight.arrays import Floats
from inflight.catalog import Catalog, Workspace
from inflight.figures import COMPONENTS, html_page, legend_below, plain_figure
from inflight.simulate import SimulationSettings, simulate_day
from inflight.tasks.analysis import open_workbench
from inflight.tasks.pipelines import reprocess

#: Only the battery's field is wrong, 4.75 m from the fluxgate and 6.5 m from the scalar sensor.
SETTINGS = SimulationSettings(
    seed=3,
    start=dt.date(2005, 1, 1),
    days=4,
    cadence=10,
    defects=(),
    without=tuple(sorted(set(SimulationSettings.standard_effects) - {"battery", "offset", "misalignment"})),
    overrides={"battery_field": (1.0, -0.1, 2.0), "battery_position": (0.0, 0.0, 0.0)},
)

#: What the ground tests know of it.
MODEL = """model: champ-preflight
version: 1
mission: champ
effects:
  - effect: vector_sensor
    sensor: fgm
    scale_factor: {time: block, value: [1.00139, 1.00223, 1.00221], sigma: 2.0e-3}
    misalignment: {time: block, unit: deg, value: [90.0225, 90.0640, 90.0350], sigma: 0.05}
    offset: {time: block, unit: nT, value: [23.0, 24.5, 19.0], sigma: 10.0}
"""

#: What is stated of the place, each axis with one sigma of half a metre, and what it is called.
PLACES = {
    "difference alone": "",
    "true place": "0 0 0",
    "0.5 m nearer": "0.5 0 0",
    "0.5 m farther": "-0.5 0 0",
    "0.5 m off in y": "0 0.5 0",
    "0.5 m off in z": "0 0 0.5",
}
#: How far apart the marks of two axes are.
_APART = 0.2


@dataclass(frozen=True)
class TrueError:
    """What a product is off by, rms over all days, nT.

    Attributes
    ----------
    mean : ndarray, shape (axis,)
        Of means of half an hour: noise has no part in it.
    stated : ndarray, shape (axis,)
        Uncertainty of a sample.
    residual : float
        Of a sample.
    """

    mean: Floats
    stated: Floats
    residual: float

    @classmethod
    def of(cls, cat: Catalog, settings: SimulationSettings) -> TrueError:
        """Compare the products of simulated days with the field that was put in."""
        products = [cat.read_day("l2/field", day) for day in settings.day_list]
        stated, residual = (
            np.concatenate([one[name].values for one in products]) for name in ("uncertainty", "residual")
        )
        return cls(_rms(half_hour_errors(cat, settings)), _rms(stated), float(_rms(residual)))


def half_hour_errors(cat: Catalog, settings: SimulationSettings) -> Floats:
    """Return means of half an hour of what products of simulated days are off by; (mean, axis) nT."""
    off = np.concatenate(
        [
            cat.read_day("l2/field", day)["field_sensor"].values
            - simulate_day(settings, day).truth["FIELD"].values
            for day in settings.day_list
        ]
    )
    size = round(1800 / settings.cadence)
    return np.asarray(np.nanmean(off[: len(off) // size * size].reshape(-1, size, 3), axis=1))


def _rms(values: Floats) -> Floats:
    return np.asarray(np.sqrt(np.nanmean(values**2, axis=0)))


def errors_figure(errors: dict[str, TrueError]) -> figure:
    """Draw true errors of the field and what was stated, axis by axis, case by case."""
    plot = plain_figure("Error of the vector", "", "nT rms", y_axis_type="log", width=760, height=330)
    for place, (axis, colour) in enumerate(zip("xyz", COMPONENTS, strict=True)):
        x = np.arange(len(errors)) + _APART * (place - 1)
        plot.scatter(x, [one.mean[place] for one in errors.values()], color=colour, size=8, legend_label=axis)
        stated = [one.stated[place] for one in errors.values()]
        plot.scatter(
            x, stated, color=colour, size=16, marker="dash", line_width=2, legend_label=f"{axis} stated"
        )
    plot.xaxis.ticker = FixedTicker(ticks=list(range(len(errors))))
    plot.xaxis.major_label_overrides = dict(enumerate(errors))
    legend_below(plot)
    return plot


def main(folder: Path) -> None:
    """Draw the figure from the simulated mission in a folder."""
    cat = simulated_workspace(folder, SETTINGS.days, settings=SETTINGS, workers=1)
    (folder / "models" / "champ-preflight.yaml").write_text(MODEL, encoding="utf-8")
    workspace = Workspace.open(folder)
    reprocess(cat, workspace.mission())
    errors = {"without the effect": TrueError.of(cat, SETTINGS)}
    open_workbench(workspace).add("{effect: channel_field, name: battery, channel: battery_current}")
    for name, place in PLACES.items():
        if place:
            open_workbench(workspace).set_numbers(f"battery.dipole={place} +- 0.5")
        reprocess(cat, workspace.mission())
        errors[name] = TrueError.of(cat, SETTINGS)
    for name, one in errors.items():
        sys.stdout.write(
            f"{name:20} {one.mean.round(3)} stated {one.stated.round(3)} residual {one.residual:.3f}\n"
        )
    with tempfile.TemporaryDirectory() as made:
        page = Path(made) / "stray-fields.html"
        page.write_text(html_page("", [("", [], [errors_figure(errors)])]), encoding="utf-8")
        screenshot(page, Path(__file__).parents[1] / "images" / "stray-fields.png", 830, 390)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
