"""Releases: frozen, whole, explained, never given out twice."""

import csv
import os
import signal
import subprocess
import time

import numpy as np
import pytest
import xarray as xr
from catalog_cases import days_from, delivered, freeze, publish, samples, spawn, table

from inflight.catalog import Catalog
from inflight.errors import CatalogError, StorageError

DAYS = days_from("2005-12-30", 4)
DELIVERED = "a" * 64


def ingest(catalog, days, *, seed=0, name="l1/fgm", parents=("file:" + DELIVERED,), context=None):
    with catalog.run("ingest", {}, context) as run:
        catalog.record_files(run, [delivered(run, DELIVERED)])
        for day in days:
            run.stage(name, samples(day, seed=seed), day=day, parents=parents)
        return run.publish()


def test_a_release_reads_the_same_after_newer_revisions_are_published(catalog):
    ingest(catalog, DAYS)
    catalog.release("1.0")
    frozen = catalog.open("l1/fgm", release="1.0").compute()
    ingest(catalog, DAYS, seed=1)
    catalog.gc(dry_run=False)
    xr.testing.assert_identical(catalog.open("l1/fgm", release="1.0").compute(), frozen)
    assert not catalog.open("l1/fgm")["field"].equals(frozen["field"])
    with pytest.raises(CatalogError, match=r"released: 1\.0"):
        catalog.open("l1/fgm", release="2.0")


def test_the_copy_is_whole_portable_and_checked_by_sha256sum(catalog):
    ingest(catalog, DAYS)
    folder = catalog.release("1.0", notes="First light.")
    assert folder == catalog.workspace / "releases" / "1.0"
    told = subprocess.run(["sha256sum", "-c", "--quiet", "MANIFEST.sha256"], cwd=folder, check=False)
    assert told.returncode == 0
    assert {"README.md", "RELEASE_NOTES.md", "days.csv", "tables.csv", "data"} <= {
        path.name for path in folder.iterdir()
    }
    assert "First light." in (folder / "RELEASE_NOTES.md").read_text()
    assert not any("delta" in path.read_text() for path in folder.rglob("zarr.json"))
    for store, day in zip(sorted((folder / "data").iterdir()), DAYS, strict=True):
        opened = xr.open_zarr(store, consolidated=True, zarr_format=3)
        np.testing.assert_allclose(opened["field"].values, samples(day)["field"], rtol=1e-15)


def test_days_are_listed_with_version_coverage_state_and_cause(catalog):
    ingest(catalog, [DAYS[0], DAYS[3]])
    with catalog.run("ingest") as run:
        run.record("l1/fgm", DAYS[1], "failed", "repeatable", "file is cut")
        run.record("l1/fgm", DAYS[2], "no_work", "no_work", "nothing delivered")
    folder = catalog.release("1.0")
    with (folder / "days.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["day"], row["version"], row["state"], row["cause"]) for row in rows] == [
        ("2005-12-30", "v01.00", "published", ""),
        ("2005-12-31", "", "failed", "repeatable"),
        ("2006-01-01", "", "no_work", "no_work"),
        ("2006-01-02", "v01.00", "published", ""),
    ]
    assert rows[1]["message"] == "file is cut"


def test_a_release_with_a_context_holds_its_days_tables_model_and_mission(catalog):
    (raw,) = ingest(catalog, DAYS[:1])
    with catalog.run("calibrate") as run:
        offsets = run.stage_table("offsets", table(3.0), start=0, end=100, parents=[raw])
    version = catalog.save_model("champ", "model: champ")
    context = catalog.save_context("mission: champ", "champ", version, {"offsets": ((offsets, 0, 1),)})
    other = catalog.save_context("mission: other", "champ", version, {})
    ingest(catalog, DAYS[:1], name="l2/field", parents=[raw], context=context, seed=1)
    ingest(catalog, DAYS[:1], name="l2/field", parents=[raw], context=other, seed=2)
    folder = catalog.release("1.0", context)
    assert (folder / "mission.yaml").read_text() == "mission: champ"
    assert (folder / "model.yaml").read_text() == "model: champ"
    assert {path.name for path in (folder / "tables").iterdir()} == {
        f"offsets-{offsets}.{form}" for form in ("zarr", "csv", "cdf")
    }
    frozen = catalog.open("l2/field", release="1.0")
    np.testing.assert_array_equal(frozen["field"], samples(DAYS[0], seed=1)["field"])


