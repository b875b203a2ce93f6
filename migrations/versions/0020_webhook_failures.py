"""Add the back-off of a webhook as a whole.

Revision: 0020
Revises: 0019
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0020"
down_revision = "0019"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    op.add_column("webhooks", sa.Column("failures", sa.Integer, nullable=False, server_default=sa.text("0")))
    op.add_column("webhooks", sa.Column("not_before", sa.DateTime(timezone=True)))


def downgrade() -> None:
    """Undo the change."""
    op.drop_column("webhooks", "not_before")
    op.drop_column("webhooks", "failures")
