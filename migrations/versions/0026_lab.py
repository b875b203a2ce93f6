"""Draining of workers, preemption, software of jobs, use by owner, extended studies, trials that run elsewhere.

Revision: 0026
Revises: 0025
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0026"
down_revision = "0025"
branch_labels = None
depends_on = None

TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    """Apply the change."""
    op.add_column("workers", sa.Column("drained_at", TIME))
    op.add_column("jobs", sa.Column("yields_to", sa.String(200)))
    op.add_column(
        "jobs", sa.Column("software", postgresql.JSONB(), server_default=sa.text("'{}'"), nullable=False)
    )
    op.add_column("studies", sa.Column("extended_at", sa.Integer(), server_default=sa.text("0"), nullable=False))
    op.add_column("trials", sa.Column("asked_at", TIME))
    op.create_table(
        "usage",
        sa.Column("owner", sa.String(200), nullable=False),
        sa.Column("day", sa.Date(), nullable=False),
        sa.Column("cpu_s", sa.Double(), nullable=False),
        sa.Column("run_s", sa.Double(), nullable=False),
        sa.PrimaryKeyConstraint("owner", "day", name=op.f("pk_usage")),
    )


def downgrade() -> None:
    """Undo the change."""
    op.drop_table("usage")
    op.drop_column("trials", "asked_at")
    op.drop_column("studies", "extended_at")
    op.drop_column("jobs", "software")
    op.drop_column("jobs", "yields_to")
    op.drop_column("workers", "drained_at")
