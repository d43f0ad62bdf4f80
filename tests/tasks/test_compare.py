"""The comparison of model and measurement: its numbers, its JSON, its page, in a real browser too."""

import json
import shutil
import subprocess

import numpy as np
import pytest
from tiny_mission import TINY_START, TINY_YAML, deliver_tiny_day

from inflight.catalog import Catalog, Workspace
from inflight.errors import CatalogError
from inflight.flags import Flag
from inflight.tasks import to_json
from inflight.tasks.analysis import compare
from inflight.tasks.archive import ingest
from inflight.tasks.pipelines import blocks_of, reprocess
from inflight.tasks.pipelines.scalar import compare as module
from inflight.tasks.pipelines.scalar import compare_page
from inflight.time import day_bounds

NO_MEASUREMENT = (
    Flag.VECTOR_MISSING
    | Flag.SCALAR_MISSING
    | Flag.CHANNEL_MISSING
    | Flag.OUT_OF_RANGE
    | Flag.INSTRUMENT_FLAG
)
THANKS = "Thanks to <everyone> & all"
DAYS = [str(day) for day in np.datetime64(TINY_START, "D") + np.arange(4)]


def write_yaml(folder):
    yaml = folder / "tiny.yaml"
    yaml.write_text(TINY_YAML + f"acknowledgement: '{THANKS}'\n", encoding="utf-8")
    return yaml


def made(folder, days, rows=1440):
    """Return catalog and mission of a workspace with so many calibrated days of so many rows."""
    place = Workspace.create(folder / "tiny", write_yaml(folder))
    for day in days:
        deliver_tiny_day(place.data, day)
    for path in place.data.iterdir():
        lines = path.read_text(encoding="utf-8").splitlines()[: rows + 1]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    catalog, mission = Catalog(place.root), place.mission()
    assert ingest(catalog, mission, place.data).exit_code == 0
    assert reprocess(catalog, mission).exit_code == 0
    return catalog, mission


@pytest.fixture(scope="module")
def four_days(tmp_path_factory):
    return made(tmp_path_factory.mktemp("four"), DAYS)


@pytest.fixture(scope="module")
def short_day(tmp_path_factory):
    """One day of forty samples: too few for a spectrum, for blocks and for most parameters."""
    return made(tmp_path_factory.mktemp("short"), DAYS[:1], rows=40)


