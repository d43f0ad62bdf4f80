"""Damage has a way back: repair lets go of what is damaged, and the usual work makes just that again."""

from pathlib import Path

import pytest
from fault_cases import ARCHIVE, BATCH, DAYS, PRODUCTS, view
from test_faults_storage import damage

from inflight.catalog import Catalog
from inflight.errors import CatalogError, IntegrityError

TABLE = "tables/main-window"
DATASETS = (*ARCHIVE, *PRODUCTS)


def damaged_chunk(catalog: Catalog, item: str, day: str) -> tuple[str, set[str]]:
    """Flip a bit of the store of a day or of the table; return the store and the days that lie in it."""
    held = catalog.tables("main-window")[-1] if item == TABLE else catalog.current(item, day)
    store = held.segment
    chunks = sorted((catalog.workspace / store).glob("*/c*"))
    damage(chunks[len(chunks) // 2], seed=1)
    return store, {str(d.day) for d in catalog.days(item) if d.segment == store}


def content(workspace: Path) -> dict:
    """Return `view` without the versions, and the versions of the days alone."""
    return {key: told[1:] if key[0] != "table" else told for key, told in view(workspace).items()}


def days_as_now(catalog: Catalog) -> dict:
    found = (day for name in DATASETS for day in catalog.days(name, states=["published"]))
    return {(day.dataset, str(day.day)): (day.version, day.segment) for day in found}


@pytest.mark.parametrize("item", ["l1/turning", "equations/main/base", "l2/field", TABLE])
def test_a_damaged_store_is_let_go_and_made_again_and_nothing_else_is(stage, fresh, views, item):
    workspace = fresh("reprocessed")
    catalog = Catalog(workspace)
    before, undisturbed = days_as_now(catalog), content(workspace)
    store, lost = damaged_chunk(catalog, item, DAYS[2])
    assert {fault["item"] for fault in catalog.verify()} == {item}

    (told,) = catalog.repair(dry_run=True)
    assert days_as_now(catalog) == before
    assert catalog.repair() == [told]
    assert (told.item, told.path, set(told.days)) == (item, store, lost)
    assert catalog.verify() == [], "what is out of use is not in use"
    for day in lost:
        record = next(found for found in catalog.days(item) if str(found.day) == day)
        assert (record.state, record.cause) == ("failed", "transient")
        assert f"{store}/{told.files[0]}" in record.message
    if item == TABLE:
        with pytest.raises(CatalogError, match="no table 'main-window' is valid"):
            catalog.table("main-window", DAYS[0])

    for work in ("ingest", "reprocess"):
        ended = stage.run(work, workspace, batch_days=BATCH)
        assert ended.code == 0, ended.error
    assert catalog.verify() == []
    assert content(workspace) == undisturbed
    after = days_as_now(catalog)
    changed = {(item, day) for day in lost}
    assert {place for place in after if after[place] != before[place]} == changed
    assert {after[place][0] for place in changed} <= {"v01.02"}
    assert (workspace / store).is_dir()
    assert catalog.repair() == []


def test_a_past_revision_stays_listed_when_its_store_was_let_go(stage, fresh):
    workspace = fresh("reprocessed")
    catalog = Catalog(workspace)
    past = catalog.current("l2/field", DAYS[0])
    _, lost = damaged_chunk(catalog, "l2/field", DAYS[0])
    catalog.repair()
    assert stage.run("reprocess", workspace, batch_days=BATCH).code == 0
    assert catalog.current("l2/field", DAYS[0]).revision == past.revision + 1
    told = []
    for day in lost:
        try:
            catalog.read_day("l2/field", day, version=past.version)
        except IntegrityError as error:
            told.append(error.remedy)
    assert len(told) == 1, "the chunk of one day was damaged, the other day's past revision is whole"
    assert "inflight catalog repair" in told[0]


def test_a_failure_of_the_repair_itself_leaves_everything_as_it_was(fresh, monkeypatch):
    workspace = fresh("reprocessed")
    catalog = Catalog(workspace)
    before = days_as_now(catalog)
    for item in ("l2/field", "l1/turning"):
        damaged_chunk(catalog, item, DAYS[0])
    from inflight.catalog import upkeep as module

    withdraw = module._withdraw

    def break_at_the_end(*arguments):
        assert len(withdraw(*arguments)) == 2
        raise OSError("gone")

    monkeypatch.setattr(module, "_withdraw", break_at_the_end)
    with pytest.raises(OSError, match="gone"):
        catalog.repair()
    assert days_as_now(catalog) == before
    assert {fault["item"] for fault in catalog.verify()} == {"l2/field", "l1/turning"}
    assert catalog.runs("repair")[-1].state == "failed"
