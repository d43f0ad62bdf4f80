"""Releases have a maturity, and calibration tables are approved by named persons."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

_ID = sa.BigInteger().with_variant(sa.Integer(), "sqlite")


def upgrade() -> None:
    """Add the column and the table; what was released before is preliminary."""
    op.add_column("release", sa.Column("maturity", sa.String(), nullable=False, server_default="preliminary"))
    op.create_table(
        "approval",
        sa.Column("id", _ID, primary_key=True),
        sa.Column("table_id", _ID, sa.ForeignKey("calibration_table.id"), nullable=False),
        sa.Column("person", sa.String(), nullable=False),
        sa.Column("note", sa.Text(), nullable=False),
        sa.Column("created", sa.String(), nullable=False),
    )
    op.create_index("approval_by_table", "approval", ["table_id"])


def downgrade() -> None:
    """Remove both."""
    op.drop_table("approval")
    with op.batch_alter_table("release") as table:
        table.drop_column("maturity")