@pytest.fixture(scope="module")
def pages(four_days, short_day, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    return {
        name: (compare(*given, output=folder / name), folder / name)
        for name, given in (("four.html", four_days), ("short.html", short_day))
    }


def residuals(catalog, days):
    """Return the residuals before and after by a plain read of the products."""
    products = [catalog.read_day("l2/field", day) for day in days]
    bad = [product["flag"].values & np.uint32(NO_MEASUREMENT) != 0 for product in products]
    return [
        [np.where(out, np.nan, product[name].values) for product, out in zip(products, bad, strict=True)]
        for name in ("residual_preflight", "residual")
    ]


def test_the_numbers_are_those_of_a_direct_computation(four_days):
    catalog, mission = four_days
    report = compare(catalog, mission)
    before, after = residuals(catalog, DAYS)
    for size, parts in ((report.before, before), (report.after, after)):
        whole = np.concatenate(parts)
        assert size.count == np.isfinite(whole).sum() == 4 * 1440
        assert size.rms == pytest.approx(np.sqrt(np.nanmean(whole**2)), rel=1e-12)
        assert size.std == pytest.approx(np.nanstd(whole), rel=1e-9)
        assert size.mean == pytest.approx(np.nanmean(whole), rel=1e-9, abs=1e-12)
    assert [entry["day"] for entry in report.by_day] == DAYS
    assert [entry["after_nT"] for entry in report.by_day] == pytest.approx(
        [np.sqrt(np.nanmean(part**2)) for part in after], rel=1e-12
    )
    # Both sensors have white noise of 0.05 nT on every axis, and nothing else is left.
    assert report.floor.level_nT == pytest.approx(np.hypot(0.05, 0.05), rel=0.1)
    assert report.floor.low_nT < np.hypot(0.05, 0.05) < report.floor.high_nT
    assert report.after.rms == pytest.approx(np.hypot(0.05, 0.05), rel=0.05)


def test_a_failed_reading_counts_for_neither_report_and_the_clock_begins_at_midnight(tmp_path):
    """A day that begins at six, with a scalar reading of zero: compare and reprocess tell one number."""
    place = Workspace.create(tmp_path / "tiny", write_yaml(tmp_path))
    for day in DAYS[:2]:
        deliver_tiny_day(place.data, day)
    for path in place.data.iterdir():
        lines = path.read_text(encoding="utf-8").splitlines()
        path.write_text("\n".join([lines[0], *lines[361:]]) + "\n", encoding="utf-8")
    scalar = next(path for path in sorted(place.data.iterdir()) if path.name.startswith("absolute"))
    lines = scalar.read_text(encoding="utf-8").splitlines()
    lines[500] = lines[500].split(",")[0] + ",0.0"
    scalar.write_text("\n".join(lines) + "\n", encoding="utf-8")
    catalog, mission = Catalog(place.root), place.mission()
    ingest(catalog, mission, place.data)
    told = reprocess(catalog, mission).extra["residual"]
    report = compare(catalog, mission)
    assert report.skipped == 1
    assert told["after_nT"] == pytest.approx(report.after.rms, rel=1e-12)
    assert told["before_nT"] == pytest.approx(report.before.rms, rel=1e-12)
    days = catalog.days("l2/field", states=("published",))
    digest = module.digest_days(catalog, mission, "main", days, lambda stage, done, total: None)
    # The middle of the first minute after six.
    assert [float(row["time of day"][0]) for row in digest.rows] == pytest.approx([6 + 0.5 / 60] * 2)


def test_the_json_has_the_promised_shape(four_days):
    told = json.loads(to_json(compare(*four_days).as_json()))
    assert {"command", "run", "context", "residual", "by_day", "fails_where"} <= set(told)
    assert told["command"] == "compare"
    assert {"before_nT", "after_nT", "noise_floor_nT"} <= set(told["residual"])
    assert told["residual"]["after_nT"] < told["residual"]["before_nT"] / 100
    for entry in told["fails_where"]:
        assert set(entry) == {"coordinate", "amplitude_nT", "sigma_nT", "sentence"}
    assert told["path"] == ""
    assert told["block"] == "3 h"
    low, high = told["residual"]["noise_floor_interval_nT"]
    assert low < told["residual"]["noise_floor_nT"] < high
    wander = told["parameters"]["wander"]
    assert len(wander) == 9
    assert all(0.2 < one["ratio"] < 3.0 for one in wander if one["ratio"] is not None)
    for line in told["spectrum_lines"]:
        assert {"period_s", "label", "known", "amplitude_nT", "sigma_nT", "axis"} <= set(line)


def test_blocks_are_days_as_soon_as_there_are_enough():
    stamps = np.concatenate([sum(day_bounds(day)) // 2 + np.arange(3) for day in DAYS]).astype(float)
    block, name = blocks_of(stamps, 10)
    assert name == "day"
    assert np.array_equal(block - block[0], np.repeat(np.arange(4), 3))
    block, name = blocks_of(np.arange(0, 7 * 3600, 600) * 1e9, 9)
    assert name == "3 h"
    assert np.unique(block).size == 3


def test_the_catalog_is_asked_once_an_instrument(four_days, monkeypatch):
    catalog, mission = four_days
    asked = []
    days = Catalog.days
    monkeypatch.setattr(
        Catalog, "days", lambda self, name, *a, **k: asked.append(name) or days(self, name, *a, **k)
    )
    monkeypatch.setattr(Catalog, "current", lambda *_: pytest.fail("one query a channel"))
    compare(catalog, mission)
    assert len(asked) == len(set(asked))


def test_a_span_is_half_open_and_one_without_products_is_an_error(four_days):
    report = compare(*four_days, start=DAYS[1], end=DAYS[3])
    assert [entry["day"] for entry in report.by_day] == DAYS[1:3]
    with pytest.raises(CatalogError, match="no published days") as caught:
        compare(*four_days, start="2030-01-01", end="2030-02-01")
    assert "reprocess" in caught.value.remedy


def test_a_day_too_short_for_a_spectrum_is_told_without_one(short_day):
    told = json.loads(to_json(compare(*short_day).as_json()))
    assert told["residual"]["noise_floor_nT"] is None
    assert told["residual"]["after"]["count"] == 40
    assert told["fails_where"] == []
    assert len(told["parameters"]["determined"]) < 9


def test_an_injected_error_shows_where_the_model_fails(four_days, monkeypatch):
    """A residual that follows the field's direction is what is said first."""
    catalog, mission = four_days
    read, along = Catalog.read, []

    def with_structure(self, day, variables=None, **options):
        product = read(self, day, variables, **options)
        if day.dataset == "l2/field":
            field = product["field_sensor"].values
            along.append(field[:, 0] / np.linalg.norm(field, axis=1))
            product["residual"] = product["residual"] + 0.3 * along[-1]
        return product

    monkeypatch.setattr(Catalog, "read", with_structure)
    report = compare(catalog, mission)
    first = report.fails_where[0]
    assert first.coordinate == "field direction x"
    assert first.amplitude == pytest.approx(0.3 * np.concatenate(along).std(), rel=0.05)
    assert first.amplitude > 5 * first.sigma
    assert first.axis == "x"
    assert "field direction x" in first.sentence
    assert "along x" in first.sentence


@pytest.mark.parametrize("name", ["four.html", "short.html"])
def test_the_page_shows_numbers_and_thanks(pages, name):
    report, path = pages[name]
    page = path.read_text(encoding="utf-8")
    assert report.path == path
    assert "Thanks to &lt;everyone&gt; &amp; all" in page
    assert THANKS not in page
    assert f"{report.after.rms:.4f}" in page
    assert DAYS[0] in page
    assert list(path.parent.glob(".*")) == []


def test_a_page_that_cannot_be_made_leaves_the_old_one(four_days, pages, monkeypatch):
    _, path = pages["four.html"]
    before = path.read_bytes()

    def refuse(*_arguments):
        raise OSError("no space left")

    monkeypatch.setattr("inflight.figures.html_page", refuse)
    with pytest.raises(OSError, match="no space"):
        compare(*four_days, output=path)
    assert path.read_bytes() == before
    assert sorted(item.name for item in path.parent.iterdir()) == ["four.html", "short.html"]


def test_what_is_kept_of_a_mission_is_bounded(four_days, monkeypatch):
    catalog, mission = four_days
    monkeypatch.setattr(module, "COMPARE_SETTINGS", module.CompareSettings(most_rows=2_000))
    days = catalog.days("l2/field", states=("published",)) * 50
    digest = module.digest_days(catalog, mission, "main", days, lambda stage, done, total: None)
    assert sum(row["after"].size for row in digest.rows) <= 2_000 + len(days)
    assert len(digest.power) == 1
    assert next(iter(digest.power.values())).stretches == 200


def test_a_browser_is_given_no_more_points_than_it_can_draw():
    rows = 400_001
    given = {name: np.arange(float(rows)) for name in ("tt2000", "after", "low", "high")}
    given["after"][7] = np.nan
    time, mean, low, high = compare_page.thin_series(given)
    assert time.size == mean.size == low.size == high.size <= 20_000
    assert high[-1] == rows - 1
    assert low[0] == 0
    assert (low <= mean).all()
    assert (mean <= high).all()


@pytest.mark.parametrize("name", ["four.html", "short.html"])
def test_a_real_browser_draws_the_page_without_an_error_and_without_a_network(pages, tmp_path, name):
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no chromium or chrome on the path")
    _, path = pages[name]
    picture = tmp_path / "page.png"
    told = subprocess.run(
        [
            browser,
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--enable-logging=stderr",
            "--host-resolver-rules=MAP * ~NOTFOUND",
            f"--user-data-dir={tmp_path / 'profile'}",
            "--virtual-time-budget=8000",
            "--window-size=1250,1500",
            f"--screenshot={picture}",
            path.resolve().as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    console = [line for line in told.stderr.splitlines() if "CONSOLE" in line]
    assert any("document idle" in line for line in console), told.stderr[-2000:]
    assert [line for line in console if "INFO:CONSOLE" not in line or "rror" in line] == []
    assert picture.stat().st_size > 50_000
