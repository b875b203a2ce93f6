"""Record the last batch of records of each job.

Revision: 0006
Revises: 0005
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    op.add_column("jobs", sa.Column("last_batch", sa.String(length=64)))


def downgrade() -> None:
    """Undo the change."""
    op.drop_column("jobs", "last_batch")
