"""Figure of daily offsets along z: what the residual's spread tells, what is true, and the law of the spread.

Run ``.venv/bin/python -m docs.figures.slow_corrections FOLDER``: it simulates the mission of the page on slow
corrections in the folder, fits it where no table is there yet, and draws docs/images/z-offset.png.
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
from docs.make_pictures import screenshot
from inflight.arrays import Floats
from inflight.catalog import Catalog, Workspace
from inflight.figures import (
    AFTER,
    REFERENCE,
    error_bars,
    html_page,
    legend_below,
    plain_figure,
    spread_law_figure,
)
from inflight.simulate import SimulationSettings, simulate_day
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


def main(folder: Path) -> None:
    """Draw the figure from the simulated mission in a folder."""
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
    plots = [daily_offsets_figure(table, np.array(error)), spread_law_figure(law)]
    with tempfile.TemporaryDirectory() as made:
        page = Path(made) / "z-offset.html"
        page.write_text(html_page("", [("", [], plots)]), encoding="utf-8")
        screenshot(page, Path(__file__).parents[1] / "images" / "z-offset.png", 1190, 350)


def newest(cat: Catalog, name: str) -> xr.Dataset:
    """Return the newest table of a name, without the comparison."""
    return cat.table_by_id(cat.tables(f"main-{name}")[-1].id)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
