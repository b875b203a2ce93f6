"""Drop what other columns say: the queue of work and of workers, which is their simulator, and the request to pause.

Revision: 0022
Revises: 0021
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0022"
down_revision = "0021"
branch_labels = None
depends_on = None


def index_waiting(first: str) -> None:
    """Index the waiting work of both tables, by this column first."""
    for table in ("jobs", "evaluations"):
        op.drop_index(f"ix_{table}_waiting", table)
        columns = [first, sa.literal_column("priority DESC"), "queued_at"]
        op.create_index(f"ix_{table}_waiting", table, columns, postgresql_where=sa.text("state = 'queued'"))


def upgrade() -> None:
    """Apply the change."""
    index_waiting("simulator")
    for table in ("jobs", "evaluations"):
        op.drop_column(table, "queue")
    op.drop_column("jobs", "pause_requested")
    op.drop_column("workers", "queues")


def downgrade() -> None:
    """Undo the change."""
    for table in ("jobs", "evaluations"):
        op.add_column(table, sa.Column("queue", sa.String(40)))
        op.execute(f"UPDATE {table} SET queue = simulator")  # noqa: S608 - two fixed names
        op.alter_column(table, "queue", nullable=False)
    index_waiting("queue")
    pause_requested = sa.Column("pause_requested", sa.Boolean(), server_default=sa.text("false"), nullable=False)
    op.add_column("jobs", pause_requested)
    op.execute("UPDATE jobs SET pause_requested = true WHERE state = 'pausing'")
    op.add_column("workers", sa.Column("queues", postgresql.ARRAY(sa.Text())))
    op.execute("UPDATE workers SET queues = ARRAY(SELECT jsonb_array_elements_text(simulators))")
    op.alter_column("workers", "queues", nullable=False)
