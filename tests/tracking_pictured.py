"""A small recording of known motion: a speckled plate before a plain wall, warped by OpenCV, and its files."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from physworld.camera import Camera
from physworld.tracking.view import View

WIDTH, HEIGHT, FRAMES, NEAR_M, FAR_M = 160, 120, 12, 0.5, 1.2
LEFT, TOP, RIGHT, BOTTOM = 50, 40, 110, 80
CAMERA = Camera(WIDTH, HEIGHT, 200.0, 200.0, 80.0, 60.0, np.eye(4))
TURN_DEG, SHIFT_PX = 2.0, (1.5, -0.8)
COVERED = range(4, 7)
"""Frames in which a bar covers the plate's left half."""


def affine(frame: int) -> np.ndarray:
    """The plate's motion since the first frame in OpenCV's pixels, (2, 3)."""
    matrix = cv2.getRotationMatrix2D((79.5, 59.5), TURN_DEG * frame, 1.0)
    matrix[:, 2] += np.array(SHIFT_PX) * frame
    return matrix


def frame_of(frame: int, cover: bool = False, round_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Colours (H, W, 3) uint8 and depth (H, W) float32 [m]; a front like a lying cylinder's, of that radius [m]."""
    rng = np.random.default_rng(3)
    speckles = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), 1.5)
    speckles = 130 + 45 * speckles / speckles.std()
    plate = np.zeros((HEIGHT, WIDTH), np.float32)
    plate[TOP:BOTTOM, LEFT:RIGHT] = 1.0
    moved = cv2.warpAffine(speckles, affine(frame), (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC)
    on = cv2.warpAffine(plate, affine(frame), (WIDTH, HEIGHT)) > 0.5
    colour = np.full((HEIGHT, WIDTH, 3), (40, 60, 110), np.float64)
    colour[on] = np.stack([moved, 0.7 * moved, 0.4 * moved], axis=-1)[on]
    depth = np.where(on, NEAR_M, FAR_M).astype(np.float32)
    if round_m:
        away = (np.arange(HEIGHT) + 0.5 - 0.5 * (TOP + BOTTOM)) * NEAR_M / CAMERA.fy
        front = round_m - np.sqrt(np.maximum(round_m**2 - away**2, 0.0))
        front = np.repeat(front[:, None], WIDTH, axis=1).astype(np.float32)
        depth += np.where(on, cv2.warpAffine(front, affine(frame), (WIDTH, HEIGHT)), 0.0).astype(np.float32)
    if cover and frame in COVERED:
        colour[:, 40:80], depth[:, 40:80] = (20, 90, 20), 0.3
    return np.clip(np.round(colour), 0, 255).astype(np.uint8), depth


def view(cover: bool = False, frames: int = FRAMES) -> View:
    """The recording in memory."""
    return View(CAMERA, lambda t: frame_of(t, cover)[0], lambda t: frame_of(t, cover)[1], frames)


def write(folder: Path, frames: int = FRAMES, round_m: float = 0.0) -> None:
    """The recording as files: Open3D's layout, with cameras.json."""
    for kind in ("color", "depth"):
        (folder / kind).mkdir(parents=True)
    for frame in range(frames):
        colour, depth = frame_of(frame, round_m=round_m)
        cv2.imwrite(str(folder / f"color/{frame}.png"), colour[..., ::-1])
        cv2.imwrite(str(folder / f"depth/{frame}.png"), np.round(depth * 1000).astype(np.uint16))
    lens = [200.0, 0.0, 0.0, 0.0, 200.0, 0.0, 80.0, 60.0, 1.0]
    facts = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": lens}
    (folder / "camera_intrinsic.json").write_text(json.dumps(facts))
