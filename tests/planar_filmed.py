"""A film of known truth: a speckled strip, clamped at its left end, that bends to arcs before a ChArUco board.

The plane: x right and y up [m], the board's corner at the origin. A pixel's ray meets the plane, the arc's closed form
turns the place there into the strip's material, and the strip's texture gives the colour: no resampled picture lies
between the truth and the film. ``lean`` turns the strip about its clamp, out of the plane.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL, FPS, FRAMES = 480, 360, 520.0, 50, 9
SQUARES, SQUARE_M, MARKER_M = (7, 5), 0.045, 0.034
BOARD = f"charuco:{SQUARES[0]}x{SQUARES[1]}:{SQUARE_M}:{MARKER_M}"
CLAMP, LENGTH_M, HALF_M = np.array([0.04, 0.13]), 0.2, 0.016
CURVATURE = 2.5
"""The largest [1/m]."""
TEXEL_M = 0.5e-3


@dataclass(frozen=True)
class Film:
    """One film.

    Attributes:
        tilt_deg: of the camera against the plane's normal.
        lean_deg: of the strip against the plane, at the last frame.
        distortion: radial coefficient k1 of the lens.
    """

    tilt_deg: float = 20.0
    lean_deg: float = 0.0
    distortion: float = 0.0

    @property
    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3, 3) and shift (3,) from the plane's frame (x, y, towards the camera) to the camera's."""
        turn, _ = cv2.Rodrigues(np.array([0.0, np.radians(self.tilt_deg), 0.0]))
        turn = turn @ np.diag([1.0, -1.0, -1.0])
        return turn, np.array([0.0, 0.0, 0.5]) - turn @ np.array([0.15, 0.12, 0.0])

    def frame(self, number: int) -> np.ndarray:
        """Colours (H, W, 3) uint8."""
        rays, flat, board = _background(self)
        colour, lean = board.copy(), self.lean(number)
        material, inside = unbent(self.meet(rays, lean) if lean else flat, curvature(number))
        colour[inside] = _strip_colour(material[inside])
        picture = colour.reshape(2 * HEIGHT, 2 * WIDTH, 3)
        picture = cv2.resize(picture, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
        noise = np.random.default_rng(number).normal(scale=2.0, size=picture.shape)
        return np.clip(np.round(picture + noise), 0, 255).astype(np.uint8)

    def lean(self, number: int) -> float:
        """Angle of the strip against the plane [rad]."""
        return float(np.radians(self.lean_deg) * number / (FRAMES - 1))

    def pixel(self, places: np.ndarray) -> np.ndarray:
        """Pixels (P, 2), OpenCV's, of places (P, 2) on the plane [m]."""
        turn, shift = self.pose
        flat = np.concatenate([places, np.zeros((len(places), 1))], axis=1)
        bent = np.array([self.distortion, 0, 0, 0.0])
        return cv2.projectPoints(flat, cv2.Rodrigues(turn)[0], shift, lens_matrix(), bent)[0][:, 0]

    def box(self) -> str:
        """Around the strip in the first frame."""
        corners = CLAMP + np.array([[0, -HALF_M], [0, HALF_M], [LENGTH_M, -HALF_M], [LENGTH_M, HALF_M]])
        seen = self.pixel(corners)
        low, high = np.floor(seen.min(axis=0) - 6).astype(int), np.ceil(seen.max(axis=0) + 6).astype(int)
        return f"{low[0]},{low[1]},{high[0]},{high[1]}"

    def meet(self, rays: np.ndarray, lean: float) -> np.ndarray:
        """Where rays (P, 3) meet the plane, or the one that leans about the clamp's vertical: its x and y, (P, 2)."""
        turn, shift = self.pose
        origin, directions = -turn.T @ shift, rays @ turn
        normal = np.array([-np.sin(lean), 0.0, np.cos(lean)])
        base = np.array([*CLAMP, 0.0])
        way = ((base - origin) @ normal) / (directions @ normal)
        places = origin + way[:, None] * directions - base
        along = places @ np.array([np.cos(lean), 0.0, np.sin(lean)])
        return np.stack([along, places[:, 1]], axis=1) + CLAMP

    def write(self, path: Path, frames: int = FRAMES) -> Path:
        """The film as MP4, its index first."""
        import av

        with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
            stream = container.add_stream("mpeg4", rate=FPS)
            stream.width, stream.height, stream.pix_fmt, stream.bit_rate = WIDTH, HEIGHT, "yuv420p", 6_000_000
            for number in range(frames):
                for packet in stream.encode(av.VideoFrame.from_ndarray(self.frame(number), format="rgb24")):
                    container.mux(packet)
            for packet in stream.encode():
                container.mux(packet)
        return path

    def write_lens(self, path: Path) -> Path:
        """Its camera as JSON."""
        facts = {
            "width": WIDTH,
            "height": HEIGHT,
            "fx": FOCAL,
            "fy": FOCAL,
            "cx": WIDTH / 2,
            "cy": HEIGHT / 2,
        }
        path.write_text(json.dumps({**facts, "distortion": [self.distortion, 0, 0, 0]}))
        return path


def lens_matrix() -> np.ndarray:
    """OpenCV's, (3, 3)."""
    return np.array([[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1.0]])


def curvature(number: int) -> float:
    """Of the strip's middle line in a frame [1/m]: to one side and the other."""
    return CURVATURE * float(np.sin(2 * np.pi * number / (FRAMES - 1)))


def bent(material: np.ndarray, bend: float) -> np.ndarray:
    """Places (P, 2) [m] of material (P, 2): along the strip and across it [m]."""
    along, across = material.T
    if abs(bend) < 1e-9:
        return CLAMP + material
    radius = 1.0 / bend
    angle = along * bend
    return CLAMP + np.stack(
        [(radius - across) * np.sin(angle), radius - (radius - across) * np.cos(angle)], 1
    )


def unbent(places: np.ndarray, bend: float) -> tuple[np.ndarray, np.ndarray]:
    """The inverse: material (P, 2), and whether it is of the strip, (P,)."""
    x, y = (places - CLAMP).T
    if abs(bend) < 1e-9:
        material = np.stack([x, y], axis=1)
    else:
        radius = 1.0 / bend
        side = np.sign(bend)
        angle = np.arctan2(side * x, side * (radius - y))
        material = np.stack([angle / bend, radius - side * np.hypot(x, radius - y)], axis=1)
    inside = (material[:, 0] >= 0) & (material[:, 0] <= LENGTH_M) & (np.abs(material[:, 1]) <= HALF_M)
    return material, inside


@lru_cache(maxsize=4)
def _background(film: Film) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays (P, 3) of pixels twice as dense, where they meet the plane (P, 2), and the board's colour there (P, 3)."""
    rows, columns = np.mgrid[: 2 * HEIGHT, : 2 * WIDTH]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1) / 2.0 - 0.25
    bend = np.array([film.distortion, 0, 0, 0.0])
    rays = cv2.undistortPoints(pixels[:, None].astype(np.float64), lens_matrix(), bend)[:, 0]
    rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    flat = film.meet(rays, 0.0)
    return rays, flat, _board_colour(flat)


