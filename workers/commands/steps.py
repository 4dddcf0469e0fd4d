"""The file of ``--resume``: finished steps of a calibration, which the same command goes on from."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from physworld.estimation.journal import JOURNAL_BEGINS, Journal
from physworld.estimation.simulations import engine
from physworld.scene import Scene
from physworld_scenes.bundle import canonical_archive


def journal_in(path: Path, scene: Scene | Sequence[Scene], settings: str) -> Journal:
    """Finished steps of this scene, or of several, under these settings by this engine, kept in ``path``.

    Raises:
        ValueError: there is a file at ``path`` that no command has written: it would be lost.
    """
    stored = path.read_text() if path.exists() else None
    if stored and not stored.startswith(JOURNAL_BEGINS):
        raise ValueError(f"{path} holds something else than finished steps and would be overwritten")

    def save(text: str) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f"{path.name}.part")
        partial.write_text(text)
        partial.replace(path)

    scenes = [scene] if isinstance(scene, Scene) else scene
    digests = " ".join(hashlib.sha256(canonical_archive(known)).hexdigest() for known in scenes)
    key = f"{digests} {engine()} {settings}"
    return Journal(key, stored, save)
