"""Postpone work whose last attempt ended because a service was unavailable.

Revision: 0005
Revises: 0004
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    for table in ("jobs", "evaluations"):
        op.add_column(table, sa.Column("postponed", sa.Integer(), server_default=sa.text("0"), nullable=False))
        op.add_column(table, sa.Column("not_before", sa.DateTime(timezone=True)))


def downgrade() -> None:
    """Undo the change."""
    for table in ("jobs", "evaluations"):
        op.drop_column(table, "postponed")
        op.drop_column(table, "not_before")
