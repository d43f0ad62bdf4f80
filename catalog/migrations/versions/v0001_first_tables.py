"""The first tables."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

#: SQLite numbers rows by itself only in columns declared INTEGER.
ID = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

#: Names sort the same on both databases.
NAME = sa.String().with_variant(sa.String(collation="C"), "postgresql")
#: PostgreSQL's own JSON refuses the NaN that reports may hold.
JSON = sa.JSON().with_variant(sa.Text(), "postgresql")

#: The last guard against two tables valid at one time.
NO_OVERLAP = """
CREATE TRIGGER certification_never_overlaps_{verb} BEFORE {verb} ON certification
WHEN EXISTS (
    SELECT 1 FROM certification AS other
    WHERE other.name = NEW.name AND other.context = NEW.context AND other.id IS NOT NEW.id
    AND other.start < NEW."end" AND NEW.start < other."end"
)
BEGIN SELECT RAISE(ABORT, 'validities of one table name and context overlap'); END
"""

EXCLUDED = """
ALTER TABLE certification ADD CONSTRAINT certification_never_overlaps
EXCLUDE USING gist (name WITH =, context WITH =, int8range("start", "end") WITH &&)
"""


def upgrade() -> None:
    """Make the tables."""
    _runs_and_stores()
    _days()
    _tables()
    _models_and_files()
    _releases()
    if op.get_bind().dialect.name == "sqlite":
        for verb in ("INSERT", "UPDATE"):
            op.execute(NO_OVERLAP.format(verb=verb))
    else:
        op.execute("CREATE EXTENSION IF NOT EXISTS btree_gist")  # equality of texts in a gist index
        op.execute(EXCLUDED)


def _runs_and_stores() -> None:
    op.create_table(
        "run",
        sa.Column("id", NAME, nullable=False),
        sa.Column("kind", NAME, nullable=False),
        sa.Column("settings", JSON, nullable=False),
        sa.Column("context", NAME, nullable=True),
        sa.Column("state", NAME, nullable=False),
        sa.Column("cause", NAME, nullable=False),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("host", NAME, nullable=False),
        sa.Column("pid", sa.BigInteger(), nullable=False),
        sa.Column("process", NAME, nullable=False),
        sa.Column("started", NAME, nullable=False),
        sa.Column("ended", NAME, nullable=True),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index("ix_run_state", "run", ["state"], unique=False)
    op.create_table(
        "dataset",
        sa.Column("id", ID, nullable=False),
        sa.Column("name", NAME, nullable=False),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("name"),
    )
    op.create_table(
        "store",
        sa.Column("id", ID, nullable=False),
        sa.Column("path", NAME, nullable=False),
        sa.Column("sha256", NAME, nullable=False),
        sa.Column("bytes", sa.BigInteger(), nullable=False),
        sa.Column("notes", JSON, nullable=False),
        sa.Column("run_id", NAME, nullable=False),
        sa.ForeignKeyConstraint(
            ["run_id"],
            ["run.id"],
        ),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("path"),
    )
    op.create_table(
        "setting",
        sa.Column("name", NAME, nullable=False),
        sa.Column("value", NAME, nullable=False),
        sa.PrimaryKeyConstraint("name"),
    )
    op.create_table(
        "lineage",
        sa.Column("parent", NAME, nullable=False),
        sa.Column("child", NAME, nullable=False),
        sa.PrimaryKeyConstraint("parent", "child"),
    )
    op.create_index("ix_lineage_child", "lineage", ["child"], unique=False)


def _days() -> None:
    op.create_table(
        "day",
        sa.Column("id", ID, nullable=False),
        sa.Column("dataset_id", ID, nullable=False),
        sa.Column("day", sa.Date(), nullable=False),
        sa.Column("run_id", NAME, nullable=False),
        sa.Column("context", NAME, nullable=True),
        sa.Column("state", NAME, nullable=False),
        sa.Column("cause", NAME, nullable=False),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("key", NAME, nullable=False),
        sa.Column("report", JSON, nullable=False),
        sa.Column("coverage", sa.Float(), nullable=True),
        sa.Column("baseline", sa.BigInteger(), nullable=True),
        sa.Column("revision", sa.BigInteger(), nullable=True),
        sa.Column("store_id", ID, nullable=True),
        sa.Column("start", sa.BigInteger(), nullable=False),
        sa.Column("stop", sa.BigInteger(), nullable=False),
        sa.Column("first_tt2000", sa.BigInteger(), nullable=False),
        sa.Column("last_tt2000", sa.BigInteger(), nullable=False),
        sa.Column("count", sa.BigInteger(), nullable=False),
        sa.Column("step_ns", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["dataset_id"],
            ["dataset.id"],
        ),
        sa.ForeignKeyConstraint(
            ["run_id"],
            ["run.id"],
        ),
        sa.ForeignKeyConstraint(
            ["store_id"],
            ["store.id"],
        ),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("dataset_id", "day", "baseline", "revision", name="version_never_reused"),
        sa.UniqueConstraint("run_id", "dataset_id", "day", name="one_day_per_run"),
    )
    op.create_index("day_by_dataset", "day", ["dataset_id", "day"], unique=False)
    op.create_index("day_by_key", "day", ["key"], unique=False)
    op.create_index("ix_day_store_id", "day", ["store_id"], unique=False)
    op.create_table(
        "current",
        sa.Column("dataset_id", ID, nullable=False),
        sa.Column("day", sa.Date(), nullable=False),
        sa.Column("day_id", ID, nullable=False),
        sa.ForeignKeyConstraint(
            ["dataset_id"],
            ["dataset.id"],
        ),
        sa.ForeignKeyConstraint(
            ["day_id"],
            ["day.id"],
        ),
        sa.PrimaryKeyConstraint("dataset_id", "day"),
    )


def _tables() -> None:
    op.create_table(
        "calibration_table",
        sa.Column("id", ID, nullable=False),
        sa.Column("name", NAME, nullable=False),
        sa.Column("run_id", NAME, nullable=False),
        sa.Column("store_id", ID, nullable=False),
        sa.Column("start", sa.BigInteger(), nullable=False),
        sa.Column("end", sa.BigInteger(), nullable=False),
        sa.Column("key", NAME, nullable=False),
        sa.Column("context", NAME, nullable=True),
        sa.ForeignKeyConstraint(
            ["run_id"],
            ["run.id"],
        ),
        sa.ForeignKeyConstraint(
            ["store_id"],
            ["store.id"],
        ),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index("ix_calibration_table_name", "calibration_table", ["name"], unique=False)
    op.create_table(
        "certification",
        sa.Column("id", ID, nullable=False),
        sa.Column("table_id", ID, nullable=False),
        sa.Column("name", NAME, nullable=False),
        sa.Column("context", NAME, nullable=False),
        sa.Column("start", sa.BigInteger(), nullable=False),
        sa.Column("end", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["table_id"],
            ["calibration_table.id"],
        ),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index("certification_by_name", "certification", ["name", "context", "start"], unique=False)


def _models_and_files() -> None:
    op.create_table(
        "model",
        sa.Column("id", ID, nullable=False),
        sa.Column("name", NAME, nullable=False),
        sa.Column("version", sa.BigInteger(), nullable=False),
        sa.Column("parent", sa.BigInteger(), nullable=True),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("sha256", NAME, nullable=False),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("created", NAME, nullable=False),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("name", "version", name="model_version_never_reused"),
    )
    op.create_table(
        "context",
        sa.Column("id", NAME, nullable=False),
        sa.Column("mission_text", sa.Text(), nullable=False),
        sa.Column("model_name", NAME, nullable=False),
        sa.Column("model_version", sa.BigInteger(), nullable=False),
        sa.Column("tables", JSON, nullable=False),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_table(
        "file",
        sa.Column("id", ID, nullable=False),
        sa.Column("run_id", NAME, nullable=False),
        sa.Column("instrument", NAME, nullable=False),
        sa.Column("path", sa.Text(), nullable=False),
        sa.Column("sha256", NAME, nullable=False),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("mtime_ns", sa.BigInteger(), nullable=False),
        sa.Column("days", JSON, nullable=False),
        sa.Column("report", JSON, nullable=False),
        sa.Column("taken", sa.Boolean(), nullable=False),
        sa.ForeignKeyConstraint(
            ["run_id"],
            ["run.id"],
        ),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("run_id", "instrument", "path", name="one_file_per_run"),
    )
    op.create_index("file_by_instrument", "file", ["instrument", "path"], unique=False)
    op.create_index("file_by_sha256", "file", ["sha256"], unique=False)


def _releases() -> None:
    op.create_table(
        "release",
        sa.Column("id", ID, nullable=False),
        sa.Column("version", NAME, nullable=False),
        sa.Column("context", NAME, nullable=True),
        sa.Column("notes", sa.Text(), nullable=False),
        sa.Column("path", sa.Text(), nullable=False),
        sa.Column("created", NAME, nullable=False),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("version"),
    )
    op.create_table(
        "release_day",
        sa.Column("release_id", ID, nullable=False),
        sa.Column("day_id", ID, nullable=False),
        sa.ForeignKeyConstraint(
            ["day_id"],
            ["day.id"],
        ),
        sa.ForeignKeyConstraint(
            ["release_id"],
            ["release.id"],
        ),
        sa.PrimaryKeyConstraint("release_id", "day_id"),
    )


def downgrade() -> None:
    """Drop the tables, those that refer to others first."""
    for name in (
        "release_day",
        "release",
        "current",
        "certification",
        "calibration_table",
        "day",
        "file",
        "context",
        "model",
        "lineage",
        "setting",
        "store",
        "dataset",
        "run",
    ):
        op.drop_table(name)
