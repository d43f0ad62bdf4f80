"""Releases as files of a day: ISTP CDF and CF NetCDF, read back, refused without what they must say."""

import logging
import multiprocessing
import re
import signal
import time

import cdflib
import cdflib.cdfwrite
import cdflib.xarray
import h5py
import numpy as np
import pytest
import xarray as xr
from catalog_cases import (
    days_from,
    delivered,
    freeze_as_cdf,
    freeze_under_a_size_limit,
    publish,
    release_mission,
    samples,
    spawn,
)
from istp_checks import istp_findings

from inflight.catalog import Catalog
from inflight.errors import CatalogError, SettingsError
from inflight.mission import Mission
from inflight.time import day_bounds, to_utc

#: The first ends with a leap second.
DAYS = days_from("2005-12-31", 2)
MISSION = release_mission()


def fill(catalog):
    """Publish two days of an instrument, and a product of the first made from it."""
    with catalog.run("ingest", {}) as run:
        catalog.record_files(run, [delivered(run, "a" * 64)])
        for day in DAYS:
            run.stage("l1/fgm", _with_wide_flag(samples(day)), day=day, parents=["file:" + "a" * 64])
        raw = run.publish()
    with catalog.run("reprocess", {}) as run:
        run.stage("l2/field", _with_wide_flag(samples(DAYS[0], jitter=True)), day=DAYS[0], parents=raw[:1])
        run.publish()
    return catalog


@pytest.fixture
def published(catalog):
    return fill(catalog)


def _with_wide_flag(dataset: xr.Dataset) -> xr.Dataset:
    """Flags of the whole word, so that a narrower one would show."""
    dataset["flag"] = dataset["flag"] | np.uint32(1 << 19)
    return dataset


def _files(folder, ending):
    return {path.stem: path for path in sorted(folder.rglob(f"*.{ending}"))}


@pytest.mark.filterwarnings("ignore:Duplicate dimension names")
def test_cdf_files_keep_istp_and_read_back_equal(published, caplog, tmp_path):
    folder = published.release("1.2", formats=("cdf",), mission=MISSION)
    files = _files(folder, "cdf")
    assert list(files) == [
        "probe_l1_fgm_20051231_v01.02",
        "probe_l1_fgm_20060101_v01.02",
        "probe_l2_field-preliminary_20051231_v01.02",
    ]
    for path in files.values():
        assert istp_findings(path) == []
    expected = published.read_day("l2/field", DAYS[0])
    file = cdflib.CDF(files["probe_l2_field-preliminary_20051231_v01.02"])
    np.testing.assert_array_equal(file.varget("Epoch"), expected["tt2000"])
    np.testing.assert_array_equal(file.varget("flag"), expected["flag"])
    field = file.varget("field")
    np.testing.assert_array_equal(np.where(field == -1.0e31, np.nan, field), expected["field"])
    assert np.isnan(expected["field"]).any()
    assert "524288 still" in file.varattsget("flag")["VAR_NOTES"]
    assert [text.split()[-1] for text in file.varget("field_label").tolist()] == ["x", "y", "z"]
    assert not (folder / "data").exists()
    assert "cdf/probe_l2_field-preliminary/2005/" in (folder / "MANIFEST.sha256").read_text()
    # cdflib's own checks ask for a variable behind each dimension, where the labels stand: of nothing else.
    with caplog.at_level(logging.WARNING):
        dataset = cdflib.xarray.cdf_to_xarray(
            files["probe_l2_field-preliminary_20051231_v01.02"], fillval_to_nan=False
        )
        cdflib.xarray.xarray_to_cdf(dataset, tmp_path / "again.cdf", istp=True)
    rest = [
        item for item in caplog.messages if not re.search(r"a dimension dim\d+ that is not defined", item)
    ]
    assert rest == []


