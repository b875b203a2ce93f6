"""Count what jobs store, for quotas.

Revision: 0008
Revises: 0007
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

_SIZE = "(SELECT coalesce(sum((file->>'size')::bigint), 0) FROM jsonb_array_elements(manifest->'files') AS file)"
_ROWS = " + ".join(f"(SELECT count(*) FROM {table} WHERE job_id = jobs.id)" for table in ("metrics", "logs", "events"))


def upgrade() -> None:
    """Apply the change."""
    for table, column in (("jobs", "row_count"), ("checkpoints", "size"), ("evaluations", "size")):
        op.add_column(table, sa.Column(column, sa.BigInteger(), server_default=sa.text("0"), nullable=False))
    op.execute(f"UPDATE jobs SET row_count = {_ROWS}")
    for table in ("checkpoints", "evaluations"):
        op.execute(f"UPDATE {table} SET size = {_SIZE} WHERE jsonb_typeof(manifest->'files') = 'array'")


def downgrade() -> None:
    """Undo the change."""
    for table, column in (("jobs", "row_count"), ("checkpoints", "size"), ("evaluations", "size")):
        op.drop_column(table, column)
