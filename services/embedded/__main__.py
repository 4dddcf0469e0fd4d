"""``python -m physworld_services.embedded --data DIR [--workers 2] [--port 0]``: the whole service on this machine.

Exit codes: 0 ended by a signal, 1 could not start, 3 already running on this folder.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

from physworld_services.embedded.broker import NoBroker
from physworld_services.embedded.folder import AlreadyRunning, StillAlive
from physworld_services.embedded.supervisor import Options, StartFailed, Stopped, Supervisor
from physworld_storage.errors import StorageError
from physworld_storage.settings import Settings
from physworld_storage.store import FULL_ERRNO

ALREADY_RUNNING = 3
SQLITE_FULL = "database or disk is full"


def main(arguments: list[str] | None = None) -> int:
    """Run the service until Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m physworld_services.embedded", description=__doc__)
    parser.add_argument("--data", type=Path, default=None, help="data folder (default: PHYSWORLD_DATA_DIR)")
    parser.add_argument("--workers", type=int, default=2, help="simulation worker processes (default: 2)")
    parser.add_argument(
        "--port", type=int, default=0, help="web port on 127.0.0.1; 0: last one, or a free one"
    )
    parser.add_argument("--no-trainer", action="store_true", help="do not start the trainer")
    parser.add_argument(
        "--no-inference", action="store_true", help="do not start rollouts, plans, live sessions"
    )
    given = parser.parse_args(arguments)
    if given.workers < 0:
        parser.error(f"--workers {given.workers} is negative")
    root = given.data if given.data is not None else Settings().data_dir
    options = Options(
        root, given.workers, given.port, trainer=not given.no_trainer, inference=not given.no_inference
    )
    try:
        Supervisor(options, _say).run()
    except AlreadyRunning as error:
        _say(f"PhysWorld is already running on {root} (pid {error.state.get('pid', 'unknown')})")
        for key in ("dashboard_url", "api_url", "docs_url", "api_key_file"):
            if key in error.state:
                _say(f"  {key:<14}{error.state[key]}")
        return ALREADY_RUNNING
    except (StartFailed, NoBroker, StillAlive, StorageError, OSError) as error:
        print(f"PhysWorld could not start: {_reason(error, root)}", file=sys.stderr)
        return 1
    except Stopped:
        return 0
    return 0


def _reason(error: Exception, root: Path) -> str:
    """What is wrong, in one line where it is the disk or the folder."""
    if getattr(error, "errno", None) in FULL_ERRNO or SQLITE_FULL in str(error):
        there = next(path for path in (root.absolute(), *root.absolute().parents) if path.exists())
        free = shutil.disk_usage(there).free
        return f"the disk of {root} is full, {free} bytes are free on it; make room and start again"
    return f"the data folder {root}: {error}" if isinstance(error, OSError) else str(error)


def _say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