def test_parents_name_files_of_the_release_and_what_was_delivered(published):
    folder = published.release("1.0", formats=("cdf",), mission=MISSION)
    files = {name: cdflib.CDF(path).globalattsget() for name, path in _files(folder, "cdf").items()}
    assert files["probe_l2_field-preliminary_20051231_v01.00"]["Parents"] == [
        "CDF>probe_l1_fgm_20051231_v01.00"
    ]
    assert files["probe_l1_fgm_20060101_v01.00"]["Parents"] == ["file>a.cdf sha256:" + "a" * 64]
    assert {told["Generation_date"][0] for told in files.values()} == {"20060101"}


def test_netcdf_files_read_back_equal_by_another_reader(published):
    folder = published.release("1.0", formats=("netcdf",), mission=MISSION)
    path = _files(folder, "nc")["probe_l2_field-preliminary_20051231_v01.00"]
    expected = published.read_day("l2/field", DAYS[0])
    with h5py.File(path) as file:
        assert file.attrs["Conventions"] == "CF-1.11, ACDD-1.3"
        for name in ("tt2000", "field", "temperature", "flag", "rotation"):
            np.testing.assert_array_equal(file[name][...], expected[name])
        assert file["flag"].attrs["flag_masks"].dtype == np.uint32
    with xr.open_dataset(path, engine="h5netcdf") as opened:
        late = np.abs(opened["time"].values - to_utc(expected["tt2000"].values))
        assert late.max() <= np.timedelta64(10, "ns")
        assert opened["field"].attrs["units"] == "nT"


def test_equal_days_give_equal_bytes_at_any_time_and_place(published, monkeypatch, tmp_path):
    formats = ("cdf", "netcdf")
    first = published.release("1.0", formats=formats, mission=MISSION)
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 1.0e6)
    again = fill(Catalog(tmp_path / "elsewhere")).release("1.0", formats=formats, mission=MISSION)
    for ending in ("cdf", "nc"):
        old, new = _files(first, ending), _files(again, ending)
        assert len(old) == 3
        assert {name: path.read_bytes() for name, path in old.items()} == {
            name: path.read_bytes() for name, path in new.items()
        }


def test_the_checks_tell_what_a_file_lacks(published, monkeypatch):
    write, write_variable = cdflib.cdfwrite.CDF.write_globalattrs, cdflib.cdfwrite.CDF.write_var
    for number, left_out in enumerate(("Discipline", "LABL_PTR_1", "FILLVAL")):

        def without(told, left_out=left_out):
            return {key: value for key, value in told.items() if key != left_out}

        def write_without(self, told, without=without):
            write(self, without(told))

        def write_variable_without(self, kind, var_attrs=None, var_data=None, without=without):
            write_variable(self, kind, without(var_attrs), var_data)

        monkeypatch.setattr(cdflib.cdfwrite.CDF, "write_globalattrs", write_without)
        monkeypatch.setattr(cdflib.cdfwrite.CDF, "write_var", write_variable_without)
        folder = published.release(f"1.{number}", datasets=("l2/*",), formats=("cdf",), mission=MISSION)
        (path,) = _files(folder, "cdf").values()
        findings = istp_findings(path)
        assert findings
        assert all(left_out in text for text in findings)


def test_files_are_refused_without_the_keys_they_must_state(published):
    bare = Mission.parse(re.sub(r"(?m)^  (discipline|pi_name):.*\n", "", MISSION.text))
    with pytest.raises(CatalogError, match=r"lacks: release\.discipline, release\.pi_name;") as refused:
        published.release("1.0", formats=("zarr", "cdf"), mission=bare)
    assert "mission.yaml" in refused.value.remedy
    assert list((published.workspace / "releases").iterdir()) == []
    assert published.release("1.0", mission=bare).name == "1.0"


def test_files_are_refused_without_a_version_of_two_numbers(published):
    for version in ("1", "01.0", "1.00", "1.100", "2024a", "1.0.1"):
        with pytest.raises(CatalogError, match=r"gives no vXX\.YY"):
            published.release(version, formats=("cdf",), mission=MISSION)


