"""``python -m physworld_services.trainer [--name trainer]``: one worker of the ``train`` queue.

It learns from the episodes of a dataset and publishes a version of a model, and assesses recordings.
"""

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
    from physworld_schemas.queues import TRAINING
    from physworld_storage import signing
    from physworld_storage.settings import get_settings
    from physworld_workers.app import run_worker

    settings = get_settings()
    settings.check()
    signing.open_signer(settings)  # a key that cannot be read ends the trainer now, not after the training
    return run_worker(settings, TRAINING, options.name)


if __name__ == "__main__":
    sys.exit(main())
