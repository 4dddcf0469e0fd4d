"""Make an admin key when no other is left: ``python -m physworld_services.api.recover_key [--data DIR] [--name NAME]``.

It needs what the service itself has, the database (the data folder, or PHYSWORLD_DATABASE_URL), and no key. The token
is printed once. The key has no end and stands in the audit log as ``key.recovered``. The service may run meanwhile.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from physworld_storage.access import api_keys, audit
from physworld_storage.access.audit import LOCAL
from physworld_storage.database import open_database
from physworld_storage.errors import StorageError
from physworld_storage.settings import Settings

COMMAND = "python -m physworld_services.api.recover_key"


def main(arguments: list[str] | None = None) -> int:
    """Make the key; 0 when it is there."""
    parser = argparse.ArgumentParser(prog=COMMAND, description="Make an admin key when no other is left.")
    parser.add_argument("--data", type=Path, default=None, help="data folder (default: PHYSWORLD_DATA_DIR)")
    parser.add_argument("--name", default="recovered", help="name of the key (default: recovered)")
    given = parser.parse_args(arguments)
    try:
        settings = Settings() if given.data is None else Settings(data_dir=given.data)
        settings.check(broker=False)
        database = open_database(settings)
        database.check()
        with database.session() as session:
            key, token = api_keys.create_key(session, given.name, "admin")
            audit.record(session, LOCAL, "key.recovered", key.id)
        database.dispose()
    except StorageError as error:
        print(f"no key was made: {error.code}: {error}", file=sys.stderr)
        return 1
    print(f"key {key.id} (admin, without an end); its token, shown this once:", file=sys.stderr)
    print(token)
    return 0


if __name__ == "__main__":
    sys.exit(main())
