"""Tags of matches and evaluations; keys of requests for evaluations, and the report that one asks for.

Revision: 0027
Revises: 0026
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0027"
down_revision = "0026"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    for table in ("evaluations", "matches"):
        none = sa.text("'{}'")
        op.add_column(table, sa.Column("tags", postgresql.ARRAY(sa.Text()), server_default=none, nullable=False))
    op.add_column("evaluations", sa.Column("report", sa.String(20)))
    op.add_column("evaluations", sa.Column("idempotency_key", sa.String(200)))
    op.add_column("evaluations", sa.Column("idempotency_digest", sa.String(64)))
    op.create_unique_constraint(
        op.f("uq_evaluations_job_id_idempotency_key"), "evaluations", ["job_id", "idempotency_key"]
    )


def downgrade() -> None:
    """Undo the change."""
    op.drop_constraint(op.f("uq_evaluations_job_id_idempotency_key"), "evaluations", type_="unique")
    for column in ("idempotency_digest", "idempotency_key", "report"):
        op.drop_column("evaluations", column)
    for table in ("evaluations", "matches"):
        op.drop_column(table, "tags")
