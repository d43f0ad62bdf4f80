"""Versions of a model keep what the change did to the residual."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

JSON = sa.JSON().with_variant(sa.Text(), "postgresql")


def upgrade() -> None:
    """Add the column."""
    op.add_column("model", sa.Column("change", JSON, nullable=True))


def downgrade() -> None:
    """Remove the column."""
    with op.batch_alter_table("model") as table:
        table.drop_column("change")
