"""What the image columns have done already: recordings, splats, twins and predictions on disk.

Everything lies under a digest of the settings and of the sources that decide it, so that nothing is read that other
code or another budget made.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper.pictures import Filmed, splat_of
from benchmarks.paper.predictions import Found, Settings, done, twin_of
from benchmarks.paper.recordings import Recording, judged, record
from physworld.arrays import Array
from physworld.camera import Camera
from physworld.estimation.simulations import engine
from physworld.twin.twin import Twin
from physworld.video import SplatView, from_ply, to_ply
from physworld_scenes.bundle import read_bundle, write_bundle

REPOSITORY = Path(__file__).resolve().parents[2]
RENDERING = (
    "benchmarks/tracking/plays.py", "benchmarks/tracking/raycast.py", "benchmarks/tracking/depth_camera.py",
    "benchmarks/peers", "scripts/make_sample_scene.py", "scripts/make_sample_rope.py",
    "benchmarks/paper/recordings.py",
)  # fmt: skip
FILMING = ("physworld/video", "benchmarks/paper/pictures.py")
PREDICTING = (
    "physworld/worldmodel", "physworld/demonstrate", "physworld/baselines", "physworld/calibrate",
    "physworld/estimation", "physworld/evaluate", "benchmarks/paper/models.py", "benchmarks/paper/motions.py",
    "benchmarks/paper/predictions.py",
)  # fmt: skip


class Kept:
    """What is done of a run.

    Args:
        folder: made if absent.
        settings: budgets.
    """

    def __init__(self, folder: Path, settings: Settings) -> None:
        self.folder, self.settings = folder, settings
        folder.mkdir(parents=True, exist_ok=True)
        self._held: dict[str, Any] = {}

    def key(self) -> str:
        """Digest of all sources and settings."""
        return _digest(
            str(self.settings), engine(), *(sources(part) for part in (RENDERING, FILMING, PREDICTING))
        )

    def recording(self, name: str) -> Recording:
        """A play's recording."""
        settings = self.settings
        facts = f"{settings.frames} {settings.held_out_every} {settings.training_every} {settings.seed}"
        place = self.folder / f"{name}-{_digest(facts, sources(RENDERING))}"
        if not (place / "scene.json").exists():
            training, held_out = judged(settings.frames, settings.held_out_every, settings.training_every)
            made = record(name, settings.frames, training + held_out, settings.seed)
            arrays = {"frames": made.frames, "pictures": made.pictures, "seen": made.seen}
            for number, view in enumerate(made.views):
                camera = view.camera
                lens = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
                own = {"lens": np.array(lens), "pose": camera.world_to_camera, "picture": view.picture,
                       "mask": view.mask, "depth": view.depth}  # fmt: skip
                arrays |= {f"{number}.{part}": np.asarray(values) for part, values in own.items()}
            _write_arrays(place.with_suffix(".npz"), arrays)
            write_bundle(made.scene, place)
        held = _read_arrays(place.with_suffix(".npz"))
        views, number = [], 0
        while f"{number}.lens" in held:
            width, height, *rest = held[f"{number}.lens"]
            lens = [float(value) for value in rest]
            camera = Camera(int(width), int(height), *lens, held[f"{number}.pose"])
            views.append(
                SplatView(camera, *(held[f"{number}.{part}"] for part in ("picture", "mask", "depth")))
            )
            number += 1
        return Recording(read_bundle(place), tuple(views), held["frames"], held["pictures"], held["seen"])

    def filmed(self, name: str) -> Filmed:
        """A play's recording with the splat of its first frame."""

        def make() -> Filmed:
            recording = self.recording(name)
            key = _digest(str(self.settings), sources(RENDERING), sources(FILMING))
            path = self.folder / f"{name}-splat-{key}.ply"
            if not path.exists():
                path.write_bytes(to_ply(splat_of(recording, self.settings.splat)))
            return Filmed(recording, from_ply(path.read_bytes()))

        return self._once(f"{name} filmed", make)

    def twin(self, name: str) -> Twin:
        """The calibrated twin of a play's recording."""

        def make() -> Twin:
            path = self.folder / f"{name}-twin-{self._predicting()}.npz"
            if not path.exists():
                _write_arrays(path, twin_of(self.filmed(name).recording.scene, self.settings).to_arrays())
            return Twin.from_arrays(_read_arrays(path))

        return self._once(f"{name} twin", make)

    def predictions(self, name: str, work: str) -> Found:
        """What a piece of work predicts of a play's recording, and its figures."""
        path = self._path(name, work)
        if not path.exists():
            tracks, facts = done(work, self.filmed(name).recording.scene, self.twin(name), self.settings)
            _write_arrays(path, tracks | {"facts": np.array(json.dumps(facts))})
        held = _read_arrays(path)
        return held, json.loads(str(held.pop("facts")))

    def has(self, name: str, work: str) -> bool:
        """Whether a piece of work is done."""
        return self._path(name, work).exists()

    def _path(self, name: str, work: str) -> Path:
        return self.folder / f"{name}-{work}-{self._predicting()}.npz"

    def _predicting(self) -> str:
        return _digest(str(self.settings), engine(), sources(RENDERING), sources(PREDICTING))

    def _once(self, name: str, make: Callable[[], Any]) -> Any:
        if name not in self._held:
            self._held[name] = make()
        return self._held[name]


@cache
def sources(parts: tuple[str, ...]) -> str:
    """Digest of files of the repository, and of all Python files of folders."""
    digest = hashlib.sha256()
    for part in parts:
        path = REPOSITORY / part
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(f"{file.relative_to(REPOSITORY).as_posix()}\n".encode() + file.read_bytes())
    return digest.hexdigest()


def _digest(*parts: str) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def _write_arrays(path: Path, arrays: dict[str, Array]) -> None:
    partial = path.with_name(f"{path.stem}.part.npz")
    np.savez_compressed(partial, allow_pickle=False, **arrays)
    partial.replace(path)


def _read_arrays(path: Path) -> dict[str, Array]:
    with np.load(path, allow_pickle=False) as held:
        return dict(held)
