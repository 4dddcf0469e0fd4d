"""Moving points for the 3D view: a JSON description of the layers, and float32 buffers for each of them.

A buffer is little-endian float32 of shape (frames, count, 3) [m], world frame z up, on the time line of the
view; a point that is not visible in a frame is NaN there. Layers too large for a page are thinned by taking
every k-th point, and the layer's label says so. ``frontend/src/cloud.js`` is the reader.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array

if TYPE_CHECKING:
    from physworld.scene import Scene

LAYER_BYTES = 8 * 2**20
BYTES_PER_POINT = 12
SMALLEST_POINT, LARGEST_POINT = 0.010, 0.05
MEASURED_SCALE = 1.4  # a measured point stays visible around the prediction that hits it


@dataclass(frozen=True)
class Layer:
    """One set of points.

    Attributes:
        name: key of the layer in URLs.
        label: what the legend says.
        role: colour, a role of the style sheet.
        points: (T, n, 3) float32 [m], NaN where not visible.
        shown: drawn from the start.
        opacity: 1 is solid.
        scale: size of the points against those of another layer of the same count.
        pairs: name of the layer whose points are the twins of these, joined by lines; None for none.
    """

    name: str
    label: str
    role: str
    points: Array
    shown: bool = True
    opacity: float = 1.0
    pairs: str | None = None
    scale: float = 1.0

    @property
    def count(self) -> int:
        """Points of each frame."""
        return int(self.points.shape[1])

    def buffer(self) -> bytes:
        """The layer as the browser reads it."""
        return np.ascontiguousarray(self.points, dtype="<f4").tobytes()


@dataclass(frozen=True)
class Cloud:
    """What one view shows.

    Attributes:
        times: (T,) [s].
        layers: sets of points on this time line.
        split: the first held-out frame.
        floor: height of the ground [m].
        box: corners of the undeformed body [m], where it is declared to be a box.
        surface: address of the body that a layer's points carry, and the name of that layer; None: points only.
    """

    times: Array
    layers: Sequence[Layer]
    split: int | None = None
    floor: float | None = None
    box: tuple[list[float], list[float]] | None = None
    surface: tuple[str, str] | None = None

    def layer(self, name: str) -> Layer | None:
        """The layer of this name."""
        return next((layer for layer in self.layers if layer.name == name), None)

    def describe(self, url: str, query: str = "") -> dict[str, object]:
        """The JSON of the view; ``url`` + ``/`` + layer name + ``query`` is the address of a buffer."""
        body = None
        if self.surface is not None:
            body = {"url": self.surface[0], "layer": self.surface[1], "label": "Surface", "role": "model"}
        return {
            "surface": body,
            "times": [round(float(time), 6) for time in self.times],
            "split": self.split,
            "floor": self.floor,
            "box": self.box,
            "layers": [
                {
                    "name": layer.name,
                    "label": layer.label,
                    "role": layer.role,
                    "count": layer.count,
                    "size": _point_size(layer.count) * layer.scale,
                    "shown": layer.shown,
                    "opacity": layer.opacity,
                    "pairs": layer.pairs,
                    "url": f"{url}/{layer.name}{query}",
                }
                for layer in self.layers
            ],
        }


def measured_layers(scene: Scene) -> list[Layer]:
    """The recording itself: tracked points where they were visible, and the driven points."""
    points = np.where(scene.visible[..., None], scene.points, np.nan)
    layers = [
        thinned(Layer("measured", "Measured", "measured", points.astype(np.float32), scale=MEASURED_SCALE))
    ]
    if scene.controllers.shape[1]:
        controllers = scene.controllers.astype(np.float32)
        layers.append(thinned(Layer("controllers", "Controllers", "controllers", controllers)))
    return layers


def scene_cloud(scene: Scene, layers: Sequence[Layer]) -> Cloud:
    """The view of a recording with further layers, which must already be on its time line."""
    split = scene.test[0] if scene.test[1] > scene.test[0] else None
    floor = None if scene.ground is None else float(scene.ground.height_m)
    body = scene.body
    box = None
    if body.box_min_m is not None and body.box_max_m is not None:
        box = (body.box_min_m.tolist(), body.box_max_m.tolist())
    return Cloud(scene.times, layers, split, floor, box)


def resampled(points: Array, times: Array, onto: Array) -> Array:
    """``points`` (T, n, 3) at ``times`` (T,) [s] on another time line: nearest frames, NaN outside."""
    if times.shape == onto.shape and np.allclose(times, onto, rtol=0.0, atol=1e-9):
        return points
    right = np.clip(np.searchsorted(times, onto), 0, len(times) - 1)
    left = np.maximum(right - 1, 0)
    nearest = np.where(onto - times[left] <= times[right] - onto, left, right)
    spacing = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    inside = (onto >= times[0] - spacing) & (onto <= times[-1] + spacing)
    return np.where(inside[:, None, None], points[nearest], np.nan)


def thinned(layer: Layer) -> Layer:
    """The layer with at most LAYER_BYTES, every k-th point of it."""
    frames, count, _ = layer.points.shape
    stride = max(1, -(-frames * count * BYTES_PER_POINT // LAYER_BYTES))
    if stride == 1:
        return layer
    points = layer.points[:, ::stride]
    label = f"{layer.label} ({points.shape[1]} of {count})"
    return replace(layer, label=label, points=points)


def _point_size(count: int) -> float:
    """Diameter of a point as a share of the view's radius: few points are drawn large."""
    return float(np.clip(0.45 / np.sqrt(max(count, 1)), SMALLEST_POINT, LARGEST_POINT))
