"""Give the database a generation, and leases that of the database that gave them.

Revision: 0016
Revises: 0014
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0014"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    op.create_table(
        "generations",
        sa.Column("id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.CheckConstraint("id = 1", name=op.f("ck_generations_one_row")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_generations")),
    )
    op.execute("INSERT INTO generations (id, key) VALUES (1, gen_random_uuid()::text)")
    for table in ("jobs", "evaluations"):
        op.add_column(table, sa.Column("lease_generation", sa.String(80)))


def downgrade() -> None:
    """Undo the change."""
    for table in ("evaluations", "jobs"):
        op.drop_column(table, "lease_generation")
    op.drop_table("generations")
