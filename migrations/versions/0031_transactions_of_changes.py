"""Transactions of the changes of jobs.

Revision: 0031
Revises: 0030
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0031"
down_revision = "0030"
branch_labels = None
depends_on = None

_TRANSACTION = "pg_catalog.pg_current_xact_id()::text::bigint"


def upgrade() -> None:
    """Apply the change."""
    op.add_column("jobs", sa.Column("changed_in", sa.BigInteger(), server_default=sa.text("0"), nullable=False))
    op.alter_column("jobs", "changed_in", server_default=sa.text(_TRANSACTION))
    op.create_index("ix_jobs_changed_in", "jobs", ["changed_in", "id"])
    op.execute(
        "CREATE FUNCTION note_transaction() RETURNS trigger LANGUAGE plpgsql AS "
        f"$$ BEGIN NEW.changed_in := {_TRANSACTION}; RETURN NEW; END $$"
    )
    op.execute(
        "CREATE TRIGGER note_transaction BEFORE UPDATE OF updated_at ON jobs "
        "FOR EACH ROW EXECUTE FUNCTION note_transaction()"
    )


def downgrade() -> None:
    """Undo the change."""
    op.execute("DROP TRIGGER note_transaction ON jobs")
    op.execute("DROP FUNCTION note_transaction()")
    op.drop_index("ix_jobs_changed_in", "jobs")
    op.drop_column("jobs", "changed_in")
