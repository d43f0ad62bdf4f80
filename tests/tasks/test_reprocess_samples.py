"""Samples of a day are those of an unbroken alignment: midnight leaves no trace."""

import numpy as np
import pytest
import xarray as xr

from inflight.catalog import Catalog, Workspace
from inflight.samples import align
from inflight.tasks.archive import ArchiveIndex, load_samples, needs_of
from inflight.tasks.models import ideal_model
from inflight.time import SECOND, day_bounds

YAML = """\
mission: crossing
instruments:
  turning:
    role: vector
    cadence: 10 s
    files: {pattern: "v_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels:
      field: {variables: [x, y, z], unit: nT}
      warmth: {variable: t, unit: degC, kind: temperature, lag: LAG}
  absolute:
    role: scalar
    cadence: 10 s
    files: {pattern: "s_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels: {field: {variable: f, unit: nT}}
comparisons: {main: {kind: scalar, vector: turning, scalar: absolute, base: absolute}}
"""
#: Three days around a leap second.
DAYS = [np.datetime64("2016-12-30"), np.datetime64("2016-12-31"), np.datetime64("2017-01-01")]
FIRST = day_bounds(DAYS[0])[0]


def instruments(stamps: np.ndarray) -> dict[str, np.ndarray]:
    t = (stamps - FIRST) / SECOND
    field = np.stack([2e4 * np.sin(t / 900), 2e4 * np.cos(t / 900), 4e4 + 500 * np.sin(t / 700)], axis=1)
    return {"field": field, "warmth": 20 + np.sin(t / 3000), "total": np.linalg.norm(field, axis=1)}


def archive(cat: Catalog, offset_s: float) -> dict[str, xr.DataArray]:
    """Write three days of both instruments; return the unbroken series."""
    whole = np.arange(FIRST, day_bounds(DAYS[-1])[1], 10 * SECOND, dtype=np.int64)
    shifted = whole + round(offset_s * SECOND)
    stamps = {"turning": shifted[shifted < day_bounds(DAYS[-1])[1]], "absolute": whole}
    series = {}
    with cat.run("test") as run:
        for name, ticks in stamps.items():
            made = instruments(ticks)
            for day in DAYS:
                start, end = day_bounds(day)
                inside = (ticks >= start) & (ticks < end)
                told = {
                    "tt2000": ("time", ticks[inside]),
                    "flag": ("time", np.zeros(inside.sum(), np.uint32)),
                }
                if name == "turning":
                    told["field"] = (("time", "axis"), made["field"][inside], {"units": "nT"})
                    told["warmth"] = (
                        "time",
                        made["warmth"][inside],
                        {"units": "degC", "kind": "temperature"},
                    )
                else:
                    told["field"] = ("time", made["total"][inside], {"units": "nT"})
                run.stage(f"l1/{name}", xr.Dataset(told), day=day)
        run.publish()
    for name, key, ticks in (
        ("vector", "field", stamps["turning"]),
        ("scalar", "total", stamps["absolute"]),
        ("warmth", "warmth", stamps["turning"]),
    ):
        values = instruments(ticks)[key]
        series[name] = xr.DataArray(
            values,
            dims=("time", "axis")[: values.ndim],
            coords={"tt2000": ("time", ticks)},
            attrs={"cadence_ns": 10 * SECOND},
        )
    return series


@pytest.mark.parametrize("lag", ["0 s", "100 s", "-75 s"])
@pytest.mark.parametrize("offset_s", [0.0, 3.0])
def test_a_day_cut_from_the_archive_equals_one_of_an_unbroken_alignment(tmp_path, offset_s, lag):
    yaml = tmp_path / "mission.yaml"
    yaml.write_text(YAML.replace("LAG", lag), encoding="utf-8")
    mission = Workspace.create(tmp_path / "w", yaml).mission()
    cat = Catalog(tmp_path / "w")
    series = archive(cat, offset_s)
    model = ideal_model(mission)
    needs = needs_of(mission, model, ["warmth"])
    index = ArchiveIndex.of(cat, needs)
    lag_ns = mission.instruments["turning"].channels["warmth"].lag
    unbroken = align(series, "scalar", {"warmth": lag_ns})
    for day in DAYS:
        start, end = day_bounds(day)
        samples = load_samples(cat, mission, model, day, needs, index)
        inside = (unbroken["tt2000"].values >= start) & (unbroken["tt2000"].values < end)
        for name in ("vector", "scalar", "warmth", "tt2000", "flag"):
            expected = unbroken[name].values[inside]
            assert np.array_equal(np.isnan(samples[name].values), np.isnan(expected)), name
            assert np.allclose(samples[name].values, expected, rtol=0, atol=1e-6, equal_nan=True), name
    middle = load_samples(cat, mission, model, DAYS[1], needs, index)
    assert np.isfinite(middle["vector"].values).all(), "neighbours lend their samples on both sides"
    assert middle.sizes["time"] == 8641, "a day of 86 401 s at 10 s holds one sample more"
