"""Traces and assessments; datasets and model versions name the trace whose twin they come from."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

UTC_TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    """Add two tables and two columns."""
    op.create_table(
        "traces",
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("scene_id", sa.String(), nullable=False),
        sa.Column("fit_id", sa.String(), nullable=True),
        sa.Column("state", sa.String(), nullable=False),
        sa.Column("created_at", UTC_TIME, nullable=False),
        sa.Column("job_id", sa.String(), nullable=False),
        sa.Column("config", sa.JSON(), nullable=False),
        sa.Column("fit", sa.JSON(), nullable=False),
        sa.Column("verdict", sa.String(), nullable=True),
        sa.Column("report", sa.JSON(), nullable=False),
        sa.Column("lineage", sa.JSON(), nullable=False),
        sa.Column("artifacts", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["scene_id"], ["scenes.id"], name="fk_traces_scene_id"),
        sa.ForeignKeyConstraint(["fit_id"], ["fits.id"], name="fk_traces_fit_id"),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name="fk_traces_job_id"),
        sa.PrimaryKeyConstraint("id", name="pk_traces"),
    )
    op.create_index("ix_traces_created_at", "traces", ["created_at"])
    op.create_index("ix_traces_scene_id", "traces", ["scene_id"])
    op.create_table(
        "assessments",
        sa.Column("id", sa.String(), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("scene_id", sa.String(), nullable=False),
        sa.Column("state", sa.String(), nullable=False),
        sa.Column("created_at", UTC_TIME, nullable=False),
        sa.Column("job_id", sa.String(), nullable=False),
        sa.Column("config", sa.JSON(), nullable=False),
        sa.Column("figures", sa.JSON(), nullable=False),
        sa.Column("trace_id", sa.String(), nullable=True),
        sa.Column("lineage", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(
            ["name", "version"],
            ["model_versions.name", "model_versions.version"],
            name="fk_assessments_name_version",
        ),
        sa.ForeignKeyConstraint(["scene_id"], ["scenes.id"], name="fk_assessments_scene_id"),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name="fk_assessments_job_id"),
        sa.PrimaryKeyConstraint("id", name="pk_assessments"),
    )
    op.create_index(
        "ix_assessments_name_version_created_at", "assessments", ["name", "version", "created_at"]
    )
    op.add_column("datasets", sa.Column("trace_id", sa.String(), nullable=True))
    op.add_column("model_versions", sa.Column("trace_id", sa.String(), nullable=True))


def downgrade() -> None:
    """Take them away."""
    op.drop_column("model_versions", "trace_id")
    op.drop_column("datasets", "trace_id")
    op.drop_index("ix_assessments_name_version_created_at", table_name="assessments")
    op.drop_table("assessments")
    op.drop_index("ix_traces_scene_id", table_name="traces")
    op.drop_index("ix_traces_created_at", table_name="traces")
    op.drop_table("traces")
