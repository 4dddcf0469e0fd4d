"""A depth camera's pictures of a block on a table, made by rays, so that all places are known.

The camera stands ``HEIGHT_M`` above the table and looks down by ``PITCH_DEG``. In the scene's world, which an import
finds, the table is z = 0, the origin below the camera, y away from it.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

Array = np.ndarray
WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
HEIGHT_M, PITCH_DEG = 0.5, 35.0
LOW, HIGH = np.array([-0.08, 0.62, 0.0]), np.array([0.08, 0.72, 0.06])
"""Corners of the block [m]."""
BEYOND_M = 3.0
"""No depth beyond it."""


def first() -> tuple[Array, Array, Array]:
    """Colours (H, W, 3) uint8, depth (H, W) [m], 0 where there is none, and whether the block is seen, (H, W)."""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones_like(rows)], axis=-1)
    pitch = np.radians(PITCH_DEG)
    right = np.array([1.0, 0.0, 0.0])
    down = np.array([0.0, -np.sin(pitch), -np.cos(pitch)])
    ahead = np.array([0.0, np.cos(pitch), -np.sin(pitch)])
    rays = rays @ np.stack([right, down, ahead])
    eye = np.array([0.0, 0.0, HEIGHT_M])
    with np.errstate(divide="ignore"):
        table = np.where(rays[..., 2] < 0, -HEIGHT_M / rays[..., 2], np.inf)
        near, far = np.sort(np.stack([(LOW - eye) / rays, (HIGH - eye) / rays]), axis=0)
    enter, leave = near.max(axis=-1), far.min(axis=-1)
    block = (enter < leave) & (enter > 0) & (enter < table + 1e-9)
    depth = np.where(block, enter, table)
    depth[depth > BEYOND_M] = 0.0
    places = eye + rays * depth[..., None]
    tiles = (np.floor(places[..., 0] / 0.05) + np.floor(places[..., 1] / 0.05)) % 2
    colour = np.where(tiles[..., None] > 0, [170, 150, 120], [120, 100, 80])
    colour = np.where(block[..., None], [150, 40, 60], colour)
    return colour.astype(np.uint8), depth, block


def write(folder: Path, frames: int = 2) -> None:
    """As files of Open3D's layout; nothing moves."""
    colour, depth, _ = first()
    for kind, picture in (("color", colour[..., ::-1]), ("depth", np.round(1000 * depth).astype(np.uint16))):
        (folder / kind).mkdir(parents=True)
        for frame in range(frames):
            cv2.imwrite(str(folder / f"{kind}/{frame}.png"), picture)
    lens = [FOCAL, 0.0, 0.0, 0.0, FOCAL, 0.0, WIDTH / 2, HEIGHT / 2, 1.0]
    (folder / "camera_intrinsic.json").write_text(
        json.dumps({"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": lens})
    )


def block_box() -> tuple[int, int, int, int]:
    """Left, top, right, bottom of the block in the picture, one pixel around it."""
    rows, columns = np.nonzero(first()[2])
    return int(columns.min()) - 1, int(rows.min()) - 1, int(columns.max()) + 2, int(rows.max()) + 2
