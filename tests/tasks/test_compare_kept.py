"""What a comparison keeps of blocks of days: read again, made again when inputs change, the same anywhere."""

import json
import shutil

import numpy as np
import pytest
from tiny_mission import TINY_START, TINY_YAML, deliver_tiny_day

from inflight.catalog import Catalog, Workspace
from inflight.flows import dask_client
from inflight.tasks import ReprocessSettings, to_json
from inflight.tasks.analysis import compare
from inflight.tasks.archive import ingest
from inflight.tasks.models import current_model
from inflight.tasks.pipelines import reprocess
from inflight.tasks.pipelines.base import compare_blocks
from inflight.tasks.pipelines.scalar import compare as scalar
from inflight.tasks.pipelines.scalar import compare_days

DAYS = np.datetime64(TINY_START, "D") + np.arange(20)
KEPT = "comparison/main/60s"
DAILY = ReprocessSettings(table="daily")


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """The folder of a workspace with twenty days, each calibrated by itself; copied, never changed."""
    folder = tmp_path_factory.mktemp("calibrated")
    yaml = folder / "tiny.yaml"
    yaml.write_text(TINY_YAML, encoding="utf-8")
    place = Workspace.create(folder / "tiny", yaml)
    for day in DAYS:
        deliver_tiny_day(place.data, str(day))
    catalog, mission = Catalog(place.root), place.mission()
    assert ingest(catalog, mission, place.data).exit_code == 0
    assert reprocess(catalog, mission, settings=DAILY).exit_code == 0
    return place.root


def copied(calibrated, folder):
    """Return catalog and mission of a copy of the twenty days, with which nothing was compared."""
    shutil.copytree(calibrated, folder / "tiny")
    return Catalog(folder / "tiny"), Workspace.open(folder / "tiny").mission()


@pytest.fixture(scope="module")
def twenty(calibrated, tmp_path_factory):
    return copied(calibrated, tmp_path_factory.mktemp("twenty"))


def told(catalog, mission, **options):
    return to_json(compare(catalog, mission, **options).as_json())


def whole_blocks(first, last):
    """Return the first days of the blocks of eight that lie in days both of which are in."""
    days = np.arange(first, last + 1).astype("datetime64[D]")
    starts = days[days.astype(int) % 8 == 0]
    return [day for day in starts if day + 7 <= last]


@pytest.fixture
def reads(monkeypatch):
    """Return the days of products that are read, as they are read."""
    found, read = [], Catalog.read

    def watched(self, day, *arguments, **options):
        if day.dataset == "l2/field":
            found.append(day.day)
        return read(self, day, *arguments, **options)

    monkeypatch.setattr(Catalog, "read", watched)
    return found


def test_a_second_comparison_reads_what_is_kept_and_says_the_same(twenty, reads):
    catalog, mission = twenty
    first = told(catalog, mission)
    kept = catalog.days(KEPT, states=("published",))
    assert [day.day for day in kept] == whole_blocks(DAYS[0], DAYS[-1])
    assert sorted(set(reads)) == list(DAYS)
    reads.clear()
    runs = len(catalog.runs())
    assert told(catalog, mission) == first
    inside = {day.day + step for day in kept for step in range(8)}
    assert sorted(reads) == sorted(set(DAYS) - inside)
    assert len(reads) < 16
    # Nothing to keep, no run.
    assert len(catalog.runs()) == runs
    assert catalog.verify() == []
    assert catalog.gc() == []


def test_nothing_kept_gives_the_same_to_the_last_digit(twenty, monkeypatch):
    catalog, mission = twenty
    first = told(catalog, mission)
    monkeypatch.setattr(compare_blocks, "_kept_blocks", lambda plan, blocks: {})
    monkeypatch.setattr(compare_blocks, "_run_to_keep", lambda plan, stack: None)
    assert told(catalog, mission) == first


def test_processes_say_the_same_as_one_process(twenty, reads, monkeypatch):
    catalog, mission = twenty
    first = told(catalog, mission)
    monkeypatch.setattr(compare_blocks, "_kept_blocks", lambda plan, blocks: {})
    monkeypatch.setattr(compare_blocks, "_run_to_keep", lambda plan, stack: None)
    monkeypatch.setattr(compare_blocks, "DAYS_FOR_PROCESSES", 1)
    reads.clear()
    seen = []
    with dask_client(2) as client:
        again = told(
            catalog, mission, client=client, progress=lambda stage, done, total: seen.append((done, total))
        )
    assert again == first
    assert reads == []  # all in the other processes
    assert seen[0] == (0, 20)
    assert seen[-1] == (20, 20)
    assert len(seen) > 3


def test_only_the_block_of_a_day_that_changed_is_made_again(calibrated, tmp_path, reads):
    catalog, mission = copied(calibrated, tmp_path)
    told(catalog, mission)
    before = {day.day: day.version for day in catalog.days(KEPT, states=("published",))}
    changed = next(iter(before)) + 3
    deliver_tiny_day(tmp_path / "tiny" / "data", str(changed), seed=1)
    ingest(catalog, mission, tmp_path / "tiny" / "data")
    reprocess(catalog, mission, settings=DAILY)
    reads.clear()
    told(catalog, mission)
    after = {day.day: day.version for day in catalog.days(KEPT, states=("published",))}
    assert {day for day in after if after[day] != before.get(day)} == {changed - 3}
    inside = {day + step for day in set(after) - {changed - 3} for step in range(8)}
    assert sorted(reads) == sorted(set(DAYS) - inside)


