"""Bring the database to this code's tables and register the first API key; run once before the web process.

``python -m services.api.migrate``. The key's token is PHYSWORLD_ADMIN_TOKEN, a secret of the deployment;
without the variable no key is registered. Running it again changes nothing.
"""

from __future__ import annotations

import os
import sys

from storage.api_keys import ensure_key
from storage.database import open_database
from storage.errors import StorageError
from storage.settings import get_settings

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
            with database.session() as session:
                key = ensure_key(session, token, "deployment", "admin")
            print(f"key {key.id} ({key.role}) is registered")
        database.dispose()
    except StorageError as error:
        print(f"migration failed: {error.code}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
