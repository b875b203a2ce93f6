"""Give jobs and evaluations one life cycle, and record requirements of work and capabilities of workers.

Revision: 0002
Revises: 0001
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

JSONB = postgresql.JSONB(astext_type=sa.Text())

EVALUATION_STATES = ("cancelled", "failed", "queued", "running", "starting", "succeeded")
LEASED = ("evaluating", "pausing", "running", "starting")


def in_list(values: tuple[str, ...]) -> str:
    """Return an SQL condition on the state."""
    return f"state IN ({', '.join(repr(value) for value in values)})"


def upgrade() -> None:
    """Apply the change."""
    for table in ("jobs", "evaluations"):
        op.add_column(table, sa.Column("task", sa.String(length=100)))
        op.add_column(table, sa.Column("task_version", sa.Integer()))
        op.add_column(table, sa.Column("robot", sa.String(length=100)))
        op.add_column(table, sa.Column("simulator", sa.String(length=100)))
    # Until now every job was for a NAO, every task had one version, and a queue was named like its simulator.
    op.execute(
        "UPDATE jobs SET task = spec->>'task', task_version = 1, "
        "robot = 'nao-' || coalesce(spec->>'robot_type', '0'), simulator = queue"
    )
    op.execute(
        "UPDATE evaluations SET task = evaluations.spec->>'task', task_version = 1, robot = jobs.robot, "
        "simulator = evaluations.queue FROM jobs WHERE jobs.id = evaluations.job_id"
    )
    for table in ("jobs", "evaluations"):
        for column in ("task", "task_version", "robot", "simulator"):
            op.alter_column(table, column, nullable=False)
        op.drop_column(table, "rung_at")

    op.add_column("evaluations", sa.Column("priority", sa.Integer(), server_default=sa.text("5"), nullable=False))
    op.add_column("evaluations", sa.Column("failures", sa.Integer(), server_default=sa.text("0"), nullable=False))
    op.add_column(
        "evaluations", sa.Column("cancel_requested", sa.Boolean(), server_default=sa.text("false"), nullable=False)
    )
    op.add_column("evaluations", sa.Column("time_limit_s", sa.Double(), server_default=sa.text("21600"), nullable=False))
    for column in ("heartbeat_at", "queued_at", "started_at"):
        op.add_column("evaluations", sa.Column(column, sa.DateTime(timezone=True)))
    op.add_column(
        "evaluations",
        sa.Column("updated_at", sa.DateTime(timezone=True), server_default=sa.text("now()"), nullable=False),
    )
    op.execute("UPDATE evaluations SET queued_at = created_at")
    op.drop_index("ix_evaluations_open", "evaluations")
    op.drop_constraint("ck_evaluations_lease_fits_state", "evaluations", type_="check")
    op.drop_constraint("ck_evaluations_state_known", "evaluations", type_="check")
    op.create_check_constraint("ck_evaluations_state_known", "evaluations", in_list(EVALUATION_STATES))
    op.create_check_constraint("ck_evaluations_priority_range", "evaluations", "priority BETWEEN 0 AND 9")
    op.create_check_constraint(
        "ck_evaluations_lease_fits_state", "evaluations", f"({in_list(LEASED)}) = (lease_owner IS NOT NULL)"
    )
    op.create_index(
        "ix_evaluations_leases",
        "evaluations",
        ["lease_expires_at"],
        postgresql_where=sa.text("lease_owner IS NOT NULL"),
    )
    op.create_index(
        "ix_evaluations_waiting",
        "evaluations",
        ["queue", sa.literal_column("priority DESC"), "queued_at"],
        postgresql_where=sa.text("state = 'queued'"),
    )

    for column, empty in (("tasks", "{}"), ("robots", "[]"), ("simulators", "[]")):
        op.add_column("workers", sa.Column(column, JSONB, server_default=sa.text(f"'{empty}'"), nullable=False))


def downgrade() -> None:
    """Undo the change."""
    for column in ("tasks", "robots", "simulators"):
        op.drop_column("workers", column)

    op.drop_index("ix_evaluations_waiting", "evaluations")
    op.drop_index("ix_evaluations_leases", "evaluations")
    op.drop_constraint("ck_evaluations_lease_fits_state", "evaluations", type_="check")
    op.drop_constraint("ck_evaluations_priority_range", "evaluations", type_="check")
    op.drop_constraint("ck_evaluations_state_known", "evaluations", type_="check")
    op.execute("UPDATE evaluations SET state = 'failed', error = 'cancelled' WHERE state = 'cancelled'")
    op.execute("UPDATE evaluations SET state = 'running' WHERE state = 'starting'")
    op.create_check_constraint(
        "ck_evaluations_state_known", "evaluations", in_list(("queued", "running", "succeeded", "failed"))
    )
    op.create_check_constraint(
        "ck_evaluations_lease_fits_state", "evaluations", "(state = 'running') = (lease_owner IS NOT NULL)"
    )
    op.create_index(
        "ix_evaluations_open", "evaluations", ["state"], postgresql_where=sa.text("state IN ('queued', 'running')")
    )
    for column in ("priority", "failures", "cancel_requested", "time_limit_s"):
        op.drop_column("evaluations", column)
    for column in ("heartbeat_at", "queued_at", "started_at", "updated_at"):
        op.drop_column("evaluations", column)

    for table in ("jobs", "evaluations"):
        op.add_column(table, sa.Column("rung_at", sa.DateTime(timezone=True)))
        for column in ("task", "task_version", "robot", "simulator"):
            op.drop_column(table, column)
