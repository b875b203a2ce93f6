"""Record which jobs start from the policy of another one, even after that one is deleted.

Revision: 0003
Revises: 0002
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    op.add_column("jobs", sa.Column("needs_policy", sa.Boolean(), server_default=sa.text("false"), nullable=False))
    op.execute("UPDATE jobs SET needs_policy = true WHERE parent_job_id IS NOT NULL")


def downgrade() -> None:
    """Undo the change."""
    op.drop_column("jobs", "needs_policy")
