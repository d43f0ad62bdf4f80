"""A boom with two sensors: from its deliveries to tables, products, a comparison and its units' names."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from inflight.catalog import Catalog
from inflight.catalog.workspace import Workspace
from inflight.errors import MissionError
from inflight.flags import Flag
from inflight.simulate.dual import DualSettings
from inflight.tasks.compare import compare
from inflight.tasks.ingest import ingest
from inflight.tasks.reprocess import ReprocessSettings, reprocess
from inflight.tasks.simulate_dual import simulate_dual, truth_path
from inflight.tasks.states_units import named_units

MISSION = Path(__file__).parents[2] / "missions" / "venus-express.yaml"
#: Every four seconds, to be quick.
COARSE = {"cadence": 4.0}
SETTINGS = DualSettings(days=2, seed=31, defects=("gaps",), overrides=COARSE)


def workspace(folder, settings):
    source = folder.parent / f"{folder.name}.yaml"
    text = MISSION.read_text(encoding="utf-8").replace("cadence: 1 s", "cadence: 4 s")
    source.write_text(text, encoding="utf-8")
    made = Workspace.create(folder, source)
    simulate_dual(settings, made.data, workers=1)
    cat, mission = Catalog(folder), made.mission()
    assert ingest(cat, mission, made.data).days["failed"] == 0
    return cat, mission, made


@pytest.fixture(scope="module")
def boom(tmp_path_factory):
    """Two days, reprocessed."""
    cat, mission, made = workspace(tmp_path_factory.mktemp("two") / "w", SETTINGS)
    return cat, mission, made, reprocess(cat, mission)


def errors(cat, made, day):
    """Return errors of the measured and the corrected outboard field every 10 s, constants removed; nT."""
    product = cat.read(day, dated=False)
    with xr.open_dataset(truth_path(made.data, day.day), engine="h5netcdf") as truth:
        stamps, field = truth["Epoch"].values.astype(np.int64), truth["FIELD"].values
        offset = truth["OFFSET_OUT"].values
    rows = np.searchsorted(product["tt2000"].values, stamps)
    rows = np.clip(rows, 0, product.sizes["time"] - 1)
    there = product["tt2000"].values[rows] == stamps
    told = product.isel(time=rows[there])
    good = (told["flag"].values & np.uint32(Flag.TRANSIENT | Flag.UNKNOWN_STATE)) == 0
    good &= np.isfinite(told["field_spacecraft"].values).all(axis=1)
    out = {}
    for name in ("outboard", "field_spacecraft"):
        left = (told[name].values - field[there] - offset[there])[good]
        out[name] = left - left.mean(axis=0)
    return out, told.isel(time=good)


def test_both_days_become_products_with_one_certified_table(boom):
    cat, _, _, report = boom
    assert report.exit_code == 0
    assert report.days["done"] == 2
    (record,) = cat.tables("main-states")
    assert record.certified
    (window,) = report.extra["windows"]
    assert (window["start"], window["end"]) == ("2006-05-14", "2006-05-16")
    assert window["applied"] == "yes"
    assert window["units"] == 4


def test_the_stray_field_goes_down_to_the_noise(boom):
    cat, _, made, report = boom
    for day in cat.days("l2/field", states=("published",)):
        found, _ = errors(cat, made, day)
        before, after = (float(np.sqrt(np.mean(found[name] ** 2))) for name in found)
        assert before > 0.5
        assert after < 0.1
    residual = report.extra["residual"]
    assert residual["after_nT"] < 1.3 * residual["floor_nT"] < residual["before_nT"]


def test_the_stated_error_covers_what_is_left(boom):
    cat, _, made, _ = boom
    inside = []
    for day in cat.days("l2/field", states=("published",)):
        found, told = errors(cat, made, day)
        inside.append(np.abs(found["field_spacecraft"]) < 2.0 * told["uncertainty"].values)
    assert np.mean(np.concatenate(inside)) > 0.93


def test_products_say_what_they_are(boom):
    cat, mission, _, _ = boom
    product = cat.read(cat.days("l2/field", states=("published",))[0])
    assert {"inboard", "outboard", "correction", "uncertainty", "state", "probability"} <= set(product)
    assert (product.attrs["applied"], product.attrs["constant_known"]) == ("yes", "no")
    assert product.attrs["acknowledgement"] == mission.acknowledgement
    known = product["flag"].values == 0
    assert np.allclose(
        (product["outboard"] - product["correction"]).values[known],
        product["field_spacecraft"].values[known],
        atol=2e-4,
    )


def test_a_second_run_changes_nothing_and_a_new_day_only_its_window(boom):
    cat, mission, _, _ = boom
    again = reprocess(cat, mission)
    assert (again.days["unchanged"], again.days["done"]) == (2, 0)
    assert len(cat.tables("main-states")) == 1


def test_a_comparison_shows_the_steps_before_and_after(boom, tmp_path):
    cat, mission, _, _ = boom
    report = compare(cat, mission, output=tmp_path / "page.html")
    fields = report.as_json()
    residual = fields["residual"]
    assert residual["after_nT"] < 1.3 * residual["noise_floor_nT"] < residual["before_nT"]
    assert len(fields["by_day"]) == 2
    page = (tmp_path / "page.html").read_text()
    for part in ("Steps at switchings", "States in time", "as measured", "Outboard sensor along x"):
        assert part in page


def test_the_page_is_drawn_in_a_browser(boom, tmp_path):
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium or chrome on the path")
    cat, mission, _, _ = boom
    page, picture = tmp_path / "page.html", tmp_path / "page.png"
    compare(cat, mission, output=page)
    subprocess.run(
        [browser, "--headless", "--no-sandbox", f"--screenshot={picture}", "--window-size=1300,2000", page],
        check=True,
        capture_output=True,
        timeout=120,
    )
    assert picture.stat().st_size > 50_000


def test_units_get_the_names_of_their_currents_and_one_has_none(boom):
    cat, mission, _, _ = boom
    units = named_units(cat, mission, "main", None, None)
    assert units is not None
    named = sorted(one["channels"][0] for one in units if one["channels"])
    assert named == ["camera_current", "spectrometer_current", "transmitter_current"]
    (nameless,) = [one for one in units if not one["channels"]]
    assert "without housekeeping" in nameless["sentence"]


def test_a_table_that_two_sensors_have_not_is_refused(boom):
    cat, mission, _, _ = boom
    with pytest.raises(MissionError, match="continuous"):
        reprocess(cat, mission, settings=ReprocessSettings(table="continuous"))


def test_windows_of_a_day_learn_by_themselves(tmp_path):
    cat, mission, _ = workspace(tmp_path / "w", DualSettings(days=2, seed=33, overrides=COARSE))
    report = reprocess(cat, mission, settings=ReprocessSettings(table="daily"))
    assert len(report.extra["windows"]) == 2
    tables = [cat.table("main-states", day) for day in ("2006-05-14", "2006-05-15")]
    assert tables[0].attrs["table_id"] != tables[1].attrs["table_id"]


def test_a_spacecraft_that_switches_nothing_is_left_alone(tmp_path):
    silent = ("transmitter", "spectrometer", "camera", "survival_heater")
    cat, mission, _ = workspace(
        tmp_path / "w", DualSettings(days=1, seed=35, without=silent, overrides=COARSE)
    )
    report = reprocess(cat, mission)
    assert report.exit_code == 0
    (window,) = report.extra["windows"]
    assert window["applied"] == "no"
    product = cat.read(cat.days("l2/field", states=("published",))[0])
    assert np.array_equal(product["field_spacecraft"], product["outboard"], equal_nan=True)
    assert product.attrs["reason"]
