"""A boom with two sensors: from its deliveries to tables, products, a comparison and its units' names."""

import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from inflight.catalog import Catalog, Workspace
from inflight.cli import main
from inflight.errors import MissionError
from inflight.flags import Flag
from inflight.flows import plan_span
from inflight.simulate.dual import DualSettings
from inflight.tasks.analysis import compare
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.archive.simulated_deliveries import VENUS_EXPRESS
from inflight.tasks.pipelines import ReprocessSettings, reprocess
from inflight.tasks.pipelines.two_sensor import named_units

MISSION = Path(__file__).parents[2] / "missions" / "venus-express.yaml"
#: Every four seconds, to be quick.
COARSE = {"cadence": 4.0}
SETTINGS = DualSettings(days=2, seed=31, defects=("gaps",), overrides=COARSE)


MONITOR = """  monitor:
    role: vector
    cadence: 4 s
    files: {pattern: "mon/vex_mon_{day:%Y%m%d}_v*.cdf", reader: cdf, time: Epoch}
    channels:
      field: {variable: B, unit: nT, axes: [x, y, z], frame: spacecraft}
comparisons:
  main: {kind: dual, inboard: inboard, outboard: outboard, ambient: monitor}
"""


def workspace(folder, settings):
    source = folder.parent / f"{folder.name}.yaml"
    text = MISSION.read_text(encoding="utf-8").replace("cadence: 1 s", "cadence: 4 s")
    if "monitor" in settings.include:
        text = text[: text.index("comparisons:")] + MONITOR
    source.write_text(text, encoding="utf-8")
    made = Workspace.create(folder, source)
    simulate(settings, made.data, workers=1)
    cat, mission = Catalog(folder), made.mission()
    assert ingest(cat, mission, made.data).days["failed"] == 0
    return cat, mission, made


@pytest.fixture(scope="module")
def boom(tmp_path_factory):
    """Two days, reprocessed."""
    cat, mission, made = workspace(tmp_path_factory.mktemp("two") / "w", SETTINGS)
    return cat, mission, made, reprocess(cat, mission)


def errors(cat, made, day, constants=False):
    """Return errors of the measured and the corrected outboard field every 10 s, without constants; nT."""
    product = cat.read(day, with_time=False)
    with xr.open_dataset(VENUS_EXPRESS.truth_path(made.data, day.day), engine="h5netcdf") as truth:
        stamps, field = truth["Epoch"].values.astype(np.int64), truth["FIELD"].values
        known = field + truth["OFFSET_OUT"].values
    rows = np.searchsorted(product["tt2000"].values, stamps)
    rows = np.clip(rows, 0, product.sizes["time"] - 1)
    there = product["tt2000"].values[rows] == stamps
    told = product.isel(time=rows[there])
    good = (told["flag"].values & np.uint32(Flag.TRANSIENT | Flag.UNKNOWN_STATE)) == 0
    good &= np.isfinite(told["field_spacecraft"].values).all(axis=1)
    out = {}
    for name in ("outboard", "field_spacecraft"):
        left = (told[name].values - known[there])[good]
        out[name] = left if constants else left - left.mean(axis=0)
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


@pytest.fixture(scope="module")
def delivered(tmp_path_factory):
    """Three days in the archive, nothing learnt from them; copied, never changed."""
    settings = DualSettings(days=3, seed=33, overrides=COARSE)
    return workspace(tmp_path_factory.mktemp("delivered") / "w", settings)[2]


def daily(delivered, folder, workers, start=None):
    """Three days learnt from one by one, all or from one on."""
    shutil.copytree(delivered.root, folder)
    made = Workspace.open(folder)
    cat, mission = Catalog(folder), made.mission()
    settings = ReprocessSettings(table="daily", batch_days=1)
    with threads(workers) as mapper:
        return cat, mission, made, reprocess(cat, mission, start=start, settings=settings, mapper=mapper)


@contextmanager
def threads(workers):
    """Yield a mapper that works on several windows at once and finishes the last ones first."""
    with ThreadPoolExecutor(workers) as pool:

        def mapper(_, work, arguments):
            futures = [pool.submit(work, *one) for one in reversed(list(arguments))]
            return [one.result() for one in reversed(futures)]

        yield mapper


@pytest.fixture(scope="module")
def three(delivered, tmp_path_factory):
    return daily(delivered, tmp_path_factory.mktemp("three") / "w", 2)


