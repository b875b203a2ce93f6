"""Tokens of webhooks, and checkpoints of studies that start from a policy.

Revision: 0030
Revises: 0029
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0030"
down_revision = "0029"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    op.add_column("webhooks", sa.Column("token_id", sa.String(64)))
    op.create_index("ix_webhooks_token_id", "webhooks", ["token_id"])
    op.create_foreign_key(
        op.f("fk_webhooks_token_id_tokens"), "webhooks", "tokens", ["token_id"], ["id"], ondelete="CASCADE"
    )
    op.execute(
        "UPDATE studies SET job = job || jsonb_build_object('parent_checkpoint_id', v.checkpoint_id) "
        "FROM policies AS p JOIN policy_versions AS v ON v.policy_id = p.id "
        "WHERE p.owner = studies.owner AND p.name || '@' || v.number = studies.job->>'parent_policy'"
    )


def downgrade() -> None:
    """Undo the change; a study's checkpoint beside its policy harms no older version."""
    op.drop_constraint(op.f("fk_webhooks_token_id_tokens"), "webhooks", type_="foreignkey")
    op.drop_index("ix_webhooks_token_id", "webhooks")
    op.drop_column("webhooks", "token_id")