def test_what_is_kept_of_products_serves_when_a_model_comes_after_them(calibrated, tmp_path, reads):
    catalog, mission = copied(calibrated, tmp_path)
    first = compare(catalog, mission).as_json()
    model = current_model(catalog, mission, "main").model
    catalog.save_model(model.name, model.text.replace("x: 0.0", "x: 1.0"), 1)
    assert reprocess(catalog, mission, settings=DAILY).exit_code == 0
    reads.clear()
    told_then = compare(catalog, mission).as_json()
    assert told_then["against"]["rms"] == first["residual"]["without_outliers_nT"]
    inside = {day + step for day in whole_blocks(DAYS[0], DAYS[-1]) for step in range(8)}
    # Of days in no whole block the products before are read again, of the others only those of now.
    assert sorted(reads) == sorted([*DAYS, *(set(DAYS) - inside)])
    reads.clear()
    assert compare(catalog, mission).as_json() == told_then
    assert sorted(reads) == sorted([*(set(DAYS) - inside)] * 2)
    assert catalog.verify() == []
    assert catalog.gc() == []


def test_a_damaged_block_is_repaired_and_made_again(calibrated, tmp_path):
    catalog, mission = copied(calibrated, tmp_path)
    first = told(catalog, mission)
    kept = catalog.days(KEPT, states=("published",))[0]
    chunk = next((catalog.workspace / kept.segment / "rows").glob("c.*"))
    chunk.write_bytes(chunk.read_bytes()[:-3])
    assert [one.item for one in catalog.repair()] == [KEPT]
    assert told(catalog, mission) == first
    assert len(catalog.days(KEPT, states=("published",))) == len(whole_blocks(DAYS[0], DAYS[-1]))


def test_a_workspace_that_refuses_a_run_is_compared_all_the_same(calibrated, tmp_path, monkeypatch):
    from inflight.errors import StorageError

    catalog, mission = copied(calibrated, tmp_path)

    def refuse(*_arguments, **_options):
        raise StorageError("read-only")

    with monkeypatch.context() as patch:
        patch.setattr(Catalog, "run", refuse)
        first = told(catalog, mission)
    assert catalog.days(KEPT) == []
    assert told(catalog, mission) == first


def test_short_spans_are_twice_as_long_where_a_record_is(monkeypatch):
    assert scalar.span_length(1) == scalar.span_length(277) == 60.0
    assert scalar.span_length(278) == 120.0
    assert scalar.span_length(3000) == 960.0
    rows = 86_400.0 * 3000 / scalar.span_length(3000)
    assert 0.5 * scalar.COMPARE_SETTINGS.most_rows < rows <= scalar.COMPARE_SETTINGS.most_rows


def test_a_histogram_of_days_is_that_of_all_their_values():
    random = np.random.default_rng(2)
    days = [random.normal(0, 0.1, 5000), random.normal(0, 30.0, 5000), np.array([0.0, -1e9, 1e9, 2.0**-30])]
    counts = np.array([sum(map(compare_days.count_bins, days)), compare_days.count_bins(days[0])])
    for half_width in (0.013, 0.8, 77.0):
        edges, shown = compare_days.drawn_histogram(counts, half_width, 160)
        assert edges[-1] >= half_width
        assert 80 <= edges.size - 1 <= 160
        assert shown[0].tolist() == np.histogram(np.concatenate(days), edges)[0].tolist()
        assert shown[1].tolist() == np.histogram(days[0], edges)[0].tolist()


def test_a_digest_comes_back_as_it_was_kept(twenty):
    catalog, mission = twenty
    days = catalog.days("l2/field", states=("published",))[:3]
    sources = compare_blocks.Sources.of(catalog, mission, slice(None))
    made_now = compare_days.digest_block(catalog, mission, "main", sources, days, 60.0)
    again = compare_days.BlockDigest.of_dataset(made_now.as_dataset())
    assert again.days == made_now.days
    assert list(again.rows) == list(made_now.rows)
    assert all(np.array_equal(again.rows[name], made_now.rows[name], equal_nan=True) for name in again.rows)
    assert again.counts.tolist() == made_now.counts.tolist()
    for mine, theirs in ((again.power, made_now.power), (again.power_before, made_now.power_before)):
        assert list(mine) == list(theirs)
        for one, other in zip(mine.values(), theirs.values(), strict=True):
            assert one.frequency.tobytes() == other.frequency.tobytes()
            assert one.total.tobytes() == other.total.tobytes()
            assert (one.stretches, one.square.tolist()) == (other.stretches, other.square.tolist())
    assert json.dumps(again.days[0].as_list()) == json.dumps(made_now.days[0].as_list())
