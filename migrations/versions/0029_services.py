"""Key of the service, and rows of matches.

Revision: 0029
Revises: 0028
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0029"
down_revision = "0028"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change. The store becomes this service's with the next sweep, if it has a file that a row refers to."""
    op.create_table(
        "services",
        sa.Column("id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("key", sa.Text(), nullable=False),
        sa.CheckConstraint("id = 1", name=op.f("ck_services_one_row")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_services")),
    )
    op.execute("INSERT INTO services (id, key) VALUES (1, gen_random_uuid()::text)")
    op.add_column("matches", sa.Column("row_count", sa.BigInteger(), server_default="0", nullable=False))
    op.execute(
        "UPDATE matches SET row_count = found.n "
        "FROM (SELECT match_id, count(*) AS n FROM match_events GROUP BY match_id) AS found "
        "WHERE found.match_id = matches.id"
    )


def downgrade() -> None:
    """Undo the change."""
    op.drop_column("matches", "row_count")
    op.drop_table("services")
