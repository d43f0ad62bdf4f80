"""What changed since the last release: which days, by how much, and which version the rule gives."""

import csv

import cdflib
import numpy as np
import pytest
from catalog_cases import days_from, publish, samples, table

from inflight.catalog import Catalog
from inflight.catalog.differences import changed_days, measured_changes
from inflight.catalog.table_files import write_table_cdf, write_table_csv
from inflight.errors import CatalogError

DAYS = days_from("2005-01-01", 3)


def released(catalog: Catalog, first: int = 3, key: str = "a") -> Catalog:
    publish(catalog, "l2/field", DAYS[:first], key=key)
    catalog.release("1.0")
    return catalog


@pytest.fixture(autouse=True)
def _without_provenance(monkeypatch):
    """Days of these tests come from nowhere."""
    monkeypatch.setattr("inflight.catalog.release._refuse_without_provenance", lambda *arguments: None)


def test_changes_are_measured_where_stamps_are_the_same(catalog):
    released(catalog)
    before = catalog.days("l2/field", states=("published",))
    publish(catalog, "l2/field", DAYS[1:2], seed=1, key="b")
    after = catalog.days("l2/field", states=("published",))
    (one,) = measured_changes(catalog.workspace, before, after)
    assert (one.kind, one.day) == ("changed", DAYS[1])
    field = next(part for part in one.variables if part.variable == "field")
    apart = np.linalg.norm(samples(DAYS[1], seed=1)["field"] - samples(DAYS[1])["field"], axis=1)
    assert field.rms == pytest.approx(np.sqrt(np.nanmean(apart**2)), rel=1e-9)
    assert field.largest == pytest.approx(np.nanmax(apart), rel=1e-9)
    assert field.samples == np.isfinite(apart).sum()
    assert {part.variable for part in one.variables} == {"field", "temperature"}


def test_a_day_that_was_made_of_the_same_is_the_same(catalog):
    released(catalog)
    before = catalog.days("l2/field", states=("published",))
    publish(catalog, "l2/field", DAYS[:1], key="a")
    assert not changed_days(before, catalog.days("l2/field", states=("published",)))


@pytest.mark.parametrize(
    ("first", "more", "key", "counts", "version"),
    [
        (2, DAYS[2:], "a", {"added": 1}, "1.1"),
        (3, DAYS[:1], "b", {"changed": 1}, "2.0"),
        (3, [], "", {}, "1.1"),
    ],
)
def test_the_rule_of_versions_counts_what_has_to_be_fetched_anew(catalog, first, more, key, counts, version):
    released(catalog, first)
    if more:
        publish(catalog, "l2/field", more, seed=2, key=key)
    plan = catalog.plan_release("9.9")
    assert (plan.previous, plan.changes, plan.next_version) == ("1.0", counts, version)


def test_before_the_first_release_the_version_is_one(catalog):
    publish(catalog, "l2/field", DAYS, key="a")
    plan = catalog.plan_release("1.0")
    assert (plan.previous, plan.next_version) == ("", "1.0")


def test_collections_are_releases_models_and_what_is_published(catalog):
    released(catalog)
    publish(catalog, "l2/field", DAYS[2:], seed=1, key="b")
    assert [(one.kind, one.day) for one in catalog.differences("1.0")] == [("changed", DAYS[2])]
    assert not list(catalog.differences("1.0", "1.0"))
    assert not list(catalog.differences("1.0", datasets=["l1/*"]))
    with pytest.raises(CatalogError, match=r"release '2\.0' does not exist; released: 1\.0"):
        catalog.differences("2.0")
    with pytest.raises(CatalogError, match="was published with model version '7'"):
        catalog.differences("model:7")


def test_tables_are_the_same_as_csv_and_as_cdf(tmp_path):
    one = table(2.5)
    one["start"] = "interval", np.array([0, 86_400_000_000_000])
    one["value"].values[1, 0] = np.nan
    one["origin"] = "interval", np.array([1, 0], dtype=np.int8), {"flag_meanings": "prior data"}
    write_table_csv(tmp_path / "one.csv", one)
    with (tmp_path / "one.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["start_utc"][:19] for row in rows] == ["2000-01-01T11:58:55", "2000-01-02T11:58:55"]
    assert [row["value[offset[y]]"] for row in rows] == ["2.5", "2.5"]
    assert [row["value[offset[x]]"] for row in rows] == ["2.5", "nan"]
    assert [row["source"] for row in rows] == ["fit", "prior"]
    assert [row["origin"] for row in rows] == ["data", "prior"]
    write_table_cdf(tmp_path / "one.cdf", one)
    read = cdflib.CDF(tmp_path / "one.cdf")
    assert read.varget("start").tolist() == one["start"].values.tolist()
    assert read.varget("value").tolist() == [[2.5, 2.5], [-1e31, 2.5]]
    assert read.varget("parameter").tolist() == ["offset[x]", "offset[y]"]
    write_table_cdf(tmp_path / "two.cdf", one)
    assert (tmp_path / "one.cdf").read_bytes() == (tmp_path / "two.cdf").read_bytes()
