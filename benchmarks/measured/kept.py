"""Fitted spring–mass networks kept beside a benchmark's JSON: they take minutes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from physworld.arrays import Array
from physworld.baselines.spring_fit import SpringModel, SpringSettings
from physworld.scene import Scene
from physworld_scenes.bundle import canonical_archive

Model = Callable[[Scene], Array]


def fitted(name: str, fit: Callable[[Scene], Model], scene: Scene, folder: Path | None) -> Model:
    """The model that ``fit`` makes of a scene, read from ``folder`` where it lies there already.

    Args:
        name: of the predictor.
        fit: fits it; may raise.
        scene: whose training frames it is fitted to.
        folder: of the kept networks, or None; other models are not kept.
    """
    path = None if folder is None else folder / f"{name}-{_key(scene)}.npz"
    if path is not None and path.exists():
        with np.load(path, allow_pickle=False) as held:
            return SpringModel.from_arrays(dict(held))
    model = fit(scene)
    if path is not None and isinstance(model, SpringModel):
        partial = path.with_suffix(".part.npz")
        np.savez_compressed(partial, allow_pickle=False, **model.to_arrays())
        partial.replace(path)
    return model


def _key(scene: Scene) -> str:
    """Of what a network follows: the recording and the settings of the fit."""
    parts = canonical_archive(scene) + f"{SpringSettings()}".encode()
    return hashlib.sha256(parts).hexdigest()[:16]
