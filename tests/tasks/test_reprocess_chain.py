"""Reprocessing does what is needed, no more, and the same in parallel."""

from pathlib import Path

import numpy as np
import pytest
from tiny_mission import TINY_GAIN, TINY_OFFSET, TINY_START, deliver_tiny_day, make_tiny_workspace

from inflight.catalog import Catalog, Day, Workspace
from inflight.tasks.analysis import compare
from inflight.tasks.archive import ingest
from inflight.tasks.pipelines import ReprocessSettings, reprocess

DAYS = 4
EQUATIONS, PRODUCT = "equations/main/base", "l2/field"
SPAN = ReprocessSettings(table="span", batch_days=2)
DAILY = ReprocessSettings(table="daily", batch_days=2)


class Tiny:
    """A workspace of the tiny mission, its days in the archive."""

    def __init__(self, root: Path, days: int = DAYS) -> None:
        self.root = make_tiny_workspace(root, days)
        self.take_in()

    def take_in(self) -> None:
        self.cat = Catalog(self.root)
        self.mission = Workspace.open(self.root).mission()
        ingest(self.cat, self.mission, Workspace.open(self.root).data)

    def run(self, settings: ReprocessSettings = SPAN, **options: object):
        return reprocess(self.cat, self.mission, settings=settings, **options)

    def published(self, name: str) -> dict[str, Day]:
        return {str(day.day): day for day in self.cat.days(name, states=("published",))}


def day_at(index: int) -> str:
    return str(np.datetime64(TINY_START, "D") + index)


@pytest.fixture
def tiny(tmp_path) -> Tiny:
    return Tiny(tmp_path / "tiny")


def test_the_chain_recovers_what_was_put_in(tiny):
    report = tiny.run()
    assert report.days == {"planned": 4, "done": 4, "unchanged": 0, "failed": 0, "no_work": 0}
    table = tiny.cat.table_by_id(tiny.cat.tables("main-span")[-1].id).isel(interval=0)
    value, sigma = table["value"].values, table["sigma"].values
    known = table["determined"].values
    truth = np.concatenate([1 / TINY_GAIN, [90.0] * 3, TINY_OFFSET])
    assert known.all()
    assert np.all(np.abs(value - truth) < 4.5 * sigma + 1e-9)
    assert report.extra["residual"]["before_nT"] > 100 * report.extra["residual"]["after_nT"]


def test_a_second_run_does_nothing(tiny):
    tiny.run()
    before = [tiny.published(name) for name in (EQUATIONS, PRODUCT)]
    again = tiny.run()
    assert again.days == {"planned": 4, "done": 0, "unchanged": 4, "failed": 0, "no_work": 0}
    assert [tiny.published(name) for name in (EQUATIONS, PRODUCT)] == before


def test_a_corrected_file_redoes_its_own_day_and_the_products_its_table_changes(tiny):
    tiny.run(DAILY)
    before = {name: tiny.published(name) for name in (EQUATIONS, PRODUCT)}
    deliver_tiny_day(Workspace.open(tiny.root).data, day_at(2), seed=1)
    tiny.take_in()
    report = tiny.run(DAILY)
    changed = {
        name: [day for day, record in tiny.published(name).items() if record != before[name][day]]
        for name in (EQUATIONS, PRODUCT)
    }
    assert changed == {EQUATIONS: [day_at(2)], PRODUCT: [day_at(2)]}
    assert (report.days["done"], report.days["unchanged"]) == (1, 3)
    for name in (EQUATIONS, PRODUCT):
        assert tiny.published(name)[day_at(2)].version > before[name][day_at(2)].version


def test_a_corrected_file_changes_every_product_of_a_table_for_the_whole_span(tiny):
    tiny.run()
    before = tiny.published(PRODUCT)
    deliver_tiny_day(Workspace.open(tiny.root).data, day_at(2), seed=1)
    tiny.take_in()
    report = tiny.run()
    assert report.days["done"] == 4
    assert all(record != before[day] for day, record in tiny.published(PRODUCT).items())


def stores(tiny: Tiny, name: str) -> list[tuple[str, str]]:
    """Day and the manifest of its store: sha256 of every file."""
    return [
        (str(day.day), (tiny.root / day.segment / "MANIFEST.sha256").read_text(encoding="utf-8"))
        for day in tiny.cat.days(name, states=("published",))
    ]


