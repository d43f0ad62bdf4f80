"""A release's folder, copied elsewhere, is read without the database it was made from."""

import pickle
import shutil
import subprocess

import numpy as np
import pytest
import xarray as xr
from catalog_cases import days_from, delivered, release_mission, samples

from inflight.catalog import Catalog, DayData, MissionStatement, ReleaseFolder, write_segment
from inflight.errors import CatalogError, IntegrityError

#: The second ends with a leap second; the fifth is missing.
DAYS = [*days_from("2005-12-30", 4), np.datetime64("2006-01-04")]
PARENTS = ("file:" + "a" * 64,)


@pytest.fixture
def published(catalog):
    with catalog.run("ingest") as run:
        catalog.record_files(run, [delivered(run, "a" * 64)])
        for days in (DAYS[:2], DAYS[2:]):
            data = [DayData(day, samples(day, jitter=True), str(day), PARENTS) for day in days]
            run.attach(write_segment(catalog.workspace, run.id, "l1/fgm", data))
        run.stage("l2/field", samples(DAYS[0]), day=DAYS[0], parents=PARENTS)
        run.record("l1/fgm", np.datetime64("2006-01-03"), "failed", "repeatable", "file is cut")
        run.publish()
    return catalog


@pytest.fixture
def copied(published, tmp_path):
    """Release 1.0, copied away; nothing else is left of the workspace."""
    published.release("1.0", mission=release_mission())
    shutil.copytree(published.workspace / "releases" / "1.0", tmp_path / "copied")
    published.workspace.rename(tmp_path / "gone")
    return tmp_path / "copied"


@pytest.fixture
def original(copied, tmp_path):
    """The workspace it was made from."""
    return Catalog(tmp_path / "gone")


@pytest.mark.parametrize(
    "span",
    [None, "2005-12-31", slice("2005-12-30T06:05", "2006-01-01T12:00"), slice(None, "2005-12-31T23:59:59")],
)
@pytest.mark.parametrize("variables", [None, ["flag"]])
def test_one_line_opens_what_the_workspace_opens(copied, original, span, variables):
    opened = Catalog(copied).open("l1/fgm", span, variables)
    expected = original.open("l1/fgm", span, variables, release="1.0")
    xr.testing.assert_equal(opened.compute(), expected.compute())
    for name in expected.variables:
        assert opened[name].attrs == expected[name].attrs
    xr.testing.assert_identical(Catalog(copied).open("l1/fgm", span, variables, release="1.0"), opened)


def test_days_are_those_of_the_release_with_what_is_missing(copied, original):
    here, there = Catalog(copied), original
    told, expected = (
        [(day.day, day.state, day.version, day.cause, day.count, day.key) for day in catalog.days("l1/fgm")]
        for catalog in (here, there)
    )
    assert told == expected
    assert [day.message for day in here.days("l1/fgm", states=["failed"])] == ["file is cut"]
    assert here.days("l1/nothing") == []
    summary = [{**item, "coverage": None} for item in there.inventory()]
    assert [{**item, "coverage": None} for item in here.inventory()] == summary
    (record,), (told,) = here.releases(), there.releases()
    assert (record.version, record.datasets) == (told.version, told.datasets)


def test_a_day_is_read_by_itself_or_by_its_record(copied, original):
    here = Catalog(copied)
    for day in DAYS:
        xr.testing.assert_equal(here.read_day("l1/fgm", day), original.read_day("l1/fgm", day))
    found = here.current("l1/fgm", "2005-12-31")
    np.testing.assert_array_equal(
        here.read_variable(found, "flag")[0], original.read_day("l1/fgm", "2005-12-31")["flag"]
    )
    assert here.current("l1/fgm", "2006-01-03") is None
    assert here.read_day("l1/fgm", DAYS[0], version="v01.00").sizes["time"] == 144
    with pytest.raises(CatalogError, match=r"has no v01\.01"):
        here.read_day("l1/fgm", DAYS[0], version="v01.01")


def test_it_travels_to_other_processes(copied):
    again = pickle.loads(pickle.dumps(Catalog(copied)))
    xr.testing.assert_identical(again.open("l2/field"), Catalog(copied).open("l2/field"))


