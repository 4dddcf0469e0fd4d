"""Alembic migrations of the database; applied by ``storage.database.Database.upgrade``."""