def test_two_processes_give_the_same_bytes_as_one(tmp_path):
    from distributed import Client, LocalCluster

    serial, parallel = Tiny(tmp_path / "serial"), Tiny(tmp_path / "parallel")
    serial.run()
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        parallel.run(client=client)
    for name in (EQUATIONS, PRODUCT):
        assert stores(parallel, name) == stores(serial, name)
        assert len(stores(serial, name)) == DAYS


def test_a_day_of_nothing_but_gaps_fails_with_a_remedy_and_stops_no_other(tmp_path):
    root = make_tiny_workspace(tmp_path / "tiny", DAYS)
    file = Workspace.open(root).data / f"turning_{day_at(1).replace('-', '')}.csv"
    rows = file.read_text(encoding="utf-8").splitlines()
    empty = [rows[0], *(row.split(",")[0] + ",nan,nan,nan" for row in rows[1:])]
    file.write_text("\n".join(empty) + "\n", encoding="utf-8")
    tiny = object.__new__(Tiny)
    tiny.root = root
    tiny.take_in()
    report = tiny.run()
    assert report.days["failed"] + report.days["no_work"] == 1
    assert report.days["done"] == 3
    problem = report.problems[0]
    assert problem["day"] == day_at(1)
    assert problem["cause"] in ("repeatable", "no_work")
    assert problem["remedy"]
    assert sorted(tiny.published(PRODUCT)) == [day_at(0), day_at(2), day_at(3)]


def test_another_model_is_a_new_context_and_redoes_everything(tiny):
    first = tiny.run()
    text = (
        "model: tiny-ideal\nmission: tiny\ncomparison: main\neffects:\n"
        "  - {effect: vector_sensor, sensor: turning, scale_factor: {time: block},"
        " misalignment: {time: block}, offset: {time: block, value: [1, 1, 1], sigma: [50, 50, 50]}}\n"
    )
    tiny.cat.save_model("tiny-ideal", text, parent=1, message="another prior")
    second = tiny.run()
    assert second.context != first.context
    assert second.days["done"] == DAYS
    assert {record.context for record in tiny.published(PRODUCT).values()} == {second.context}
    assert len(tiny.cat.models()) == 2


def test_a_mission_file_changed_back_gives_its_tables_their_validity_back(tiny):
    tiny.run(DAILY)
    first = [tiny.cat.table("main-daily", day_at(index)).attrs["table_id"] for index in range(DAYS)]
    yaml = Workspace.open(tiny.root).mission_file
    before = yaml.read_text(encoding="utf-8")
    yaml.write_text(before + "# a remark\n", encoding="utf-8")
    tiny.take_in()
    reprocess(tiny.cat, tiny.mission, day_at(1), day_at(2), DAILY)
    assert tiny.cat.table("main-daily", day_at(1)).attrs["table_id"] not in first
    yaml.write_text(before, encoding="utf-8")
    tiny.take_in()
    tiny.run(DAILY)
    assert [tiny.cat.table("main-daily", day_at(index)).attrs["table_id"] for index in range(DAYS)] == first


def test_a_span_is_half_open(tiny):
    report = reprocess(tiny.cat, tiny.mission, day_at(1), day_at(3), SPAN)
    assert report.days["done"] == 2
    assert sorted(tiny.published(PRODUCT)) == [day_at(1), day_at(2)]


def test_daily_tables_and_products_agree_on_the_residual(tiny):
    tiny.run(DAILY)
    table = tiny.cat.table_by_id(tiny.cat.tables("main-daily")[-1].id)
    for index, told in enumerate(table["after"].values):
        residual = tiny.cat.read_day(PRODUCT, day_at(index))["residual"].values
        assert float(np.nanstd(residual)) == pytest.approx(float(told), rel=0.1)


def test_products_of_a_fit_of_all_days_are_compared_without_any_other_table(tiny, tmp_path):
    report = tiny.run(ReprocessSettings(table="continuous", trend="linear", batch_days=2))
    assert report.exit_code == 0
    assert not tiny.cat.tables("main-window")
    page = tmp_path / "compare.html"
    found = compare(tiny.cat, tiny.mission, output=page).as_json()
    assert found["residual"]["after_nT"] == pytest.approx(report.extra["residual"]["after_nT"], rel=0.05)
    assert set(found["parameters"]["determined"]) >= {"vector_sensor.offset[x]"}
    assert "Parameters" in page.read_text(encoding="utf-8")
