"""``python -m physworld_services.trainer [--name trainer]``: one trainer process."""

from __future__ import annotations

import argparse
import os
import sys


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line and serve."""
    parser = argparse.ArgumentParser(prog="python -m physworld_services.trainer", description=__doc__)
    parser.add_argument(
        "--name", default="trainer", help="name of this trainer on its host (default: trainer)"
    )
    options = parser.parse_args(arguments)
    # Before NumPy is there: its threads spin beside torch's, and beside the workers on the same host.
    os.environ.setdefault("OMP_NUM_THREADS", os.environ.get("PHYSWORLD_TRAINER_THREADS", "1"))
    from physworld_services.trainer.app import serve
    from physworld_storage.settings import get_settings

    settings = get_settings()
    settings.check()
    return serve(settings, options.name)


if __name__ == "__main__":
    sys.exit(main())
