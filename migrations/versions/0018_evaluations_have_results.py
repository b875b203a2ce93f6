"""Require the result of an evaluation that has succeeded; those without one have failed.

Revision: 0018
Revises: 0017
"""

from __future__ import annotations

from alembic import op

revision = "0018"
down_revision = "0017"
branch_labels = None
depends_on = None

_CONSTRAINT = "succeeded_has_result"


def upgrade() -> None:
    """Apply the change."""
    op.execute(
        "UPDATE evaluations SET state = 'failed', error = 'it ended without a result; evaluate the checkpoint again' "
        "WHERE state = 'succeeded' AND (summary IS NULL OR key IS NULL OR manifest IS NULL)"
    )
    op.create_check_constraint(
        _CONSTRAINT,
        "evaluations",
        "state <> 'succeeded' OR (summary IS NOT NULL AND key IS NOT NULL AND manifest IS NOT NULL)",
    )


def downgrade() -> None:
    """Undo the change."""
    op.drop_constraint(_CONSTRAINT, "evaluations", type_="check")