def test_nothing_is_written_into_it(copied):
    before = sorted(copied.rglob("*"))
    Catalog(copied, create=False).open("l1/fgm").compute()
    Catalog(copied).describe("l1/fgm")
    assert sorted(copied.rglob("*")) == before
    told = subprocess.run(["sha256sum", "-c", "--quiet", "MANIFEST.sha256"], cwd=copied, check=False)
    assert told.returncode == 0


@pytest.mark.parametrize(
    "ask",
    [
        lambda catalog: catalog.runs(),
        lambda catalog: catalog.models(),
        lambda catalog: catalog.tables(),
        lambda catalog: catalog.lineage("day:1"),
        lambda catalog: catalog.open("l1/fgm", context="x"),
        lambda catalog: catalog.gc(dry_run=False),
        lambda catalog: catalog.release("1.1"),
        lambda catalog: catalog.run("ingest").__enter__(),
    ],
)
def test_what_it_does_not_hold_is_told(copied, ask):
    before = sorted(copied.rglob("*"))
    with pytest.raises(CatalogError, match=r"this folder is release 1\.0") as refused:
        ask(Catalog(copied))
    assert "workspace" in refused.value.remedy
    assert sorted(copied.rglob("*")) == before


def test_another_release_dataset_or_span_is_refused(copied):
    catalog = Catalog(copied)
    with pytest.raises(CatalogError, match=r"this folder is release 1\.0"):
        catalog.open("l1/fgm", release="2.0")
    with pytest.raises(CatalogError, match=r"has no dataset 'l3/x'; it has: l1/fgm, l2/field"):
        catalog.open("l3/x")
    with pytest.raises(CatalogError, match="no published days in the span"):
        catalog.open("l1/fgm", "2010-01-01")


@pytest.mark.parametrize(
    ("formats", "ways"),
    [
        (("netcdf",), ["open_mfdataset", "netcdf/SOURCE/*/*.nc", "--format zarr"]),
        (("cdf",), ["cdflib", "--format zarr"]),
        (("netcdf", "cdf"), ["open_mfdataset", "cdflib"]),
    ],
)
def test_a_release_without_zarr_says_how_it_is_read(published, tmp_path, formats, ways):
    published.release("1.0", formats=formats, mission=release_mission())
    copied = shutil.copytree(published.workspace / "releases" / "1.0", tmp_path / "copied")
    with pytest.raises(CatalogError, match="holds no Zarr stores, but files of format") as refused:
        Catalog(copied).open("l1/fgm")
    assert all(way in refused.value.remedy for way in ways)
    if "netcdf" in formats:
        files = str(copied / "netcdf" / "probe_l1_fgm" / "*" / "*.nc")
        with xr.open_mfdataset(
            files, engine="h5netcdf", data_vars="minimal", compat="no_conflicts"
        ) as opened:
            assert opened.sizes["time"] == published.open("l1/fgm").sizes["time"]


def test_a_copy_that_is_not_whole_is_told(copied):
    (store,) = (copied / "data").glob("l1.fgm-20051230-*.zarr")
    store.rename(copied / "elsewhere")
    with pytest.raises(IntegrityError, match="no store holds 'l1/fgm'") as refused:
        Catalog(copied).open("l1/fgm")
    assert "copy the release again" in refused.value.remedy
    assert Catalog(copied).open("l2/field").sizes["time"] == 144
    (copied / "days.csv").unlink()
    with pytest.raises(IntegrityError, match="list of days cannot be read"):
        Catalog(copied).open("l2/field")
    (copied / "release.json").write_text("{")
    with pytest.raises(IntegrityError, match="release cannot be read"):
        Catalog(copied)


def test_a_flipped_byte_is_found_as_it_is_read(copied):
    (chunk,) = (copied / "data").glob("l2.field-*.zarr/flag/c.0")
    content = bytearray(chunk.read_bytes())
    content[-1] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(IntegrityError, match="not what was written"):
        Catalog(copied).open("l2/field", variables=["flag"]).compute()


def test_it_states_the_mission(copied):
    assert ReleaseFolder(copied).statement == MissionStatement.of(release_mission())


def test_a_workspace_is_no_release(catalog):
    assert ReleaseFolder.find(catalog.workspace) is None
