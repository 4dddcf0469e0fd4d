"""Pictures of a recorded motion for a model that sees: frames of the tracked points, side by side, as PNG.

The view is along the direction in which the points move least; the vertical on the page is as vertical as it allows.
Grey: where the points were at first. Blue to green: the points, by number. Red: what is driven.
"""

from __future__ import annotations

import io

import numpy as np
from PIL import Image, ImageDraw

from physworld.arrays import Array
from physworld.scene import Scene

COLUMNS, ROWS, SIDE = 4, 2, 320
MARGIN = 0.08
DOT, DRIVEN_DOT = 3, 4


def motion_pictures(scene: Scene) -> list[bytes]:
    """One montage of frames evenly spread over the recording (a PNG)."""
    frames = np.unique(np.linspace(0, scene.frame_count - 1, COLUMNS * ROWS).round().astype(int))
    axes = _page(scene)
    points, driven = scene.points @ axes.T, scene.controllers @ axes.T
    shown = np.concatenate([points[scene.visible], driven.reshape(-1, 2)])
    low, span = shown.min(axis=0), max(float(np.ptp(shown, axis=0).max()), 1e-9)
    scale = SIDE * (1 - 2 * MARGIN) / span

    def pixel(place: Array) -> tuple[float, float]:
        x, y = (place - low) * scale + SIDE * MARGIN
        return float(x), float(SIDE - y)

    picture = Image.new("RGB", (COLUMNS * SIDE, ROWS * SIDE), "white")
    draw = ImageDraw.Draw(picture)
    count = max(points.shape[1] - 1, 1)
    for tile, frame in enumerate(frames):
        corner = (tile % COLUMNS * SIDE, tile // COLUMNS * SIDE)
        draw.rectangle((*corner, corner[0] + SIDE - 1, corner[1] + SIDE - 1), outline=(200, 200, 200))
        draw.text((corner[0] + 6, corner[1] + 4), f"t = {scene.times[frame]:.2f} s", fill="black")
        for n in np.flatnonzero(scene.visible[0]):
            _dot(draw, corner, pixel(points[0, n]), 1, (190, 190, 190))
        for n in np.flatnonzero(scene.visible[frame]):
            _dot(
                draw,
                corner,
                pixel(points[frame, n]),
                DOT,
                (0, int(190 * n / count), int(220 - 160 * n / count)),
            )
        for place in driven[frame]:
            _dot(draw, corner, pixel(place), DRIVEN_DOT, (210, 30, 30))
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG")
    return [buffer.getvalue()]


def _page(scene: Scene) -> Array:
    """Horizontal and vertical unit vectors of the page, (2, 3)."""
    moved = np.where(scene.visible[..., None], scene.points - scene.points[0], 0.0).reshape(-1, 3)
    size = np.abs(np.ptp(scene.points[0][scene.visible[0]], axis=0)) if scene.visible[0].any() else np.ones(3)
    spread = np.sqrt(np.mean(moved[:, :2] ** 2, axis=0)) + 0.25 * size[:2]
    across = np.array([1.0, 0.0, 0.0]) if spread[0] >= spread[1] else np.array([0.0, 1.0, 0.0])
    return np.stack([across, [0.0, 0.0, 1.0]])


def _dot(
    draw: ImageDraw.ImageDraw,
    corner: tuple[int, int],
    place: tuple[float, float],
    radius: int,
    colour: tuple[int, int, int],
) -> None:
    x, y = corner[0] + place[0], corner[1] + place[1]
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
