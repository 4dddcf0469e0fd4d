"""``python -m physworld_workers``: one worker process for the simulation queue (or another, ``--queue``)."""

from __future__ import annotations

import argparse
import os
import sys


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line and serve."""
    parser = argparse.ArgumentParser(prog="python -m physworld_workers", description=__doc__)
    parser.add_argument("--queue", default="sim", help="queue to consume (default: sim)")
    parser.add_argument("--name", default="sim", help="name of this worker on its host (default: sim)")
    options = parser.parse_args(arguments)
    # One thread per worker process: the number of worker processes is what uses the cores.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from physworld_storage.settings import get_settings
    from physworld_workers.app import run_worker

    settings = get_settings()
    settings.check()
    return run_worker(settings, options.queue, options.name)


if __name__ == "__main__":
    sys.exit(main())
