"""Add registered policies with their versions and aliases, and the registered policy that a job starts from.

Revision: 0013
Revises: 0012
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    now = sa.text("now()")
    op.create_table(
        "policies",
        sa.Column("id", sa.String(64), nullable=False),
        sa.Column("owner", sa.String(200), nullable=False),
        sa.Column("name", sa.String(60), nullable=False),
        sa.Column("last_number", sa.Integer(), server_default=sa.text("0"), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=now, nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_policies")),
        sa.UniqueConstraint("owner", "name", name=op.f("uq_policies_owner_name")),
    )
    op.create_table(
        "policy_versions",
        sa.Column("policy_id", sa.String(64), nullable=False),
        sa.Column("number", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("checkpoint_id", sa.String(64), nullable=False),
        sa.Column("notes", sa.Text(), nullable=False),
        sa.Column("spec", postgresql.JSONB(), nullable=False),
        sa.Column("spec_sha256", sa.String(64), nullable=False),
        sa.Column("lineage", postgresql.JSONB(), nullable=False),
        sa.Column("idempotency_key", sa.String(200)),
        sa.Column("idempotency_digest", sa.String(64)),
        sa.Column("created_at", sa.DateTime(timezone=True), server_default=now, nullable=False),
        sa.ForeignKeyConstraint(
            ["policy_id"], ["policies.id"], name=op.f("fk_policy_versions_policy_id_policies"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(
            ["checkpoint_id"],
            ["checkpoints.id"],
            name=op.f("fk_policy_versions_checkpoint_id_checkpoints"),
            ondelete="RESTRICT",
        ),
        sa.PrimaryKeyConstraint("policy_id", "number", name=op.f("pk_policy_versions")),
        sa.UniqueConstraint("policy_id", "checkpoint_id", name=op.f("uq_policy_versions_policy_id_checkpoint_id")),
        sa.UniqueConstraint("policy_id", "idempotency_key", name=op.f("uq_policy_versions_policy_id_idempotency_key")),
    )
    op.create_index("ix_policy_versions_checkpoint_id", "policy_versions", ["checkpoint_id"])
    op.create_table(
        "policy_aliases",
        sa.Column("policy_id", sa.String(64), nullable=False),
        sa.Column("name", sa.String(60), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(
            ["policy_id", "number"],
            ["policy_versions.policy_id", "policy_versions.number"],
            name=op.f("fk_policy_aliases_policy_id_number_policy_versions"),
            ondelete="CASCADE",
        ),
        sa.PrimaryKeyConstraint("policy_id", "name", name=op.f("pk_policy_aliases")),
    )
    op.add_column("jobs", sa.Column("parent_policy", sa.String(130)))


def downgrade() -> None:
    """Undo the change."""
    op.drop_column("jobs", "parent_policy")
    op.drop_table("policy_aliases")
    op.drop_table("policy_versions")
    op.drop_table("policies")
