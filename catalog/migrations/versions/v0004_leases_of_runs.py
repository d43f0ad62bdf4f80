"""Runs say until when they are taken for alive, on the database's clock."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column."""
    op.add_column("run", sa.Column("lease", sa.Float(), nullable=True))


def downgrade() -> None:
    """Remove the column."""
    with op.batch_alter_table("run") as table:
        table.drop_column("lease")
