"""Add to each token the key that signs the addresses of reports opened with it; it never leaves the database.

Revision: 0014
Revises: 0013
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    random = sa.text("replace(gen_random_uuid()::text || gen_random_uuid()::text, '-', '')")
    op.add_column("tokens", sa.Column("ticket_key", sa.String(64), server_default=random, nullable=False))


def downgrade() -> None:
    """Undo the change."""
    op.drop_column("tokens", "ticket_key")
