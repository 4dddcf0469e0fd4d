"""A scene small enough for tests of the service: a soft bar held at one end and moved up and down."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld_scenes.bundle import canonical_archive
from physworld_storage import resources
from physworld_storage.artifacts import ArtifactStore
from physworld_storage.database import Database

FRAMES, FPS = 12, 30.0
LENGTH_M, SIDE_M = 0.12, 0.03
STROKE_M = 0.01


def tiny_scene(frames: int = FRAMES) -> Scene:
    """The bar's four tracked points follow its grip: a first guess of a motion, good enough to fit to."""
    times = np.arange(frames) / FPS
    lift = STROKE_M * np.sin(2 * np.pi * 1.5 * times)[:, None, None] * np.array([0.0, 0.0, 1.0])
    x = np.array([0.03, 0.06, 0.09, 0.12])
    points = np.stack([x, np.zeros(4), np.full(4, SIDE_M / 2)], axis=1)
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    box_min = np.array([0.0, -SIDE_M / 2, -SIDE_M / 2])
    box_max = np.array([LENGTH_M, SIDE_M / 2, SIDE_M / 2])
    split = round(0.7 * frames)
    return Scene(
        name="tiny bar",
        kind="beam",
        points=points + lift,
        visible=np.ones((frames, 4), dtype=bool),
        controllers=grip + lift,
        times=times,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=1e-3,
        train=(0, split),
        test=(split, frames),
        initial_state=UNDEFORMED_AT_REST,
        fps=FPS,
        body=Body(box_min_m=box_min, box_max_m=box_max, density_kg_m3=300.0),
        grips=(
            Grip(
                controllers=(0, 1, 2, 3),
                region_min_m=box_min,
                region_max_m=np.array([0.02, SIDE_M / 2, SIDE_M / 2]),
            ),
        ),
    )


def between_two_grips(frames: int = FRAMES) -> Scene:
    """The bar of :func:`tiny_scene` with a grip at either end; both move alike."""
    bar = tiny_scene(frames)
    half = SIDE_M / 2
    far = Grip(
        controllers=(4, 5, 6, 7),
        region_min_m=np.array([LENGTH_M - 0.02, -half, -half]),
        region_max_m=np.array([LENGTH_M, half, half]),
    )
    there = bar.controllers + np.array([LENGTH_M, 0.0, 0.0])
    return replace(bar, controllers=np.concatenate([bar.controllers, there], axis=1), grips=(*bar.grips, far))


def tiny_thing(kind: str, frames: int = FRAMES) -> Scene:
    """As :func:`tiny_scene`, of another kind: a "rope" of the same length, or a "sheet" as long and half as wide."""
    bar = tiny_scene(frames)
    x = np.linspace(0.0, LENGTH_M, 7)
    y = np.zeros(1) if kind == "rope" else np.linspace(0.0, LENGTH_M / 2, 4)
    points = np.array([[a, b, 0.0] for a in x for b in y])
    held = points[:1] if kind == "rope" else points[: len(y)]
    lift = bar.controllers[:, :1] - bar.controllers[:1, :1]
    body = (
        Body(radius_m=3e-3, density_kg_m3=300.0)
        if kind == "rope"
        else Body(thickness_m=2e-3, density_kg_m3=300.0)
    )
    return replace(
        bar,
        name=f"tiny {kind}",
        kind=kind,
        points=points + lift,
        visible=np.ones((frames, len(points)), dtype=bool),
        controllers=held + lift,
        body=body,
        grips=(Grip(controllers=tuple(range(len(held)))),),
    )


def register(
    scene: Scene, database: Database, artifacts: ArtifactStore, declared: dict[str, Any] | None = None
) -> str:
    """Store the scene as an upload would, with what it declares for people; its id."""
    archive = artifacts.put_bytes(canonical_archive(scene), "scene.zip", "application/zip")
    with database.session() as session:
        return resources.create_scene(
            session,
            name=scene.name,
            kind=scene.kind,
            description=scene.description,
            digest=archive.sha256,
            frames=scene.frame_count,
            points=scene.points.shape[1],
            controllers=scene.controllers.shape[1],
            fps=scene.fps,
            duration_s=float(scene.times[-1]),
            noise_sigma_m=scene.noise_sigma_m,
            train=scene.train,
            test=scene.test,
            declared=declared,
            artifacts=[archive],
        ).id