def tables_of(cat):
    return [cat.table("main-states", f"2006-05-{day}") for day in (14, 15, 16)]


def test_the_plan_of_a_backfill_counts_what_would_be_made(three, tmp_path):
    _, _, made, _ = three
    span = ("2006-05-14", "2006-05-18")
    told = plan_span(made, *span, {"table": "daily"})
    assert told["days"] == {"planned": 0, "unchanged": 3, "no_work": 1}
    # Windows of another length are other tables: all is to be made.
    assert plan_span(made, *span, {"table": "span"})["days"]["planned"] == 3
    shutil.copytree(made.root, tmp_path / "w")
    copied = Workspace.open(tmp_path / "w")
    simulate(DualSettings(days=4, seed=33, overrides=COARSE), copied.data, workers=1)
    cat, mission = Catalog(copied.root), copied.mission()
    assert ingest(cat, mission, copied.data).days["failed"] == 0
    told = plan_span(copied, *span, {"table": "daily"})
    done = reprocess(cat, mission, *span, settings=ReprocessSettings(table="daily"))
    assert told["days"]["planned"] == done.days["done"] >= 1
    assert told["days"]["unchanged"] == done.days["unchanged"]
    assert plan_span(copied, *span, {"table": "daily"})["days"]["planned"] == 0


def test_windows_of_a_day_learn_by_themselves(three):
    cat, _, _, report = three
    assert len(report.extra["windows"]) == 3
    assert len({one.attrs["table_id"] for one in tables_of(cat)}) == 3


def test_a_state_has_one_number_in_all_windows(three):
    cat, _, made, _ = three
    seen = {}
    for day in cat.days("l2/field", states=("published",)):
        product = cat.read(day, with_time=False)
        with xr.open_dataset(VENUS_EXPRESS.truth_path(made.data, day.day), engine="h5netcdf") as truth:
            stamps, true = truth["Epoch"].values.astype(np.int64), truth["STATE"].values
        rows = np.clip(np.searchsorted(product["tt2000"].values, stamps), 0, product.sizes["time"] - 1)
        there = product["tt2000"].values[rows] == stamps
        state = product["state"].values[rows[there]]
        pairs, count = np.unique(np.stack([true[there], state])[:, state >= 0], axis=1, return_counts=True)
        for (code, number), many in zip(pairs.T.tolist(), count.tolist(), strict=True):
            seen.setdefault(code, {}).setdefault(number, 0)
            seen[code][number] += many
    # Samples at the edges of a switching are few.
    usual = {code: max(numbers, key=numbers.get) for code, numbers in seen.items()}
    assert len(set(usual.values())) == len(usual) >= 12
    wrong = sum(sum(numbers.values()) - numbers[usual[code]] for code, numbers in seen.items())
    assert wrong < 0.005 * sum(sum(numbers.values()) for numbers in seen.values())


def test_the_field_goes_on_where_the_next_window_begins(three):
    cat, _, made, _ = three
    told = ("states", "combined")
    by_states = {one.attrs["table_id"] for one in tables_of(cat) if one.attrs["method"] in told}
    constant, references = [], set()
    for day in cat.days("l2/field", states=("published",)):
        table = cat.table("main-states", str(day.day))
        # A gradiometer's constant is its own.
        if table.attrs["table_id"] in by_states:
            found, _ = errors(cat, made, day, constants=True)
            constant.append(found["field_spacecraft"].mean(axis=0))
            references.add(table.attrs["reference"])
    assert len(constant) >= 2
    assert len(references) == 1
    # Windows that are not joined step by one to three nT here.
    assert np.ptp(constant, axis=0).max() < 0.25


def test_units_of_all_windows_are_named_together(three):
    cat, mission, _, _ = three
    units = named_units(cat, mission, "main", None, None)
    named = sorted(one["channels"][0] for one in units if one["channels"])
    assert named == ["camera_current", "spectrometer_current", "transmitter_current"]
    # The last of the windows that knew the unit tells its vector.
    assert all(len(one["difference_nT"]) == 3 for one in units if one["channels"])


