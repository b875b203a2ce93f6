"""Container images of teams.

Revision: 0028
Revises: 0027
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0028"
down_revision = "0027"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Apply the change. Teams that are there count as teams without an image; they can be uploaded again."""
    op.add_column("teams", sa.Column("image", sa.String(255)))


def downgrade() -> None:
    """Undo the change."""
    op.drop_column("teams", "image")
