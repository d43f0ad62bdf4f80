"""Figures of daily offsets along z, with the law of the residual's spread, and of the field of the body.

Run ``.venv/bin/python -m docs.figures.slow_corrections FOLDER``: it simulates the missions of the page on
slow corrections in the folder, fits them where no table is there yet, and draws docs/images/z-offset.png and
body-field.png.
"""

from __future__ import annotations

import datetime as dt
import sys
import tempfile
from pathlib import Path

import numpy as np
import xarray as xr
from bokeh.plotting import figure

from benchmarks.archive import simulated_workspace
from docs.figures.stray_fields import MODEL, TrueError, half_hour_errors
from docs.make_pictures import screenshot
from inflight.arrays import Floats
from inflight.catalog import Catalog, Workspace
from inflight.figures import (
    AFTER,
    COMPONENTS,
    REFERENCE,
    error_bars,
    html_page,
    legend_below,
    plain_figure,
    spread_law_figure,
)
from inflight.simulate import SimulationSettings, simulate_day
from inflight.tasks.analysis import open_workbench
from inflight.tasks.pipelines import ReprocessSettings, reprocess
from inflight.time import to_utc

#: Only the offset along z wanders.
SETTINGS = SimulationSettings(
    seed=5,
    start=dt.date(2005, 1, 1),
    days=24,
    cadence=10,
    defects=(),
    without=tuple(sorted(set(SimulationSettings.standard_effects) - {"offset", "misalignment"})),
    include=("offset_drift",),
    overrides={"offset_axes": (0.0, 0.0, 1.0), "offset_drift_rms": 1.0},
)

#: Only the field of the body is wrong: it changes within weeks as it does in years.
BODY_SETTINGS = SETTINGS.model_copy(
    update={
        "start": dt.date(2000, 7, 15),
        "include": (),
        "without": tuple(
            sorted(
                set(SimulationSettings.standard_effects) - {"offset", "misalignment", "torquer", "remanent"}
            )
        ),
        "overrides": {"torquer_trend": (0.0, 60.0, 45.0), "torquer_trend_days": 12.0},
    }
)
BODY_MODEL = (
    MODEL
    + """  - effect: torquer
    name: torquer_fgm
    sensor: fgm
    channel: torquer_current
    matrix: {unit: nT/A, value: [15.0, -9.6, -13.4, 0.0, -27.1, 0.1, -1.3, 1.0, -35.95]}
  - effect: torquer
    name: torquer_ovm
    sensor: ovm
    channel: torquer_current
    matrix: {unit: nT/A, value: [7.785, -2.466, -2.238, -0.402, -9.248, -0.199, -0.163, 0.053, -11.368]}
"""
)
BODY_EFFECT = "{effect: remanent_moment, dipole: {position: [-1.1, 0, 0], sigma: 0.5}}"


def daily_offsets_figure(table: xr.Dataset, error: Floats) -> figure:
    """Draw the offsets of a table with their sigma, and the true error of the field that they stand for.

    Parameters
    ----------
    table : xarray.Dataset
        The table ``main-z-offset``.
    error : ndarray, shape (interval,)
        Mean error along z of each day's product without the correction, nT.
    """
    plot = plain_figure("Daily offset along z", "", "nT", x_axis_type="datetime", width=560, height=300)
    middle = to_utc(table["start"].values // 2 + table["end"].values // 2)
    value, sigma = (table[name].isel(parameter=0).values for name in ("value", "sigma"))
    plot.line(middle, error, color=REFERENCE, line_width=2, legend_label="true")
    error_bars(plot, middle, value, sigma, AFTER)
    plot.scatter(middle, value, color=AFTER, size=6, legend_label="by the spread of the residual")
    legend_below(plot)
    return plot


def body_figure(before: Floats, after: Floats) -> figure:
    """Draw means of half an hour of the true error along y and z, without and with the body's field; nT."""
    plot = plain_figure("Error of the vector", "day", "nT", width=560, height=300)
    days = np.arange(len(before)) / 48
    for place, axis in ((1, "y"), (2, "z")):
        plot.line(
            days,
            before[:, place],
            color=COMPONENTS[place],
            line_dash="dashed",
            legend_label=f"{axis} before",
        )
        plot.line(
            days,
            after[:, place],
            color=COMPONENTS[place],
            line_width=2,
            legend_label=f"{axis} after",
        )
    legend_below(plot)
    return plot


def main(folder: Path) -> None:
    """Draw both figures from the simulated missions in a folder."""
    draw("z-offset.png", z_offset_plots(folder / "z"))
    draw("body-field.png", body_plots(folder / "body"))


def draw(name: str, plots: list[figure], width: int = 580) -> None:
    """Write plots side by side, each so many pixels wide, as a picture of the documentation."""
    with tempfile.TemporaryDirectory() as made:
        page = Path(made) / "page.html"
        page.write_text(html_page("", [("", [], plots)]), encoding="utf-8")
        screenshot(page, Path(__file__).parents[1] / "images" / name, 30 + width * len(plots), 350)


def z_offset_plots(folder: Path) -> list[figure]:
    """Return daily offsets along z and the law of the residual's spread."""
    cat = simulated_workspace(folder, SETTINGS.days, settings=SETTINGS)
    if not cat.tables("main-z-offset"):
        (folder / "models" / "champ-preflight.yaml").write_text(MODEL, encoding="utf-8")
        reprocess(cat, Workspace.open(folder).mission(), settings=ReprocessSettings(table="continuous"))
    table, law = (newest(cat, name) for name in ("z-offset", "z-offset-law"))
    error = []
    for day in SETTINGS.day_list:
        product = cat.read_day("l2/field", day)
        off = (product["field_sensor"].values - simulate_day(SETTINGS, day).truth["FIELD"].values)[:, 2]
        # What a model that takes the table took off belongs to the error without it.
        taken = product["correction_z_offset"].values[:, 2] if "correction_z_offset" in product else 0.0
        error.append(float(np.nanmean(off + taken)))
    return [daily_offsets_figure(table, np.array(error)), spread_law_figure(law)]


def body_plots(folder: Path) -> list[figure]:
    """Return the true error without and with the field of the body, printed, too; the folder is new."""
    cat = simulated_workspace(folder, BODY_SETTINGS.days, str(BODY_SETTINGS.start), settings=BODY_SETTINGS)
    workspace = Workspace.open(folder)
    (folder / "models" / "champ-preflight.yaml").write_text(BODY_MODEL, encoding="utf-8")
    settings = ReprocessSettings(table="continuous", trend="constant", mean_days=4)
    found = []
    for effect in ("", BODY_EFFECT):
        if effect:
            open_workbench(workspace).add(effect)
        reprocess(cat, workspace.mission(), settings=settings)
        found.append(half_hour_errors(cat, BODY_SETTINGS))
        sys.stdout.write(f"{effect or 'torquers alone'}: {TrueError.of(cat, BODY_SETTINGS)}\n")
    eta, sigma = fitted_eta(cat)
    sys.stdout.write(f"eta {eta:.3f} +- {sigma:.3f} nT/A\n")
    return [body_figure(*found)]


def fitted_eta(cat: Catalog) -> tuple[float, float]:
    """Return eta of the body's field at the vector sensor, and its sigma, nT/A."""
    trend = newest(cat, "trend").set_index(parameter="parameter").sel(parameter="remanent_moment.eta")
    return float(trend["value"]), float(trend["sigma"])


def newest(cat: Catalog, name: str) -> xr.Dataset:
    """Return the newest table of a name, without the comparison."""
    return cat.table_by_id(cat.tables(f"main-{name}")[-1].id)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
