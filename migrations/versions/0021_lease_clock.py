"""Add the clock of leases.

Revision: 0021
Revises: 0020
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0021"
down_revision = "0020"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    now = sa.text("now()")
    op.create_table(
        "lease_clocks",
        sa.Column("id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("time", sa.DateTime(timezone=True), server_default=now, nullable=False),
        sa.Column("read_at", sa.DateTime(timezone=True), server_default=now, nullable=False),
        sa.CheckConstraint("id = 1", name=op.f("ck_lease_clocks_one_row")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_lease_clocks")),
    )
    op.execute("INSERT INTO lease_clocks (id) VALUES (1)")


def downgrade() -> None:
    """Undo the change."""
    op.drop_table("lease_clocks")
