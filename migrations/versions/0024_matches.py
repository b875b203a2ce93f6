"""Matches with their games, and uploaded teams.

Revision: 0024
Revises: 0023
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0024"
down_revision = "0023"
branch_labels = None
depends_on = None

JSON, TIME = postgresql.JSONB(), sa.DateTime(timezone=True)
LEASED = "'evaluating', 'pausing', 'running', 'starting'"


def column(name: str, kind: sa.types.TypeEngine, default: str | None = None, *, null: bool = False) -> sa.Column:
    """Return a column, by default one that needs a value."""
    return sa.Column(name, kind, server_default=None if default is None else sa.text(default), nullable=null)


def upgrade() -> None:
    """Apply the change."""
    op.create_table(
        "matches",
        column("id", sa.String(64)),
        column("owner", sa.String(200)),
        column("spec", JSON),
        column("priority", sa.Integer(), "5"),
        column("task", sa.String(100)),
        column("task_version", sa.Integer()),
        column("robot", sa.String(100)),
        column("simulator", sa.String(100)),
        column("algorithm", sa.String(100)),
        column("state", sa.String(20)),
        column("attempt", sa.Integer(), "0"),
        column("failures", sa.Integer(), "0"),
        column("postponed", sa.Integer(), "0"),
        column("not_before", TIME, null=True),
        column("max_attempts", sa.Integer(), "3"),
        column("lease_owner", sa.String(200), null=True),
        column("lease_generation", sa.String(80), null=True),
        column("lease_expires_at", TIME, null=True),
        column("heartbeat_at", TIME, null=True),
        column("stalled_since", TIME, null=True),
        column("cancel_requested", sa.Boolean(), "false"),
        column("error", sa.Text(), null=True),
        column("created_at", TIME, "now()"),
        column("queued_at", TIME, null=True),
        column("started_at", TIME, null=True),
        column("finished_at", TIME, null=True),
        column("updated_at", TIME, "now()"),
        column("idempotency_key", sa.String(200), null=True),
        column("idempotency_digest", sa.String(64), null=True),
        column("summary", JSON, null=True),
        column("live", JSON, null=True),
        column("size", sa.BigInteger(), "0"),
        sa.PrimaryKeyConstraint("id", name="pk_matches"),
        sa.UniqueConstraint("owner", "idempotency_key", name="uq_matches_owner_idempotency_key"),
        sa.CheckConstraint(
            "state IN ('cancelled', 'failed', 'queued', 'running', 'starting', 'succeeded')",
            name="ck_matches_state_known",
        ),
        sa.CheckConstraint("priority BETWEEN 0 AND 9", name="ck_matches_priority_range"),
        sa.CheckConstraint(
            f"(state IN ({LEASED})) = (lease_owner IS NOT NULL)", name="ck_matches_lease_fits_state"
        ),
    )
    op.create_index("ix_matches_owner_id", "matches", ["owner", sa.text("id DESC")])
    op.create_index(
        "ix_matches_waiting",
        "matches",
        ["simulator", sa.text("priority DESC"), "queued_at"],
        postgresql_where=sa.text("state = 'queued'"),
    )
    op.create_index(
        "ix_matches_leases", "matches", ["lease_expires_at"], postgresql_where=sa.text("lease_owner IS NOT NULL")
    )
    op.create_table(
        "games",
        column("match_id", sa.String(64)),
        column("number", sa.Integer()),
        column("goals", postgresql.ARRAY(sa.Integer())),
        column("lost", JSON),
        column("key", sa.Text()),
        column("manifest", JSON),
        column("finished_at", TIME, "now()"),
        sa.PrimaryKeyConstraint("match_id", "number", name="pk_games"),
        sa.ForeignKeyConstraint(["match_id"], ["matches.id"], name="fk_games_match_id", ondelete="CASCADE"),
    )
    op.create_table(
        "teams",
        column("id", sa.String(64)),
        column("owner", sa.String(200)),
        column("name", sa.String(60)),
        column("key", sa.Text()),
        column("manifest", JSON),
        column("size", sa.BigInteger()),
        column("created_at", TIME, "now()"),
        sa.PrimaryKeyConstraint("id", name="pk_teams"),
        sa.UniqueConstraint("owner", "name", name="uq_teams_owner_name"),
    )


def downgrade() -> None:
    """Undo the change."""
    for table in ("teams", "games", "matches"):
        op.drop_table(table)
