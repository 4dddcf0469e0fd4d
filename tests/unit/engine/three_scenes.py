"""A solid on the ground, a sheet and a rope, each held at one end: what engines and devices are compared on."""

from __future__ import annotations

import numpy as np
from made_scene import box_body, made_scene

from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Ground, Scene

PLATE = np.array([[0.0, 0.0, 0.0], [0.0, 0.03, 0.0], [0.0, 0.0, 0.03]])


def solid(frames: int) -> Scene:
    points = np.linspace([0.04, 0.02, 0.04], [0.16, 0.02, 0.04], 4)
    grips = (Grip((0, 1, 2), np.zeros(3), np.array([0.032, 0.04, 0.04])),)
    body = box_body([0, 0, 0], [0.16, 0.04, 0.04], density_kg_m3=500.0)
    return made_scene(
        points, "beam", PLATE, frames, body=body, grips=grips, ground=Ground(-0.001, 0.4),
        initial_state=UNDEFORMED_AT_REST,
    )  # fmt: skip


def sheet(frames: int) -> Scene:
    plane = np.stack(np.meshgrid(*[np.linspace(0, 0.2, 3)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.concatenate([plane, np.zeros((9, 1))], axis=1)
    body = Body(thickness_m=2e-3)
    return made_scene(points, "sheet", PLATE, frames, body=body, initial_state=UNDEFORMED_AT_REST)


def rope(frames: int) -> Scene:
    points = np.linspace([0.0, 0.0, 0.0], [0.3, 0.0, 0.0], 5)
    body = Body(radius_m=0.004)
    return made_scene(points, "rope", PLATE[:1], frames, body=body, initial_state=UNDEFORMED_AT_REST)


SCENES = {make.__name__: make for make in (solid, sheet, rope)}
