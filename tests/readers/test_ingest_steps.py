"""Ingest into a real catalog: idempotent, resumable, and one bad file or day never stops the others."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from reader_cases import MISSION, day_times, field_of, mission_with, write_fgm

from inflight.catalog import Catalog
from inflight.errors import MissionError, StorageError
from inflight.tasks.archive import ingest
from inflight.tasks.archive import ingestion as ingest_batch
from inflight.tasks.archive.ingestion import days_of_batch

PROBE = mission_with()
DAYS = ["2020-05-01", "2020-05-02", "2020-05-03"]


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "data"
    folder.mkdir()
    for day in DAYS:
        write_fgm(folder, day)
    return folder


@pytest.fixture
def cat(tmp_path):
    return Catalog(tmp_path / "workspace")


def versions(cat):
    return {str(day.day): day.version for day in cat.days("l1/fgm", states=["published"])}


def archive_bytes(cat, name="l1/fgm"):
    """Return content hash of every file of the published segments, by path below the run."""
    paths = {day.segment for day in cat.days(name, states=["published"])}
    return {
        path.relative_to(cat.workspace / "stores").as_posix().split("/", 1)[1]: path.read_bytes()
        for segment in paths
        for path in (cat.workspace / segment).rglob("*")
        if path.is_file()
    }


def test_days_are_published_with_coverage_and_lineage(cat, data):
    report = ingest(cat, PROBE, data)
    assert report.days == {"planned": 3, "done": 3, "unchanged": 0, "failed": 0, "no_work": 0}
    assert report.exit_code == 0
    dataset = cat.open("l1/fgm").load()
    times = np.concatenate([day_times(day) for day in DAYS])
    np.testing.assert_array_equal(dataset.tt2000, times)
    np.testing.assert_array_equal(dataset.field, field_of(times))
    day = cat.current("l1/fgm", DAYS[1])
    assert day.coverage == 1.0
    assert day.report["channels"]["temperature"]["valid"] == 1440
    assert report.extra["datasets"]["l1/fgm"]["mean_coverage"] == 1.0
    assert [edge.parent.split(":")[0] for edge in cat.lineage(day.id)] == ["file"]
    assert cat.verify() == []


def test_the_same_files_again_change_nothing_and_start_no_run(cat, data):
    ingest(cat, PROBE, data)
    before = archive_bytes(cat)
    report = ingest(cat, PROBE, data)
    assert report.run == ""
    assert report.days["unchanged"] == 3
    assert report.extra["files"] == {"read": 0, "unchanged": 3, "superseded": {}}
    assert archive_bytes(cat) == before
    for path in data.iterdir():
        os.utime(path, (1, 1))
    report = ingest(cat, PROBE, data)
    assert report.days["unchanged"] == 3
    assert report.extra["files"]["read"] == 3
    assert set(versions(cat).values()) == {"v01.00"}


def test_a_corrected_file_makes_a_new_revision_of_its_day_alone(cat, data):
    ingest(cat, PROBE, data)
    times = day_times(DAYS[1])
    write_fgm(data, DAYS[1], field=field_of(times) + 1.0, version="02")
    report = ingest(cat, PROBE, data)
    assert report.days == {"planned": 3, "done": 1, "unchanged": 2, "failed": 0, "no_work": 0}
    assert report.extra["files"]["superseded"] == {"fgm_20200502_v01.cdf": "fgm_20200502_v02.cdf"}
    assert versions(cat) == {DAYS[0]: "v01.00", DAYS[1]: "v01.01", DAYS[2]: "v01.00"}
    np.testing.assert_array_equal(cat.read_day("l1/fgm", DAYS[1]).field, field_of(times) + 1.0)
    np.testing.assert_array_equal(cat.read_day("l1/fgm", DAYS[1], version="v01.00").field, field_of(times))


def test_a_change_of_the_yaml_that_touches_the_data_makes_new_revisions_and_a_position_does_not(cat, data):
    ingest(cat, PROBE, data)
    moved = mission_with(("cadence: 60 s", "cadence: 60 s\n    position: [1, 2, 3]"))
    assert ingest(cat, moved, data).days["unchanged"] == 3
    shifted = mission_with(("time: Epoch", "time: Epoch, good_when: T < 20"))
    assert ingest(cat, shifted, data).days["done"] == 3
    assert cat.read_day("l1/fgm", DAYS[0]).flag.values.all()


def test_rows_past_midnight_go_to_their_own_day_and_equal_repeats_are_merged(cat, data):
    times = np.concatenate([day_times(DAYS[0]), day_times(DAYS[1])[:5]])
    write_fgm(data, DAYS[0], times=times)
    report = ingest(cat, PROBE, data)
    assert report.days["done"] == 3
    assert cat.current("l1/fgm", DAYS[0]).count == 1440
    second = cat.current("l1/fgm", DAYS[1])
    assert second.count == 1440
    assert second.report["dropped"] == {"repeated": 5}
    assert len(second.report["files"]) == 2


def test_a_clash_fails_its_day_and_the_others_go_on(cat, data):
    times = np.concatenate([day_times(DAYS[0]), day_times(DAYS[1])[:5]])
    write_fgm(data, DAYS[0], times=times, field=field_of(times) + 3.0)
    report = ingest(cat, PROBE, data)
    assert report.days == {"planned": 3, "done": 2, "unchanged": 0, "failed": 1, "no_work": 0}
    assert report.exit_code == 3
    (problem,) = report.problems
    assert problem["day"] == DAYS[1]
    assert problem["channel"] == "field"
    assert "fgm_20200501_v01.cdf" in problem["message"]
    assert "fgm_20200502_v01.cdf" in problem["message"]
    assert problem["remedy"]
    again = ingest(cat, PROBE, data)
    assert again.run == ""
    assert again.problems == [problem]
    assert [day.cause for day in cat.days("l1/fgm", states=["failed"])] == ["repeatable"]


@pytest.mark.parametrize("damage", ["truncated", "empty", "variable", "unit", "axes", "fill", "clock"])
def test_a_bad_file_costs_its_own_day_only_and_its_repair_brings_it_back(cat, data, damage):
    path = data / "fgm_20200502_v01.cdf"
    whole = path.read_bytes()
    times = day_times(DAYS[1])
    if damage == "truncated":
        path.write_bytes(whole[:-500])
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "variable":
        write_fgm(data, DAYS[1], T=None)
    elif damage == "unit":
        write_fgm(data, DAYS[1], T=(np.zeros(1440), 45, {"UNITS": "nT"}))
    elif damage == "axes":
        write_fgm(data, DAYS[1], B=(np.zeros((1440, 2)), 45, {}))
    elif damage == "fill":
        write_fgm(data, DAYS[1], field=np.full((1440, 3), -1e31))
    else:
        stepped = np.where(np.arange(1440) < 700, times, times - 100 * 60 * 10**9)
        write_fgm(data, DAYS[1], times=stepped, field=field_of(times))
    report = ingest(cat, PROBE, data)
    assert report.days["done"] == 2
    assert report.days["failed"] == 1
    assert report.exit_code == 3
    (problem,) = report.problems
    assert problem["day"] == DAYS[1]
    assert "fgm_20200502" in problem["message"]
    assert problem["remedy"]
    assert problem["cause"] == "repeatable"
    path.write_bytes(whole)
    report = ingest(cat, PROBE, data)
    assert report.days == {"planned": 3, "done": 1, "unchanged": 2, "failed": 0, "no_work": 0}
    assert list(versions(cat)) == DAYS


def test_a_bad_redelivery_leaves_the_published_day_as_it_is(cat, data):
    ingest(cat, PROBE, data)
    path = data / "fgm_20200502_v01.cdf"
    path.write_bytes(path.read_bytes()[:-500])
    report = ingest(cat, PROBE, data)
    assert report.days["failed"] == 1
    assert versions(cat) == dict.fromkeys(DAYS, "v01.00")
    np.testing.assert_array_equal(cat.read_day("l1/fgm", DAYS[1]).tt2000, day_times(DAYS[1]))


def test_files_cleared_away_after_ingest_change_nothing(cat, data):
    ingest(cat, PROBE, data)
    for path in data.iterdir():
        path.unlink()
    write_fgm(data, "2020-05-04")
    report = ingest(cat, PROBE, data)
    assert report.days["unchanged"] == 3
    assert report.days["done"] == 1


def test_a_day_that_needs_a_file_no_longer_there_fails_and_says_which(cat, data):
    times = np.concatenate([day_times(DAYS[0]), day_times(DAYS[1])[:5]])
    write_fgm(data, DAYS[0], times=times)
    ingest(cat, PROBE, data)
    (data / "fgm_20200501_v01.cdf").unlink()
    write_fgm(data, DAYS[1], field=field_of(day_times(DAYS[1])) + 1.0, version="02")
    report = ingest(cat, PROBE, data)
    (problem,) = report.problems
    assert "fgm_20200501_v01.cdf" in problem["message"]
    assert problem["remedy"] == "restore the file"
    assert versions(cat) == dict.fromkeys(DAYS, "v01.00")


def test_a_day_between_others_that_nobody_delivered_is_recorded_with_its_cause(cat, data):
    (data / "fgm_20200502_v01.cdf").unlink()
    report = ingest(cat, PROBE, data)
    assert report.days["no_work"] == 1
    assert report.exit_code == 0
    (day,) = cat.days("l1/fgm", states=["no_work"])
    assert str(day.day) == DAYS[1]
    assert "no delivered file" in day.message
    write_fgm(data, DAYS[1])
    assert ingest(cat, PROBE, data).days["done"] == 1


def test_only_the_days_asked_for(cat, data):
    report = ingest(cat, PROBE, data, start=DAYS[1], end=DAYS[2])
    assert report.days["planned"] == 1
    assert list(versions(cat)) == [DAYS[1]]
    with pytest.raises(MissionError, match="no instrument ovm"):
        ingest(cat, PROBE, data, instruments=["ovm"])


def test_nothing_delivered_is_no_error_and_no_run(cat, tmp_path):
    report = ingest(cat, PROBE, tmp_path / "nowhere")
    assert report.days["planned"] == 0
    assert report.run == ""


def test_a_full_disk_publishes_nothing_and_the_next_ingest_completes(cat, data, monkeypatch):
    def full(*args, **kwargs):
        raise StorageError("No space left on device", remedy="free space")

    with monkeypatch.context() as patched:
        patched.setattr(ingest_batch, "write_segment", full)
        with pytest.raises(StorageError):
            ingest(cat, PROBE, data)
    assert versions(cat) == {}
    assert cat.files("fgm") == {}
    assert ingest(cat, PROBE, data).days["done"] == 3


SCRIPT = """
import sys
from inflight.catalog import Catalog
from inflight.mission import Mission
from inflight.tasks.archive.ingestion import ingest
ingest(Catalog(sys.argv[1]), Mission.parse(open(sys.argv[3]).read()), sys.argv[2], batch_days=1)
"""


@pytest.mark.parametrize(
    "point", ["segment_written:2", "attach:3", "publish_begun", "publish_flushed", "published"]
)
def test_kill_at_any_moment_leaves_nothing_or_all_and_the_next_ingest_completes(tmp_path, data, point):
    workspace, yaml = tmp_path / "workspace", tmp_path / "mission.yaml"
    yaml.write_text(MISSION)
    Catalog(workspace)
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, workspace, data, yaml],
        env=os.environ | {"INFLIGHT_KILL_AT": point},
        check=False,
        capture_output=True,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    cat = Catalog(workspace)
    assert len(versions(cat)) in (0, 3)
    written = set((workspace / "stores").rglob("*.zarr"))
    report = ingest(cat, PROBE, data, batch_days=1)
    assert report.days["done"] + report.days["unchanged"] == 3
    assert versions(cat) == dict.fromkeys(DAYS, "v01.00")
    assert cat.verify() == []
    if point == "publish_begun":
        assert set((workspace / "stores").rglob("*.zarr")) == written, (
            "verified days are adopted, not made again"
        )


def test_parallel_ingest_is_byte_for_byte_the_serial_one(tmp_path, data):
    from distributed import Client, LocalCluster

    serial, parallel = Catalog(tmp_path / "serial"), Catalog(tmp_path / "parallel")
    ingest(serial, PROBE, data, batch_days=2)
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        report = ingest(parallel, PROBE, data, batch_days=2, client=client)
    assert report.days["done"] == 3
    assert archive_bytes(parallel) == archive_bytes(serial)


def test_batches_are_bounded_by_their_samples():
    assert days_of_batch(PROBE.instruments["fgm"]) == ingest_batch.INGEST_SETTINGS.most_days
    fast = mission_with(("cadence: 60 s", "cadence: 10 ms"))
    assert days_of_batch(fast.instruments["fgm"]) == 1
    second = mission_with(("cadence: 60 s", "cadence: 1 s"))
    days = days_of_batch(second.instruments["fgm"])
    assert 10 <= days <= 20
    assert days * 86400 * 44 <= ingest_batch.INGEST_SETTINGS.batch_bytes


def test_progress_is_told(cat, data):
    told = []
    ingest(cat, PROBE, data, batch_days=1, progress=lambda *step: told.append(step))
    assert told == [(stage, count, 3) for stage in ("index", "ingest") for count in range(4)]


def test_a_file_without_a_date_in_its_name_is_read_to_learn_its_days(cat, tmp_path):
    folder = tmp_path / "data"
    write_fgm(folder, DAYS[0]).rename(folder / "whatever.cdf")
    undated = mission_with(("fgm_{day:%Y%m%d}_v*.cdf", "*.cdf"))
    assert ingest(cat, undated, folder).days["done"] == 1
    (folder / "broken.cdf").write_bytes(b"")
    report = ingest(cat, undated, folder)
    assert report.days["unchanged"] == 1
    assert "zero length" in report.problems[0]["message"]
    assert report.exit_code == 3


def test_days_are_the_same_however_files_cut_them(tmp_path):
    times = np.concatenate([day_times(day) for day in DAYS])
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    write_fgm(whole, DAYS[1], times=times)
    for index, piece in enumerate(np.array_split(np.arange(times.size), 7)):
        write_fgm(cut, DAYS[1], times=times[piece]).rename(cut / f"{index}.cdf")
    undated = mission_with(("fgm_{day:%Y%m%d}_v*.cdf", "*.cdf"))
    found = []
    for name in ("whole", "cut"):
        cat = Catalog(tmp_path / f"workspace_{name}")
        ingest(cat, undated, Path(tmp_path / name))
        found.append(cat.open("l1/fgm").load())
    assert found[0].equals(found[1])
