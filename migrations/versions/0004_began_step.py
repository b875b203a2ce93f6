"""Record the step at which an attempt began.

Revision: 0004
Revises: 0003
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    op.add_column("jobs", sa.Column("began_step", sa.BigInteger(), server_default=sa.text("0"), nullable=False))


def downgrade() -> None:
    """Undo the change."""
    op.drop_column("jobs", "began_step")
