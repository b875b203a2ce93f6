"""Requirements of aliases: results that a version of a policy needs before an alias names it.

Revision: 0023
Revises: 0022
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql

revision = "0023"
down_revision = "0022"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change."""
    requirements = sa.Column("requirements", postgresql.JSONB(), server_default=sa.text("'{}'"), nullable=False)
    op.add_column("policies", requirements)


def downgrade() -> None:
    """Undo the change."""
    op.drop_column("policies", "requirements")
