"""Add the token that a token was made with.

Revision: 0017
Revises: 0016
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    op.add_column("tokens", sa.Column("parent_id", sa.String(64)))
    op.create_index("ix_tokens_parent_id", "tokens", ["parent_id"])
    op.create_foreign_key(
        op.f("fk_tokens_parent_id_tokens"), "tokens", "tokens", ["parent_id"], ["id"], ondelete="CASCADE"
    )


def downgrade() -> None:
    """Undo the change."""
    op.drop_constraint(op.f("fk_tokens_parent_id_tokens"), "tokens", type_="foreignkey")
    op.drop_index("ix_tokens_parent_id", "tokens")
    op.drop_column("tokens", "parent_id")
