"""What the web process reads from and writes to, opened once and handed to the API and to the dashboard."""

from __future__ import annotations

from physworld_storage.artifacts import ArtifactStore
from physworld_storage.database import Database, open_database
from physworld_storage.episodes import EpisodeStore
from physworld_storage.patience import ANSWERING
from physworld_storage.settings import Settings

THREADS = 48
"""That use the database at once: anyio's 40, and those of followed jobs, uploads, probes and the metrics."""


class Stores:
    """The artifact store and the episode store of one installation.

    Attributes:
        artifacts: content-addressed files (scene archives, twins, model files).
        episodes: zarr groups of demonstration episodes.
    """

    def __init__(self, settings: Settings) -> None:
        self.artifacts = ArtifactStore(settings, ANSWERING)
        self.episodes = EpisodeStore(settings, ANSWERING)


def open_all(settings: Settings) -> tuple[Database, Stores]:
    """Database and stores that the settings name."""
    return open_database(settings, threads=THREADS, patience=ANSWERING), Stores(settings)
