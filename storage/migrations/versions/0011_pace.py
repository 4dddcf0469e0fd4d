"""How jobs went in time, for what later ones of their kind tell of the time left."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column, empty for jobs of before, and the index that finds the last jobs of a kind."""
    op.add_column("jobs", sa.Column("pace", sa.JSON(), nullable=True))
    op.create_index("ix_jobs_kind_state_created_at", "jobs", ["kind", "state", "created_at"])


def downgrade() -> None:
    """Remove both."""
    op.drop_index("ix_jobs_kind_state_created_at", table_name="jobs")
    with op.batch_alter_table("jobs") as batch:
        batch.drop_column("pace")
