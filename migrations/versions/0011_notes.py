"""Add notes to jobs, and tokens that give access to one job.

Revision: 0011
Revises: 0010
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    op.add_column("jobs", sa.Column("notes", sa.Text(), nullable=False, server_default=sa.text("''")))
    op.add_column("tokens", sa.Column("job_id", sa.String(length=64)))
    op.create_index("ix_tokens_job_id", "tokens", ["job_id"])
    op.create_foreign_key("fk_tokens_job_id_jobs", "tokens", "jobs", ["job_id"], ["id"], ondelete="CASCADE")


def downgrade() -> None:
    """Undo the change."""
    op.drop_constraint("fk_tokens_job_id_jobs", "tokens", type_="foreignkey")
    op.drop_index("ix_tokens_job_id", "tokens")
    op.drop_column("tokens", "job_id")
    op.drop_column("jobs", "notes")
