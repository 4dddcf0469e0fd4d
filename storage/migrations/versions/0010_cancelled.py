"""What a cancelled job should have made is cancelled, not failed."""

from __future__ import annotations

from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

MADE = ("fits", "traces", "checks", "videos", "datasets", "model_versions", "assessments", "model_runs")
"""Tables of what jobs make."""


def upgrade() -> None:
    """Tell the cancelled ones from those that have failed."""
    for table in MADE:
        op.execute(
            f"UPDATE {table} SET state = 'cancelled' WHERE state = 'failed'"  # nosec B608
            " AND job_id IN (SELECT id FROM jobs WHERE state = 'cancelled')"
        )


def downgrade() -> None:
    """As before there was the state."""
    for table in MADE:
        op.execute(f"UPDATE {table} SET state = 'failed' WHERE state = 'cancelled'")  # nosec B608