def test_an_unknown_format_is_told_with_the_nearest(published):
    with pytest.raises(SettingsError, match="did you mean 'netcdf'"):
        published.release("1.0", formats=("netcfd",))


def test_a_dataset_without_samples_in_time_is_no_file(catalog):
    start, _ = day_bounds(np.datetime64("2005-01-01"))
    blocks = xr.Dataset({"start": ("block", np.array([start])), "rms": ("block", [1.0])})
    with catalog.run("ingest") as run:
        catalog.record_files(run, [delivered(run, "a" * 64)])
        run.stage("l2/blocks", blocks, day=np.datetime64("2005-01-01"), parents=["file:" + "a" * 64])
        run.publish()
    with pytest.raises(CatalogError, match="no samples in time"):
        catalog.release("1.0", formats=("cdf",), mission=MISSION)
    assert list((catalog.workspace / "releases").iterdir()) == []


def test_a_plan_tells_everything_that_stands_against_a_release_and_writes_nothing(published):
    publish(published, "l1/fgm", days_from("2006-01-03", 1))
    published.release("0.9", datasets=("l2/*",))
    bare = Mission.parse(re.sub(r"(?m)^  pi_name:.*\n", "", MISSION.text))
    before = sorted(published.workspace.rglob("*"))
    plan = published.plan_release("0.9", formats=("zarr", "cdf"), mission=bare)
    assert sorted(published.workspace.rglob("*")) == before
    told = "\n".join(item.message for item in plan.objections)
    for text in (
        "release 0.9 exists",
        "lack provenance",
        r"no recorded cause, among them l1/fgm 2006-01-02",
        "pi_name",
    ):
        assert text in told
    part = next(part for part in plan.parts if (part["dataset"], part["format"]) == ("l1/fgm", "cdf"))
    assert (part["days"], part["missing"], part["files"]) == (3, 1, 3)
    # Three doubles, one more, a word and a time, for 144 + 1 rows of the first day and 144 of each other.
    assert part["bytes"] == (145 + 2 * 144) * (3 * 8 + 8 + 4 + 8)


def test_a_release_killed_between_its_files_leaves_nothing_and_is_made_again(published):
    killed = spawn(freeze_as_cdf, published.workspace, "1.0", kill_at="release_file_written:2")
    killed.join(timeout=60)
    assert killed.exitcode == -signal.SIGKILL
    assert not (published.workspace / "releases" / "1.0").exists()
    folder = Catalog(published.workspace).release("1.0", formats=("cdf",), mission=MISSION)
    assert len(_files(folder, "cdf")) == 3


def test_a_disk_that_refuses_a_file_is_told_and_leaves_nothing(published):
    with published.run("ingest") as run:
        wide = samples("2006-01-02", step_s=30)
        run.stage("l1/fgm", wide, day=np.datetime64("2006-01-02"), parents=["file:" + "a" * 64])
        run.publish()
    here, there = multiprocessing.Pipe()
    process = spawn(freeze_under_a_size_limit, published.workspace, ("cdf", "netcdf"), there)
    told = [here.recv() if here.poll(60) else "" for _ in range(2)]
    process.join(timeout=60)
    assert process.exitcode == 0
    assert all("could not be written" in text for text in told), told
    assert list((published.workspace / "releases").iterdir()) == []


def test_a_file_that_reads_back_differently_stops_the_release(published, monkeypatch):
    real = cdflib.CDF.varget
    monkeypatch.setattr(
        cdflib.CDF, "varget", lambda self, name, *rest, **more: real(self, name, *rest, **more) * 2
    )
    with pytest.raises(CatalogError, match="reads back differently"):
        published.release("1.0", formats=("cdf",), mission=MISSION)
    assert list((published.workspace / "releases").iterdir()) == []
