"""Scenes that are made of points alone, and recordings that a twin makes of itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from physworld.scene import Body, Scene
from physworld.twin.twin import Twin

FPS = 30.0
GRAVITY = np.array([0.0, 0.0, -9.81])


def made_scene(
    points: Any, kind: str, controllers: Any = ((0.0, 0.0, 0.0),), frames: int = 6, **facts: Any
) -> Scene:
    """A scene whose points (N, 3) and controllers (K, 3) stand still, unless ``facts`` give other fields."""
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    controllers = np.asarray(controllers, dtype=float).reshape(-1, 3)
    train = max(1, round(0.7 * frames))
    fields: dict[str, Any] = {
        "name": f"made {kind}",
        "kind": kind,
        "points": np.repeat(points[None], frames, axis=0),
        "visible": np.ones((frames, len(points)), dtype=bool),
        "controllers": np.repeat(controllers[None], frames, axis=0),
        "times": np.arange(frames) / FPS,
        "gravity_m_s2": GRAVITY,
        "noise_sigma_m": 1e-3,
        "train": (0, train),
        "test": (train, frames),
        "fps": FPS,
    }
    return Scene(**{**fields, **facts})


def box_body(low: Any, high: Any, **facts: Any) -> Body:
    """A declared box between two corners [m]."""
    return Body(box_min_m=np.asarray(low, dtype=float), box_max_m=np.asarray(high, dtype=float), **facts)


def recorded_by(twin: Twin, scene: Scene, sigma: float, seed: int = 0) -> Scene:
    """The scene as this twin would have moved in it, tracked with noise ``sigma`` [m]."""
    tracks = twin.track_nodes(twin.simulate_nodes(*scene.control_track(), scene.times))
    noise = np.random.default_rng(seed).normal(scale=sigma, size=tracks.shape)
    return replace(scene, points=tracks + noise, noise_sigma_m=sigma)
