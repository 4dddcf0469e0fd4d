"""A small recording of three depth cameras: a speckled bar that bends and turns before them, with its truth."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

from benchmarks.tracking.plays import Play, box
from benchmarks.tracking.raycast import PLAIN, Surface
from benchmarks.tracking.render import render
from physworld.camera import Camera, look_at

WIDTH, HEIGHT, FRAMES, LENGTH_M, SIDE_M, TABLE_M = 320, 240, 16, 0.2, 0.05, 0.25
MIDDLE = np.array([0.1, 0.0, 0.5])


def bar() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and triangles (F, 3) of its surface."""
    import trimesh

    shape = trimesh.creation.box(extents=[LENGTH_M, SIDE_M, SIDE_M]).subdivide_to_size(0.02)
    return np.asarray(shape.vertices) + MIDDLE, np.asarray(shape.faces)


def moved(vertices: np.ndarray, frame: int) -> np.ndarray:
    """The vertices (V, 3) [m] at a frame: bent about its left end, turned about the vertical and shifted."""
    share = frame / (FRAMES - 1)
    along = vertices[:, 0] - (MIDDLE[0] - 0.5 * LENGTH_M)
    bent = vertices + np.stack([0.0 * along, 0.0 * along, -1.2 * share * along**2], axis=1)
    angle = 0.6 * np.sin(np.pi * share)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    return (bent - MIDDLE) @ turn.T + MIDDLE + share * np.array([0.02, 0.0, 0.05])


def cameras() -> list[Camera]:
    """Three: before the bar, and at either end of it behind."""
    places = ([0.1, -0.5, 0.7], [0.6, 0.1, 0.7], [-0.3, 0.35, 0.72])
    return [look_at(np.array(place), MIDDLE, WIDTH, HEIGHT, 40.0) for place in places]


def play() -> Play:
    """All of it; a dark post stands beside the bar, which is none of it."""
    rest, triangles = bar()
    corners, faces = box([-0.035, -0.02, 0.3], [-0.01, 0.02, 0.5])
    vertices = np.stack([np.concatenate([moved(rest, frame), corners]) for frame in range(FRAMES)])
    pixels = cameras()[0].project(rest)[0]
    low, high = np.floor(pixels.min(axis=0)).astype(int) - 4, np.ceil(pixels.max(axis=0)).astype(int) + 4
    return Play(
        "beam", [Surface(triangles, rest, grain_m=0.008), Surface(faces, corners, PLAIN, (0.2, 0.22, 0.25))],
        vertices, len(rest), cameras(), TABLE_M, {}, {}, (np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((FRAMES, 3))),
        MIDDLE, (int(low[0]), int(low[1]), int(high[0]), int(high[1])),
    )  # fmt: skip


def write(folder: Path) -> None:
    """The recording of three cameras in PhysTwin's layout."""
    render(play(), folder, 3)


def first_camera(folder: Path, out: Path) -> None:
    """The same recording as the first camera alone has it."""
    for kind in ("color", "depth"):
        shutil.copytree(folder / kind / "0", out / kind / "0")
    facts = json.loads((folder / "metadata.json").read_text())
    (out / "metadata.json").write_text(json.dumps(facts | {"intrinsics": facts["intrinsics"][:1]}))
    poses = json.loads((folder / "calibrate.json").read_text())
    (out / "calibrate.json").write_text(json.dumps(poses[:1]))
    for name in ("truth.npz", "truth.json"):
        shutil.copy(folder / name, out / name)


def turned_poses(folder: Path, camera: int, by: np.ndarray) -> None:
    """One camera's pose in ``calibrate.json`` (4, 4) multiplied by another from the left."""
    poses = json.loads((folder / "calibrate.json").read_text())
    poses[camera] = (by @ np.array(poses[camera])).tolist()
    (folder / "calibrate.json").write_text(json.dumps(poses))


def tracks_of(folder: Path, camera: int, count: int = 120, seed: int = 0) -> dict[str, np.ndarray]:
    """What a perfect tracker in one camera would write: material points, seen where the depth is theirs."""
    import cv2

    with np.load(folder / "truth.npz") as truth:
        vertices, triangles = truth["vertices"].astype(float), truth["triangles"]
    rng = np.random.default_rng(seed)
    on = triangles[rng.integers(0, len(triangles), count)]
    weights = rng.dirichlet(np.ones(3), count)
    points = np.einsum("nk,tnki->tni", weights, vertices[:, on])
    tracks, visible = np.zeros((len(points), count, 2)), np.zeros((len(points), count), dtype=bool)
    for frame, places in enumerate(points):
        pixels, distance = cameras()[camera].project(places)
        depth = cv2.imread(str(folder / f"depth/{camera}/{frame}.png"), cv2.IMREAD_UNCHANGED) / 1000.0
        column, row = np.floor(pixels).astype(int).T
        inside = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
        measured = np.where(inside, depth[row.clip(0, HEIGHT - 1), column.clip(0, WIDTH - 1)], 0.0)
        visible[frame] = inside & (np.abs(measured - distance) < 6e-3)
        tracks[frame] = pixels - 0.5
    return {"tracks": tracks, "visible": visible}
