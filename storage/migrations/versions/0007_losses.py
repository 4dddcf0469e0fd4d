"""Losses of a shard apart from its failures, and where it was when it was lost."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

UTC_TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    """Add the columns; shards of before have neither failed nor been lost."""
    op.add_column("shards", sa.Column("failures", sa.Integer(), nullable=False, server_default="0"))
    op.add_column("shards", sa.Column("claimed_at", UTC_TIME, nullable=True))
    op.add_column("shards", sa.Column("renewed_at", UTC_TIME, nullable=True))
    op.add_column("shards", sa.Column("progress", sa.JSON(), nullable=True))
    op.add_column("shards", sa.Column("losses", sa.JSON(), nullable=True))


def downgrade() -> None:
    """Remove the columns."""
    with op.batch_alter_table("shards") as batch:
        for column in ("losses", "progress", "renewed_at", "claimed_at", "failures"):
            batch.drop_column(column)
