"""Record stalled work, the free disk space of workers, and backups.

Revision: 0007
Revises: 0006
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    for table in ("jobs", "evaluations"):
        op.add_column(table, sa.Column("stalled_since", sa.DateTime(timezone=True)))
    op.add_column("workers", sa.Column("disk_free_bytes", sa.BigInteger()))
    op.create_table(
        "backups",
        sa.Column("id", sa.BigInteger(), sa.Identity(), nullable=False),
        sa.Column("started_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("finished_at", sa.DateTime(timezone=True)),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_backups")),
    )


def downgrade() -> None:
    """Undo the change."""
    op.drop_table("backups")
    op.drop_column("workers", "disk_free_bytes")
    for table in ("evaluations", "jobs"):
        op.drop_column(table, "stalled_since")