def _strip_colour(material: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(5).normal(size=(80, 420))
    speckles = cv2.GaussianBlur(noise, (0, 0), 3.0)
    speckles = (130 + 50 * speckles / speckles.std()).astype(np.float32)
    column, row = material[:, 0] / TEXEL_M + 5, material[:, 1] / TEXEL_M + 40
    value = _sampled(speckles, column, row)
    return np.stack([value, 0.45 * value, 0.25 * value], axis=-1)


def _board_colour(places: np.ndarray) -> np.ndarray:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard(SQUARES, SQUARE_M, MARKER_M, dictionary)
    side = 120
    picture = board.generateImage((SQUARES[0] * side, SQUARES[1] * side)).astype(np.float32)
    column = places[:, 0] / SQUARE_M * side - 0.5
    row = (SQUARES[1] * SQUARE_M - places[:, 1]) / SQUARE_M * side - 0.5
    value = 30 + 0.8 * _sampled(picture, column, row, 255.0)
    return np.repeat(value[:, None], 3, axis=1)


def _sampled(picture: np.ndarray, column: np.ndarray, row: np.ndarray, beyond: float = 0.0) -> np.ndarray:
    places = [part.astype(np.float32).reshape(-1, 1) for part in (column, row)]
    values = np.empty(len(column))
    for start in range(0, len(column), 30_000):  # OpenCV's limit of rows
        part = slice(start, start + 30_000)
        values[part] = cv2.remap(
            picture, places[0][part], places[1][part], cv2.INTER_LINEAR, borderValue=beyond
        )[:, 0]
    return values
