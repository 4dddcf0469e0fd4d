"""Alembic's environment: runs on the connection that ``Database.upgrade`` hands over, in its transaction."""

from __future__ import annotations

from alembic import context
from sqlalchemy import text

from physworld_storage.tables import Base

UPGRADE_LOCK = 0x70687973  # "phys": one upgrade at a time on Postgres; SQLite's BEGIN IMMEDIATE does the same

connection = context.config.attributes["connection"]
if connection.dialect.name == "postgresql":
    connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": UPGRADE_LOCK})
context.configure(connection=connection, target_metadata=Base.metadata, render_as_batch=True)
context.run_migrations()
