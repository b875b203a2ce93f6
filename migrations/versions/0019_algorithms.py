"""Record the algorithm that a worker must have to run a job or an evaluation, and those that a worker has.

Revision: 0019
Revises: 0018
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    for table in ("jobs", "evaluations"):
        op.add_column(table, sa.Column("algorithm", sa.String(100)))
    op.execute("UPDATE jobs SET algorithm = coalesce(spec -> 'algorithm' ->> 'name', 'ppo')")
    op.execute("UPDATE evaluations SET algorithm = jobs.algorithm FROM jobs WHERE jobs.id = evaluations.job_id")
    for table in ("jobs", "evaluations"):
        op.alter_column(table, "algorithm", nullable=False)
    algorithms = sa.Column("algorithms", postgresql.JSONB, server_default=sa.text("'[]'"), nullable=False)
    op.add_column("workers", algorithms)


def downgrade() -> None:
    """Undo the change."""
    op.drop_column("workers", "algorithms")
    for table in ("evaluations", "jobs"):
        op.drop_column(table, "algorithm")
