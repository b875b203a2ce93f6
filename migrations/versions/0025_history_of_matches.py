"""History and log of matches, which wait in a queue of their own.

Revision: 0025
Revises: 0024
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0025"
down_revision = "0024"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    op.create_table(
        "match_events",
        sa.Column("id", sa.BigInteger(), sa.Identity(), nullable=False),
        sa.Column("match_id", sa.String(64), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
        sa.Column("kind", sa.String(40), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("message", sa.Text(), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_match_events"),
        sa.ForeignKeyConstraint(["match_id"], ["matches.id"], name="fk_match_events_match_id", ondelete="CASCADE"),
    )
    op.create_index("ix_match_events_match_id_id", "match_events", ["match_id", "id"])
    op.execute("UPDATE matches SET simulator = 'match'")


def downgrade() -> None:
    """Undo the change."""
    op.execute("UPDATE matches SET simulator = 'embedded'")
    op.drop_table("match_events")
