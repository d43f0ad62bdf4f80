"""Opening: migrations, and databases that are not what they should be."""

import pytest
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import text

from inflight.catalog import Catalog
from inflight.catalog import database as database_module
from inflight.catalog.schema import Base
from inflight.errors import CatalogError


def scripts():
    config = Config()
    from pathlib import Path

    config.set_main_option("script_location", str(Path(database_module.__file__).parent / "migrations"))
    return ScriptDirectory.from_config(config)


def test_migrations_lead_to_the_tables_the_code_uses(catalog):
    with catalog._database.engine.connect() as connection:
        context = MigrationContext.configure(connection)
        assert compare_metadata(context, Base.metadata) == []
        assert context.get_current_revision() == database_module.HEAD
    assert scripts().get_heads() == [database_module.HEAD]


def test_every_migration_can_be_undone(tmp_path):
    from alembic import command

    catalog = Catalog(tmp_path)
    config = Config()
    config.set_main_option("script_location", scripts().dir)
    with catalog._database._writing.begin() as connection:
        config.attributes["connection"] = connection
        command.downgrade(config, "base")
        names = (
            connection.execute(text("SELECT name FROM sqlite_master WHERE type = 'table'")).scalars().all()
        )
    assert names == ["alembic_version"]
    assert Catalog(tmp_path).days("l1/fgm") == []


def test_a_database_of_a_newer_version_is_refused_and_untouched(tmp_path):
    catalog = Catalog(tmp_path)
    with catalog._database._writing.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(CatalogError, match="newer version"):
        Catalog(tmp_path)


def test_a_file_that_is_no_database_is_told(tmp_path):
    (tmp_path / "catalog.db").write_bytes(b"this is a text file, and a rather long one" * 100)
    with pytest.raises(CatalogError, match=r"catalog\.db"):
        Catalog(tmp_path)


def test_a_folder_that_is_no_workspace_is_told(tmp_path):
    with pytest.raises(CatalogError, match="inflight new"):
        Catalog(tmp_path / "nothing", create=False)
    assert not (tmp_path / "nothing").exists()


def test_readers_and_writers_use_the_settings_that_keep_data_safe(catalog):
    with catalog._database.engine.connect() as connection:
        told = {
            name: connection.execute(text(f"PRAGMA {name}")).scalar()
            for name in ("journal_mode", "foreign_keys", "synchronous", "busy_timeout")
        }
    assert told == {"journal_mode": "wal", "foreign_keys": 1, "synchronous": 2, "busy_timeout": 30_000}
