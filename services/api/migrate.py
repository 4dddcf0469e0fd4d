"""Bring the database to this code's tables and register the first API key; run once before the web process.

``python -m physworld_services.api.migrate``. The key's token is PHYSWORLD_ADMIN_TOKEN, a secret of the deployment;
without the variable no key is registered. Running it again changes nothing. A token whose key was revoked or rotated
away stays ended and keeps nothing from starting: that is said, with the command that makes another key.
"""

from __future__ import annotations

import os
import sys

from physworld_services.api.recover_key import COMMAND
from physworld_storage.access.api_keys import count_active_admins, ensure_key
from physworld_storage.database import Database, open_database
from physworld_storage.errors import KeyEnded, StorageError
from physworld_storage.settings import get_settings

ADMIN_TOKEN = "PHYSWORLD_ADMIN_TOKEN"


def main() -> int:
    """Migrate; 0 when the database is ready."""
    try:
        settings = get_settings()
        settings.check(broker=False)
        database = open_database(settings)
        database.upgrade()
        print(f"database at revision {database.revision()}")
        token = os.environ.get(ADMIN_TOKEN)
        if token:
            print(_registered(database, token))
        database.dispose()
    except StorageError as error:
        print(f"migration failed: {error.code}: {error}", file=sys.stderr)
        return 1
    return 0


def _registered(database: Database, token: str) -> str:
    """Register the deployment's key; what became of it, in words. Raises Conflict for a token that cannot be one."""
    try:
        with database.session() as session:
            key = ensure_key(session, token, "deployment", "admin")
    except KeyEnded as error:
        with database.reading() as session:
            admins = count_active_admins(session)
        return (
            f"{ADMIN_TOKEN} is not registered again: {error}. Admin keys that are good: {admins}. "
            f"Another one is made by: {COMMAND} (with docker compose: docker compose run --rm migrate {COMMAND})"
        )
    return f"key {key.id} ({key.role}) is registered"


if __name__ == "__main__":
    sys.exit(main())
