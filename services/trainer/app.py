"""The trainer service: a worker on the ``train`` queue that knows how to do ``training`` and ``assessment`` shards.

It consumes the episodes of a sealed dataset and publishes a version of a model. A dataset's last commit opens
its training job, so the trainer starts as soon as there is something to learn from.
"""

from __future__ import annotations

from physworld_schemas.queues import TRAINING
from physworld_storage import signing
from physworld_storage.settings import Settings
from physworld_workers.app import run_worker
from physworld_workers.registry import register

HANDLERS = {
    "training": "physworld_services.trainer.training:run",
    "assessment": "physworld_services.trainer.assessment:run",
}


def serve(settings: Settings, name: str) -> int:
    """Serve the training queue until told to stop; returns the exit code."""
    signing.open_signer(settings)  # a key that cannot be read ends the trainer now, not after the training
    for kind, handler in HANDLERS.items():
        register(kind, handler)
    return run_worker(settings, TRAINING, name)
