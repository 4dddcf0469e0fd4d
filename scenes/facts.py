"""What a service keeps of a scene beside its archive: the columns of its row."""

from __future__ import annotations

from typing import Any

from physworld.scene import Scene
from physworld_scenes.limited import FAULT_CHARACTERS, MOST_FAULTS


def facts_of(scene: Scene, warnings: list[str]) -> dict[str, Any]:
    """Keyword arguments of ``physworld_storage.resources.create_scene``, as JSON.

    Args:
        scene: that was checked.
        warnings: of the importer and the validator; long lists and texts are cut.
    """
    return {
        "name": scene.name,
        "kind": scene.kind,
        "description": scene.description,
        "frames": scene.frame_count,
        "points": scene.points.shape[1],
        "controllers": scene.controllers.shape[1],
        "fps": scene.fps,
        "duration_s": float(scene.times[-1] - scene.times[0]),
        "noise_sigma_m": scene.noise_sigma_m,
        "train": scene.train,
        "test": scene.test,
        "declared": scene.declared,
        "warnings": [warning[:FAULT_CHARACTERS] for warning in warnings[:MOST_FAULTS]],
    }
