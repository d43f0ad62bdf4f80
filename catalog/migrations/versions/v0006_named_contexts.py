"""Contexts have names and pin tables by time; what is done to validities is kept."""

import json

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

_ID = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
_NAME = sa.String().with_variant(sa.String(collation="C"), "postgresql")

#: Validities of before have the time of the run that made their table; those that had ended are not known.
_KNOWN = """
INSERT INTO certification_act
    (table_id, name, context, act, start, "end", author, reason, created, run_id)
SELECT c.table_id, c.name, c.context, 'certify', c.start, c."end", '', 'before acts were kept',
    coalesce(r.ended, r.started), t.run_id
FROM certification AS c JOIN calibration_table AS t ON t.id = c.table_id JOIN run AS r ON r.id = t.run_id
ORDER BY c.id
"""


def upgrade() -> None:
    """Add the tables, fill in what is known, and let contexts pin tables for the span they were made for."""
    op.create_table(
        "certification_act",
        sa.Column("id", _ID, primary_key=True),
        sa.Column("table_id", _ID, sa.ForeignKey("calibration_table.id"), nullable=False),
        sa.Column("name", _NAME, nullable=False),
        sa.Column("context", _NAME, nullable=False),
        sa.Column("act", _NAME, nullable=False),
        sa.Column("start", sa.BigInteger(), nullable=False),
        sa.Column("end", sa.BigInteger(), nullable=False),
        sa.Column("author", _NAME, nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("created", _NAME, nullable=False),
        sa.Column("run_id", _NAME, sa.ForeignKey("run.id"), nullable=True),
    )
    op.create_index("certification_act_by_name", "certification_act", ["name", "context"])
    op.create_table(
        "named_context",
        sa.Column("name", _NAME, primary_key=True),
        sa.Column("comparison", _NAME, primary_key=True),
        sa.Column("context_id", _NAME, sa.ForeignKey("context.id"), nullable=False),
        sa.Column("run_id", _NAME, sa.ForeignKey("run.id"), nullable=False),
        sa.Column("author", _NAME, nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("as_of", _NAME, nullable=False),
        sa.Column("created", _NAME, nullable=False),
    )
    op.execute(_KNOWN)
    spans = {
        row.id: [row.id, row.start, row.end]
        for row in op.get_bind().execute(sa.text('SELECT id, start, "end" FROM calibration_table'))
    }
    _rewrite_contexts(lambda pinned: [spans[pinned]])


def downgrade() -> None:
    """Remove both; contexts pin a table whatever the time again, the first of each name."""
    _rewrite_contexts(lambda pinned: pinned[0][0])
    op.drop_table("named_context")
    op.drop_table("certification_act")


def _rewrite_contexts(change) -> None:  # type: ignore[no-untyped-def]
    context = sa.table("context", sa.column("id", sa.String), sa.column("tables", sa.Text))
    for row in op.get_bind().execute(sa.select(context)).all():
        tables = json.loads(row.tables)
        if tables:
            text = json.dumps({name: change(pinned) for name, pinned in tables.items()})
            op.get_bind().execute(context.update().where(context.c.id == row.id).values(tables=text))
