"""Alembic migrations of the database; applied by ``physworld_storage.database.Database.upgrade``."""
