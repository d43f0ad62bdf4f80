"""Every day whose fields were measured gets its product, whatever housekeeping is missing."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from heated_mission import HEATED_DAYS, HEATER_FIELD, HOUSEKEEPING, deliver_heated_day, heater_field
from tiny_mission import TINY_GAIN, TINY_OFFSET, TINY_YAML, tiny_readings

from inflight.catalog import Catalog, Workspace
from inflight.flags import Flag
from inflight.tasks import RunReport
from inflight.tasks.analysis import compare
from inflight.tasks.archive import ArchiveIndex, ingest, needs_of, substitution_problems
from inflight.tasks.pipelines import ReprocessSettings, reprocess

MODEL = f"""\
model: start
mission: tiny
effects:
  - effect: vector_sensor
    sensor: turning
    scale_factor: {{time: block, sigma: 0.01}}
    misalignment: {{time: block, sigma: 1.0}}
    offset: {{time: block, sigma: 200.0}}
  - effect: channel_field
    name: heater
    sensor: turning
    channel: heater_current
    coefficient: {{unit: nT/A, value: {HEATER_FIELD.tolist()}}}
"""
WINDOW, DAILY = ReprocessSettings(), ReprocessSettings(table="daily")
#: Rows of a day's housekeeping that are kept; all of them unless told.
Kept = dict[int, slice | None]


class Heated:
    """A workspace of days with a heater that the model knows; housekeeping is delivered in part."""

    def __init__(self, root: Path, kept: Kept) -> None:
        source = root.parent / "heated.yaml"
        source.parent.mkdir(parents=True, exist_ok=True)
        text = TINY_YAML.replace("comparisons:", HOUSEKEEPING) + "preflight: start.yaml\n"
        source.write_text(text, encoding="utf-8")
        (source.parent / "start.yaml").write_text(MODEL, encoding="utf-8")
        self.place = Workspace.create(root, source)
        for index in range(len(HEATED_DAYS)):
            self.deliver(index, kept.get(index, slice(None)))
        self.take_in()

    def deliver(self, index: int, rows: slice | None) -> None:
        """Deliver a day with some rows of its housekeeping, or without the file."""
        day = HEATED_DAYS[index]
        deliver_heated_day(self.place.data, day, heater_field)
        power = self.place.data / f"power_{day.replace('-', '')}.csv"
        if rows is None:
            power.unlink()
            return
        head, *lines = power.read_text(encoding="utf-8").splitlines()
        power.write_text("\n".join([head, *lines[rows]]) + "\n", encoding="utf-8")

    def take_in(self) -> None:
        self.cat, self.mission = Catalog(self.place.root), self.place.mission()
        ingest(self.cat, self.mission, self.place.data)

    def run(self, settings: ReprocessSettings = WINDOW) -> RunReport:
        return reprocess(self.cat, self.mission, settings=settings)

    def product(self, index: int) -> xr.Dataset:
        return self.cat.read_day("l2/field", HEATED_DAYS[index])

    def days(self) -> list:
        return self.cat.days("l2/field", states=("published",))

    def error(self, index: int) -> np.ndarray:
        """Return product less truth, nT; the truth is what the instrument was in before its noise."""
        _, reading, _ = tiny_readings(HEATED_DAYS[index])
        return self.product(index)["field_sensor"].values - (reading - TINY_OFFSET) / TINY_GAIN


def flagged(product: xr.Dataset) -> np.ndarray:
    return product["flag"].values & np.uint32(Flag.CHANNEL_MISSING) != 0


@pytest.fixture(scope="module")
def complete(tmp_path_factory) -> Heated:
    made = Heated(tmp_path_factory.mktemp("complete") / "w", {})
    made.run(DAILY)
    return made


@pytest.fixture(scope="module")
def holed(tmp_path_factory) -> Heated:
    """The second day without its file, the last one with the first half of its rows."""
    made = Heated(tmp_path_factory.mktemp("holed") / "w", {1: None, 3: slice(0, 720)})
    made.report = made.run()
    return made


def test_a_day_without_its_housekeeping_file_gets_a_product(holed):
    assert holed.report.days == {"planned": 4, "done": 4, "unchanged": 0, "failed": 0, "no_work": 0}
    assert holed.report.exit_code == 0
    product = holed.product(1)
    assert product.sizes["time"] == 1440
    assert flagged(product).all()
    assert np.isfinite(product["field_sensor"].values).all()
    assert np.isfinite(product["uncertainty"].values).all()


def test_the_error_is_within_the_widened_uncertainty_and_was_not_within_the_plain_one(holed):
    plain = np.median(holed.product(0)["uncertainty"].values, axis=0)
    for index, rows in ((1, slice(None)), (3, slice(720, None))):
        error, sigma = holed.error(index)[rows], holed.product(index)["uncertainty"].values[rows]
        ratio = np.sqrt(np.mean(error**2, axis=0)) / np.sqrt(np.mean(sigma**2, axis=0))
        # The heater does nothing on y: there the product is as good as ever.
        assert (ratio < 1.2).all()
        assert (ratio[[0, 2]] > 0.7).all()
        assert (np.sqrt(np.mean(error**2, axis=0)) / plain)[[0, 2]].min() > 3
        assert sigma[:, 1] == pytest.approx(plain[1], rel=0.05)


def test_the_typical_value_is_the_days_own_or_that_of_the_days_beside(holed):
    told = {str(day.day): day.report.get("stand_ins") for day in holed.days()}
    assert told[HEATED_DAYS[0]] is None
    assert told[HEATED_DAYS[2]] is None
    for index, count, instead in (
        (1, 1440, f"mean of {HEATED_DAYS[0]} and {HEATED_DAYS[2]}"),
        (3, 720, "mean of the day"),
    ):
        assert told[HEATED_DAYS[index]] == {
            "heater": {"samples": count, "channels": ["heater_current"], "instead": instead}
        }


def test_the_catalog_names_the_days_and_their_cause(holed):
    by_day = {str(day.day): day for day in holed.days()}
    assert [by_day[day].cause for day in HEATED_DAYS] == ["", "partial", "", "partial"]
    assert by_day[HEATED_DAYS[1]].message.startswith("heater: 1440 samples without heater_current")
    problems = substitution_problems(holed.days())
    assert [item["day"] for item in problems] == [HEATED_DAYS[1], HEATED_DAYS[3]]
    assert {(item["cause"], item["channel"]) for item in problems} == {("partial", "heater_current")}
    assert RunReport("reprocess", days={"done": 4}, problems=problems).exit_code == 0


def test_samples_without_a_channel_are_in_no_fit_and_in_no_size_of_the_residual(holed):
    used = {str(day.day): day.report["used"] for day in holed.cat.days("equations/main/base")}
    assert used == {HEATED_DAYS[0]: 1440, HEATED_DAYS[1]: 0, HEATED_DAYS[2]: 1440, HEATED_DAYS[3]: 720}
    report = compare(holed.cat, holed.mission)
    assert report.after.count == 1440 + 1440 + 720
    assert report.after.rms < 0.1
    table = holed.cat.table_by_id(holed.cat.tables("main-window")[-1].id)
    assert table["determined"].values.all()
    assert table["blocks"].values.tolist() == [3]


def test_complete_days_are_what_they_are_without_a_holed_one_beside_them(complete, tmp_path):
    other = Heated(tmp_path / "w", {1: None})
    other.run(DAILY)
    for index in (0, 2, 3):
        xr.testing.assert_identical(
            other.product(index).drop_attrs(deep=False), complete.product(index).drop_attrs(deep=False)
        )
    prior = other.product(1)
    assert (prior["flag"].values & np.uint32(Flag.PRIOR_PARAMETERS) != 0).all()
    assert (np.abs(other.error(1)) < 3 * prior["uncertainty"].values).all()


def test_a_mission_without_any_housekeeping_says_that_it_does_not_know_how_wrong_it_is(tmp_path):
    made = Heated(tmp_path / "w", dict.fromkeys(range(4)))
    assert made.run().days["done"] == 4
    product = made.product(2)
    assert flagged(product).all()
    assert np.isfinite(product["field_sensor"].values).all()
    assert np.isnan(product["uncertainty"].values).all()
    told = made.days()[2].report["stand_ins"]["heater"]
    assert told["instead"] == "left out"
    assert compare(made.cat, made.mission).after.count == 0


def test_the_first_day_may_be_the_one_without_housekeeping(tmp_path):
    made = Heated(tmp_path / "w", {0: None})
    made.run()
    assert compare(made.cat, made.mission).after.rms < 0.1
    assert made.days()[0].report["stand_ins"]["heater"]["instead"] == f"mean of {HEATED_DAYS[1]}"


def test_housekeeping_that_comes_later_makes_its_day_anew(tmp_path):
    made = Heated(tmp_path / "w", {1: None})
    made.run(DAILY)
    assert made.run(DAILY).days["unchanged"] == 4
    made.deliver(1, slice(None))
    made.take_in()
    again = made.run(DAILY)
    assert (again.days["done"], again.days["unchanged"]) == (1, 3)
    assert not flagged(made.product(1)).any()
    assert np.abs(made.error(1)).max() < 0.5


def test_a_neighbour_that_comes_later_changes_what_stands_in(tmp_path):
    made = Heated(tmp_path / "w", {1: None, 2: None})
    made.run(DAILY)
    before = made.product(1)["field_sensor"].values
    made.deliver(2, slice(None))
    made.take_in()
    assert made.run(DAILY).days["done"] == 2
    told = made.days()[1].report["stand_ins"]["heater"]
    assert told["instead"] == f"mean of {HEATED_DAYS[0]} and {HEATED_DAYS[2]}"
    assert not np.array_equal(made.product(1)["field_sensor"].values, before)
    assert {f"{HEATED_DAYS[0]}", f"{HEATED_DAYS[2]}"} <= parents_of(made, 1)


def parents_of(made: Heated, index: int) -> set[str]:
    """Return the days of the housekeeping a product was made from."""
    edges = made.cat.lineage(made.days()[index].id)
    power = {day.id: str(day.day) for day in made.cat.days("l1/power")}
    return {power[edge.parent] for edge in edges if edge.parent in power}


def test_the_span_asked_for_does_not_change_what_stands_in(holed, tmp_path):
    made = Heated(tmp_path / "w", {1: None, 3: slice(0, 720)})
    reprocess(made.cat, made.mission, HEATED_DAYS[1], HEATED_DAYS[2], DAILY)
    (alone,) = made.days()
    assert alone.report["stand_ins"]["heater"]["instead"] == f"mean of {HEATED_DAYS[0]} and {HEATED_DAYS[2]}"


def test_a_worker_is_sent_the_days_that_stand_in(holed):
    needs = needs_of(holed.mission, holed_model(holed))
    marked = [
        need if need.name != "heater_current" else type(need)(**{**vars(need), "replaceable": True})
        for need in needs
    ]
    index = ArchiveIndex.of(holed.cat, marked)
    (heater,) = index.replaceable
    day = np.datetime64(HEATED_DAYS[1])
    for known in (index, index.around([day])):
        assert [str(one.day) for one in known.typical_days(heater, day)] == [HEATED_DAYS[0], HEATED_DAYS[2]]


def holed_model(made: Heated):
    from inflight.tasks import current_model

    return current_model(made.cat, made.mission).model
