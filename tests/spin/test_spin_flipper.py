"""A mission whose sensors are flipped: no window holds two positions, and both parts come out of it."""

from pathlib import Path

import numpy as np
import pytest

from inflight.catalog import Catalog, Workspace
from inflight.flags import Flag
from inflight.mission import Mission
from inflight.simulate.spinning import SpinningSettings
from inflight.spin import PARAMETER_NAMES
from inflight.tasks.archive import ingest, simulate, split_at_flips
from inflight.tasks.archive.samples import flip_flags, longest_position, position_edges
from inflight.tasks.pipelines import reprocess
from inflight.time import day_bounds, to_tt2000

FLIPS = """events:
  - {at: 2012-03-02T14:24:00Z, name: out, kind: flip}
  - {at: 2012-03-04T07:12:00Z, name: back, kind: flip_back}
"""


def days(*numbers):
    return [np.datetime64(f"2012-03-{number:02d}") for number in numbers]


@pytest.fixture(scope="module")
def mission():
    return Mission.parse(imp8_text() + FLIPS)


def imp8_text():
    return (Path(__file__).parents[2] / "missions" / "imp8.yaml").read_text(encoding="utf-8")


def flipped_workspace(folder, offset, events=FLIPS):
    """Four days with a flip and one back, offsets of the sensors of either sign."""
    blank = Workspace.create(folder / "blank", "imp8")
    models = folder / "yaml" / "models"
    models.mkdir(parents=True)
    name = "imp8-preflight.yaml"
    (models / name).write_text((blank.root / "models" / name).read_text(encoding="utf-8"), encoding="utf-8")
    source = folder / "yaml" / "imp8.yaml"
    source.write_text(imp8_text() + events, encoding="utf-8")
    settings = SpinningSettings(
        craft="imp8",
        days=4,
        seed=9,
        include=("flipper",),
        without=("zero_drift",),
        overrides={"flips": [1.6, 3.3], "offset": offset},
    )
    made = Workspace.create(folder / "flipped", source)
    simulate(settings, made.data, workers=1)
    cat, known = Catalog(made.root), made.mission()
    ingest(cat, known, made.data)
    return cat, settings.parameters, reprocess(cat, known)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [[3.2, -4.1, 1.7], [-1.9, 2.3, -2.4]])
def test_sensors_and_spacecraft_come_apart_in_a_certified_table(tmp_path, offset):
    cat, parameters, report = flipped_workspace(tmp_path, offset)
    assert report.days["done"] == 4
    assert "left_out" not in report.extra
    table = cat.table("main-flipper", "2012-03-03")
    assert table.sizes["interval"] == 2
    assert table["end"].values[0] == table["start"].values[1] == to_tt2000(np.datetime64("2012-03-04T07:12"))
    field = parameters.spacecraft_field
    truth = np.array([offset[0], offset[2], field[0], field[2]])
    pulls = (table["value"].values - truth) / table["sigma"].values
    assert np.abs(pulls).max() < 4.0
    assert table["sigma"].values.max() < 0.3
    window = cat.table("main-window", "2012-03-03")
    assert window.sizes["interval"] == 3
    x = list(PARAMETER_NAMES).index("offset[1]")
    expected = [offset[0] + field[0], offset[2] + field[0], offset[0] + field[0]]
    assert np.all(np.abs(window["value"].values[:, x] - expected) < 4 * window["sigma"].values[:, x])
    for day in cat.days("l2/field", states=("published",)):
        product = cat.read(day)
        lost = (product["flag"].values & np.uint32(Flag.FLIPPED)) > 0
        assert lost.any() == (str(day.day) in ("2012-03-02", "2012-03-04"))
        assert np.isnan(product["field_payload"].values[lost]).all()


@pytest.mark.slow
def test_one_position_alone_is_told_and_makes_no_table(tmp_path):
    late = "events: [{at: 2012-03-20T00:00:00Z, name: out, kind: flip}]\n"
    blank = flipped_workspace(tmp_path, [3.2, -4.1, 1.7], late)
    cat, _, report = blank
    assert "no day on one side" in report.extra["left_out"]["flipper"]
    assert not cat.tables("main-flipper")


def test_a_day_is_calibrated_for_the_position_that_holds_longest(mission):
    second, fourth = days(2, 4)
    assert longest_position(mission, second) == (
        day_bounds(second)[0],
        to_tt2000(np.datetime64("2012-03-02T14:24")),
    )
    assert longest_position(mission, fourth)[1] == day_bounds(fourth)[1]
    start, end = day_bounds(second)
    stamps = np.arange(start, end, 10**11, dtype=np.int64)
    flagged = flip_flags(mission, second, stamps) > 0
    assert flagged.mean() == pytest.approx(0.4, abs=0.01)
    assert not flagged[: len(flagged) // 2].any()
    assert not flip_flags(mission, days(3)[0], stamps + end - start).any()


def test_no_window_holds_two_positions(mission):
    assert position_edges(mission) == days(3, 4)
    assert split_at_flips(days(1, 16), mission) == days(1, 3, 4, 16)
    assert split_at_flips(days(5, 20), mission) == days(5, 20)
