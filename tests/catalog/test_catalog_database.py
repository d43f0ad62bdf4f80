"""Opening: migrations, and databases that are not what they should be."""

import numpy as np
import pytest
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import inspect, text

from inflight.catalog import Catalog
from inflight.catalog import database as database_module
from inflight.catalog.schema import Base
from inflight.errors import CatalogError

BOTH_DATABASES = True


def scripts():
    config = Config()
    from pathlib import Path

    config.set_main_option("script_location", str(Path(database_module.__file__).parent / "migrations"))
    return ScriptDirectory.from_config(config)


def is_of_models(_object, name, _kind, _reflected, _other):
    """The exclusion of overlapping validities is the database's own, as SQLite's triggers are."""
    return name != "certification_never_overlaps"


def test_migrations_lead_to_the_tables_the_code_uses(catalog):
    with catalog._database.engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"include_object": is_of_models})
        assert compare_metadata(context, Base.metadata) == []
        assert context.get_current_revision() == database_module.HEAD
    assert scripts().get_heads() == [database_module.HEAD]


def migrate(catalog, verb, revision):
    from alembic import command

    config = Config()
    config.set_main_option("script_location", scripts().dir)
    with catalog._database._writing.begin() as connection:
        config.attributes["connection"] = connection
        getattr(command, verb)(config, revision)


def test_every_migration_can_be_undone(catalog):
    migrate(catalog, "downgrade", "base")
    assert inspect(catalog._database.engine).get_table_names() == ["alembic_version"]
    assert Catalog(catalog.workspace).days("l1/fgm") == []


#: What a version of the first tables had written: one run that published one day of one store.
FIRST_ROWS = (
    "INSERT INTO run (id, kind, settings, state, cause, message, host, pid, process, started, ended) "
    "VALUES ('r', 'ingest', '{\"batch\": 4}', 'done', '', '', 'h', 1, '', '2020-01-01', '2020-01-01')",
    "INSERT INTO dataset (id, name) VALUES (1, 'l1/fgm')",
    "INSERT INTO store (id, path, sha256, bytes, notes, run_id) "
    "VALUES (1, 'stores/r/a.zarr', 'x', 9, '[]', 'r')",
    "INSERT INTO day (id, dataset_id, day, run_id, state, cause, message, key, report, baseline, revision, "
    "store_id, start, stop, first_tt2000, last_tt2000, count, step_ns) VALUES (1, 1, '2005-01-01', 'r', "
    "'published', '', '', 'k', '{\"coverage\": NaN}', "
    "1, 0, 1, 0, 5, 157766464184000000, 157852804184000000, 5, 0)",
    "INSERT INTO current (dataset_id, day, day_id) VALUES (1, '2005-01-01', 1)",
    'INSERT INTO calibration_table (id, name, run_id, store_id, start, "end", key) '
    "VALUES (7, 'offsets', 'r', 1, 0, 10, 'k')",
    'INSERT INTO certification (id, table_id, name, context, start, "end") '
    "VALUES (1, 7, 'offsets', '', 2, 8)",
    "INSERT INTO context (id, mission_text, model_name, model_version, tables) "
    "VALUES ('c', 'mission', 'm', 1, '{\"offsets\": 7}')",
)


def test_a_catalog_of_the_first_tables_is_migrated_with_what_is_in_it(catalog):
    migrate(catalog, "downgrade", "0001")
    with catalog._database._writing.begin() as connection:
        for statement in FIRST_ROWS:
            connection.exec_driver_sql(statement)
    reopened = Catalog(catalog.workspace)
    (day,) = reopened.days("l1/fgm")
    assert (day.version, day.rows, day.first_tt2000) == ("v01.00", (0, 5), 157766464184000000)
    assert np.isnan(day.report["coverage"])
    assert [(run.id, run.settings, run.state) for run in reopened.runs()] == [("r", {"batch": 4}, "done")]
    # Of validities it is known since when; a context pins a table for the span it was made for.
    (act,) = reopened.certification_acts()
    assert (act.table, act.start, act.end, act.run, act.created) == (7, 2, 8, "r", "2020-01-01")
    assert reopened.context("c").tables == {"offsets": ((7, 0, 10),)}
    migrate(reopened, "downgrade", "0005")
    with catalog._database.engine.connect() as connection:
        assert connection.execute(text("SELECT tables FROM context")).scalar() == '{"offsets": 7}'


def test_a_database_of_a_newer_version_is_refused_and_untouched(catalog):
    with catalog._database._writing.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(CatalogError, match="newer version"):
        Catalog(catalog.workspace)
    with catalog._database.engine.connect() as connection:
        assert connection.execute(text("SELECT version_num FROM alembic_version")).scalar() == "9999"


def test_a_file_that_is_no_database_is_told(tmp_path):
    (tmp_path / "catalog.db").write_bytes(b"this is a text file, and a rather long one" * 100)
    with pytest.raises(CatalogError, match=r"catalog\.db"):
        Catalog(tmp_path)


def test_a_folder_that_is_no_workspace_is_told(tmp_path):
    with pytest.raises(CatalogError, match="inflight new"):
        Catalog(tmp_path / "nothing", create=False)
    assert not (tmp_path / "nothing").exists()


def test_readers_and_writers_use_the_settings_that_keep_data_safe(tmp_path):
    catalog = Catalog(tmp_path)
    with catalog._database.engine.connect() as connection:
        told = {
            name: connection.execute(text(f"PRAGMA {name}")).scalar()
            for name in ("journal_mode", "foreign_keys", "synchronous", "busy_timeout")
        }
    assert told == {"journal_mode": "wal", "foreign_keys": 1, "synchronous": 2, "busy_timeout": 30_000}
