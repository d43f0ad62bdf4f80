"""Compare of a spinning spacecraft: tones before and after, where they come from, and their fall."""

import json

import pytest

from inflight.catalog import Catalog, Workspace
from inflight.simulate.spinning import SpinningSettings
from inflight.tasks import to_json
from inflight.tasks.analysis import Workbench, compare
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.pipelines import reprocess


@pytest.fixture(scope="module")
def coil(tmp_path_factory):
    """A THEMIS-like probe with a coil that is driven at the spin and that no model knows."""
    folder = tmp_path_factory.mktemp("compare") / "coil"
    settings = SpinningSettings(craft="themis", days=2, seed=11, hide=("torquer",))
    made = Workspace.create(folder, settings.craft)
    simulate(settings, made.data, workers=1)
    cat, mission = Catalog(folder), made.mission()
    ingest(cat, mission, made.data)
    reprocess(cat, mission)
    return cat, mission, folder


@pytest.fixture(scope="module")
def without(coil):
    cat, mission, folder = coil
    return compare(cat, mission, output=folder / "before.html"), (folder / "before.html").read_text("utf-8")


def test_the_coil_shows_and_is_named(without):
    report, _ = without
    found = json.loads(to_json(report.as_json()))
    residual = found["residual"]
    assert residual["before_nT"] > 5 * residual["after_nT"] > 20 * residual["noise_floor_nT"]
    first = found["fails_where"][0]
    assert first["coordinate"] == "coil_current at the spin"
    assert "stray field of what coil_current drives" in first["sentence"]
    # What turns with the spin along z is seen by the axial sensor at the spin, 0.25 nT in 80 mA.
    largest = max(found["tones"], key=lambda one: one["after_nT"])
    assert (largest["row"], largest["harmonic"]) == ("axial", 1)


def test_the_numbers_are_those_that_reprocess_told(coil, without):
    cat, _, _ = coil
    report, _ = without
    days = cat.days("l2/field", states=("published",))
    assert [one["day"] for one in report.by_day] == [str(day.day) for day in days]
    for one, day in zip(report.by_day, days, strict=True):
        assert one["before_nT"] == pytest.approx(day.report["before_nT"], rel=1e-3)
        assert one["after_nT"] == pytest.approx(day.report["after_nT"], rel=1e-3)
        assert one["noise_floor_nT"] == pytest.approx(day.report["floor_nT"], rel=1e-3)


def test_the_page_shows_tones_and_what_they_follow(without):
    _, page = without
    for told in ("Mean turn, along the spin axis", "coil_current at the spin", "nT/mA", "spin axis (nT)"):
        assert told in page
    # Scripts in the head hold the word, too.
    assert "src=" not in page.rsplit("<body>", 1)[1]


def test_the_error_falls_when_the_coil_is_added(coil, without):
    cat, mission, _ = coil
    Workbench(cat, mission).add("channel_field(coil_current)")
    reprocess(cat, mission)
    after = compare(cat, mission)
    # What the pre-flight model left is what it was.
    assert after.before.rms == pytest.approx(without[0].before.rms, rel=1e-3)
    # Natural noise is what is left, and nothing in step with the coil.
    assert after.after.rms < 0.2 * without[0].after.rms
    assert after.after.rms < 1.5 * after.floor.level_nT
    assert not any("coil_current" in one.coordinate for one in after.fails_where)
