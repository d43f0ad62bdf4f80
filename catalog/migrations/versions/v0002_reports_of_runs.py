"""Runs keep their reports."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

JSON = sa.JSON().with_variant(sa.Text(), "postgresql")


def upgrade() -> None:
    """Add the column."""
    op.add_column("run", sa.Column("report", JSON, nullable=True))


def downgrade() -> None:
    """Remove the column."""
    with op.batch_alter_table("run") as table:
        table.drop_column("report")