def test_a_version_is_never_given_out_twice(catalog):
    ingest(catalog, DAYS)
    catalog.release("1.0")
    with pytest.raises(CatalogError, match="never reused"):
        catalog.release("1.0")
    for version in ("", "../1", "1/0"):
        with pytest.raises(CatalogError, match="no release version"):
            catalog.release(version)


def test_a_day_without_provenance_stops_a_release(catalog):
    ingest(catalog, DAYS, parents=())
    with pytest.raises(CatalogError, match="4 items lack provenance, among them l1/fgm 2005-12-30"):
        catalog.release("1.0")
    assert list((catalog.workspace / "releases").iterdir()) == []


def test_a_parent_that_is_not_in_the_catalog_stops_a_release(catalog):
    publish(catalog, "l1/fgm", DAYS)
    with pytest.raises(CatalogError, match="file:abc"):
        catalog.release("1.0")


def test_a_missing_day_without_a_cause_stops_a_release(catalog):
    ingest(catalog, [DAYS[0], DAYS[3]])
    with catalog.run("ingest") as run:
        run.record("l1/fgm", DAYS[1], "planned")
        run.record("l1/fgm", DAYS[2], "failed", "bug", "x")
    with pytest.raises(CatalogError, match=r"1 missing days .* 2005-12-31 \(planned\)"):
        catalog.release("1.0")


def test_nothing_to_release_is_told(catalog):
    with pytest.raises(CatalogError, match="nothing is published that matches"):
        catalog.release("1.0")


def test_a_damaged_store_stops_a_release(catalog):
    (day, *_) = ingest(catalog, DAYS)
    (catalog.workspace / day.segment / "field" / "c.0.0").unlink()
    with pytest.raises(CatalogError):
        catalog.release("1.0")
    assert list((catalog.workspace / "releases").iterdir()) == []


@pytest.mark.parametrize("point", ["release_written", "release_renamed"])
def test_a_killed_release_is_made_again(catalog, point):
    ingest(catalog, DAYS)
    killed = spawn(freeze, catalog.workspace, "1.0", kill_at=point)
    killed.join(timeout=60)
    assert killed.exitcode == -signal.SIGKILL
    reopened = Catalog(catalog.workspace)
    with pytest.raises(CatalogError, match="does not exist"):
        reopened.open("l1/fgm", release="1.0")
    assert reopened.release("1.0").name == "1.0"
    assert reopened.open("l1/fgm", release="1.0").sizes["time"] == 577


def test_a_folder_that_is_no_release_is_not_overwritten(catalog, tmp_path):
    ingest(catalog, DAYS)
    (tmp_path / "out" / "1.0").mkdir(parents=True)
    (tmp_path / "out" / "1.0" / "thesis.tex").write_text("years of work")
    with pytest.raises(CatalogError, match="move it away"):
        catalog.release("1.0", destination=tmp_path / "out")
    assert (tmp_path / "out" / "1.0" / "thesis.tex").read_text() == "years of work"
    with pytest.raises(CatalogError, match="does not exist"):
        catalog.open("l1/fgm", release="1.0")


def test_a_destination_that_refuses_writes_is_told(catalog, tmp_path):
    ingest(catalog, DAYS)
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="could not be written"):
        catalog.release("1.0", destination=tmp_path / "file" / "below")


def test_what_a_killed_release_left_is_collected_after_a_day(catalog):
    ingest(catalog, DAYS)
    catalog.release("1.0")
    for name, age in ((".1.1-0a1b2c3d", 2), (".1.2-0a1b2c3d", 0)):
        folder = catalog.workspace / "releases" / name
        folder.mkdir()
        os.utime(folder, (time.time() - age * 86_400,) * 2)
    assert [one.path for one in catalog.gc(dry_run=False)] == ["releases/.1.1-0a1b2c3d"]
    assert {one.name for one in (catalog.workspace / "releases").iterdir()} == {"1.0", ".1.2-0a1b2c3d"}