def test_windows_learnt_from_one_by_one_are_the_same(delivered, three, tmp_path):
    cat, _, _, _ = three
    other, _, _, _ = daily(delivered, tmp_path / "w", 1)
    for one, two in zip(tables_of(cat), tables_of(other), strict=True):
        assert set(one) == set(two)
        for name in one.variables:
            np.testing.assert_array_equal(one[name].values, two[name].values)
    for day, same in zip(*(c.days("l2/field", states=("published",)) for c in (cat, other)), strict=True):
        assert cat.read(day)["field_spacecraft"].equals(other.read(same)["field_spacecraft"])


def test_windows_are_not_learnt_from_again_when_the_one_before_them_is(delivered, three, tmp_path):
    cat, mission, _, _ = three
    other, _, _, _ = daily(delivered, tmp_path / "w", 1, start="2006-05-15")
    settings, learnt = ReprocessSettings(table="daily", batch_days=1), []

    def mapper(stage, work, arguments):
        arguments = list(arguments)
        learnt.extend(one[3][0] for one in arguments if stage == "calibrate")
        return [work(*one) for one in arguments]

    assert reprocess(other, mission, settings=settings, mapper=mapper).exit_code == 0
    # Only the day that was not there; what comes after it is joined to it.
    assert learnt == [np.datetime64("2006-05-14")]
    for one, two in zip(tables_of(cat), tables_of(other), strict=True):
        np.testing.assert_array_equal(one["number"].values, two["number"].values)
        np.testing.assert_array_equal(one["correction"].values, two["correction"].values)
    learnt.clear()
    again = reprocess(other, mission, start="2006-05-15", settings=settings, mapper=mapper)
    assert (again.days["unchanged"], again.days["done"], learnt) == (2, 0, [])


@pytest.fixture(scope="module")
def commissioned(tmp_path_factory):
    """Two days learnt from one by one; the ambient field is known in the first."""
    settings = DualSettings(days=2, seed=37, include=("monitor",), overrides=COARSE)
    cat, mission, made = workspace(tmp_path_factory.mktemp("known") / "w", settings)
    return cat, made, reprocess(cat, mission, settings=ReprocessSettings(table="daily"))


def test_a_known_ambient_field_tells_the_constant_part_and_later_windows_take_it_over(commissioned):
    cat, made, report = commissioned
    assert report.exit_code == 0
    first, second = (cat.table("main-states", f"2006-05-{day}") for day in (14, 15))
    assert (first.attrs["constant_known"], first.attrs["carried"]) == (1, 0)
    assert (second.attrs["constant_known"], second.attrs["carried"]) == (1, 1)
    for day, table in zip(cat.days("l2/field", states=("published",)), (first, second), strict=True):
        product = cat.read(day, with_time=False)
        with xr.open_dataset(VENUS_EXPRESS.truth_path(made.data, day.day), engine="h5netcdf") as truth:
            stamps, stray = truth["Epoch"].values.astype(np.int64), truth["STRAY_OUT"] + truth["OFFSET_OUT"]
            true = stray.values
        rows = np.clip(np.searchsorted(product["tt2000"].values, stamps), 0, product.sizes["time"] - 1)
        state = product["state"].values[rows]
        good = (product["tt2000"].values[rows] == stamps) & np.isin(state, table["number"].values)
        error = (product["correction"].values[rows] - true)[good].mean(axis=0)
        sigma = product["uncertainty"].values[rows][good]
        assert np.all(np.abs(error) < 3.0 * sigma.max(axis=0))
        # The offset and the state that is on for longest are in it: much more than its error.
        assert sigma.max() < 0.5 < np.abs(true[good].mean(axis=0)).max()
        applied = product.attrs["applied"] == "yes"
        assert product.attrs["constant_known"] == ("yes" if applied else "no")


def test_a_day_without_the_monitor_has_a_product_all_the_same(commissioned):
    _, _, report = commissioned
    assert (report.days["done"], report.days["failed"]) == (2, 0)


def test_a_spacecraft_that_switches_nothing_is_left_alone(tmp_path, capsys):
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
    assert product.attrs["constant"] == "as measured"
    read = np.isfinite(product["outboard"].values).all(axis=1)
    assert ((product["flag"].values[read] & np.uint32(Flag.NOT_CORRECTED)) != 0).all()
    # Nobody need open the product to learn of it.
    fields = compare(cat, mission).as_json()
    assert "LEFT AS MEASURED" in " ".join(fields["verdict"]["told"])
    with pytest.raises(SystemExit):
        main(["catalog", "show", "l2/field", "-w", str(tmp_path / "w")])
    assert "left as measured" in " ".join(capsys.readouterr().out.split())
