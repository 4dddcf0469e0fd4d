"""How well a recording of known truth was followed: points seen and their error against the frame, how much of the
body they cover, the gripper, the time.

A point's truth is the material point of the surface that lies nearest to where it was measured in the first frame.
Errors are distances [mm] of the points that are called visible.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from benchmarks.tracking.plays import MARKER_ID
from physworld.arrays import Array
from physworld.geometry.rigid import least_rotation
from physworld.scene import Scene
from physworld.tracking.view import Box
from physworld_scenes.importers.gripping import GripFrom
from physworld_scenes.importers.options import ImportOptions
from physworld_scenes.importers.rgbd import PictureOptions, read_folder

MILLIMETRES = 1e3
NEAR_M = 0.01
"""From a seen point: what of the surface counts as covered."""


@dataclass(frozen=True)
class Score:
    """Of one recording.

    Attributes:
        alive: share of the points that is seen, (T,).
        median_mm, high_mm: error of those seen, its median and its 95th percentile, (T,).
        figures: numbers for the table.
    """

    alive: Array
    median_mm: Array
    high_mm: Array
    figures: dict[str, Any]


def scene_of(folder: Path) -> tuple[Scene, float]:
    """The scene that the importer makes of a rendered recording, told what a person would tell, and the seconds it
    took."""
    facts = json.loads((folder / "truth.json").read_text())
    grip = facts["declared"]["grip"]
    began = time.perf_counter()
    scene, _, _ = read_folder(
        folder,
        ImportOptions(kind=facts["kind"], body=facts["declared"]["body"]),
        PictureOptions(
            boxes={0: Box(*facts["box_px"])},
            grip=GripFrom(
                marker=MARKER_ID, held_m=(tuple(grip["region_min_m"]), tuple(grip["region_max_m"]))
            ),
            undeformed=True,
        ),
    )
    return scene, time.perf_counter() - began


def score(folder: Path, scene: Scene, seconds: float) -> Score:
    """The scene against the recording's truth."""
    truth = np.load(folder / "truth.npz")
    vertices = truth["vertices"].astype(np.float64)
    exact = exact_tracks(folder, scene)
    error = np.linalg.norm(scene.points - exact, axis=2) * MILLIMETRES
    error[~scene.visible] = np.nan
    alive = scene.visible.mean(axis=1)
    with np.errstate(all="ignore"):
        median, high = np.nanmedian(error, axis=1), np.nanpercentile(error, 95, axis=1)
    moved = np.einsum("tij,kj->tki", truth["grip_turns"], scene.controllers[0] - truth["grip_centre"])
    carried = moved + truth["grip_centre"] + truth["grip_shifts"][:, None]
    grip = np.linalg.norm(scene.controllers - carried, axis=2) * MILLIMETRES
    asked = [t for t in (30, 60, len(alive) - 1) if t < len(alive)]
    return Score(
        alive,
        median,
        high,
        {
            "recording": folder.name,
            "points": scene.points.shape[1],
            "seen": {str(t): int(scene.visible[t].sum()) for t in asked},
            "covered": {str(t): round(covered(vertices[t], scene, t), 3) for t in asked},
            "alive": {str(t): round(float(alive[t]), 3) for t in asked},
            "median_mm": {str(t): round(float(median[t]), 2) for t in asked},
            "p95_mm": {str(t): round(float(high[t]), 2) for t in asked},
            "seen_share": round(float(scene.visible.mean()), 3),
            "rms_mm": round(float(np.sqrt(np.nanmean(error**2))), 2),
            "grip_rms_mm": round(float(np.sqrt((grip**2).mean())), 2),
            "declared_noise_mm": round(1e3 * (scene.noise_sigma_m or 0.0), 2),
            "seconds": round(seconds, 1),
        },
    )


def covered(surface: Array, scene: Scene, frame: int) -> float:
    """Share of the surface's vertices (V, 3) [m] of a frame with a seen point nearby."""
    distance, _ = cKDTree(scene.points[frame, scene.visible[frame]]).query(surface)
    return float((distance < NEAR_M).mean())


def exact_tracks(folder: Path, scene: Scene) -> Array:
    """True tracks (T, N, 3) [m] of the material points that a scene of a rendered recording follows."""
    truth = np.load(folder / "truth.npz")
    if "line" not in truth:
        return followed_exactly(truth["vertices"].astype(np.float64), truth["triangles"], scene.points[0])
    poses = np.array(json.loads((folder / "calibrate.json").read_text()))
    eyes = poses[scene.extra_arrays["tracked_by_camera"], :3, 3]
    return beside_line(truth["line"].astype(np.float64), scene.points[0], eyes)


def beside_line(line: Array, places: Array, eyes: Array) -> Array:
    """Tracks (T, N, 3) [m] of points beside a rope's middle line, carried by its sections without twist.

    A camera tells how far beside the line a point is, across the line and its own ray; along the ray it is on the line.

    Args:
        line: (T, n, 3) [m].
        places: measured in the first frame, (N, 3) [m].
        eyes: where their cameras stand, (N, 3) [m].
    """
    pieces = np.diff(line[0], axis=0)
    share = np.einsum("nsi,si->ns", places[:, None] - line[0][None, :-1], pieces) / (pieces**2).sum(axis=1)
    share = np.clip(share, 0.0, 1.0)
    on_each = line[0][None, :-1] + share[..., None] * pieces
    own = np.argmin(np.linalg.norm(on_each - places[:, None], axis=2), axis=1)
    rows = np.arange(len(places))
    part = share[rows, own][None, :, None]
    middle: Array = (1.0 - part) * line[:, own] + part * line[:, own + 1]
    along = line[:, own + 1] - line[:, own]
    beside = np.cross(along[0], places - eyes)
    beside /= np.linalg.norm(beside, axis=1, keepdims=True)
    offset = beside * ((places - middle[0]) * beside).sum(axis=1, keepdims=True)
    tracks: Array = middle + np.einsum("tnij,nj->tni", least_rotation(along[:1], along), offset)
    return tracks


def followed_exactly(vertices: Array, triangles: Array, places: Array) -> Array:
    """Tracks (T, N, 3) [m] of the surface's material points nearest to places (N, 3) of the first frame.

    Args:
        vertices: of the surface, (T, V, 3) [m].
        triangles: (F, 3).
        places: measured [m].
    """
    corners = vertices[0][triangles]
    tracks = np.empty((len(vertices), len(places), 3))
    for number, place in enumerate(places):
        on_each = trimesh.triangles.closest_point(corners, np.tile(place, (len(corners), 1)))
        own = int(np.argmin(np.linalg.norm(on_each - place, axis=1)))
        weights = trimesh.triangles.points_to_barycentric(corners[own][None], on_each[own][None])[0]
        tracks[:, number] = np.einsum("k,tki->ti", weights, vertices[:, triangles[own]])
    return tracks


def table(figures: list[dict[str, Any]]) -> str:
    """Markdown."""
    lines = [
        "| recording | points | seen at 30, 60, last frame | surface covered [%] | median error [mm] | "
        "95 % below [mm] | grip [mm] | s |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in figures:
        seen = ", ".join(str(value) for value in row["seen"].values())
        near = ", ".join(f"{100 * value:.0f}" for value in row["covered"].values())
        median = ", ".join(f"{value:.2f}" for value in row["median_mm"].values())
        high = ", ".join(f"{value:.1f}" for value in row["p95_mm"].values())
        lines.append(
            f"| {row['recording']} | {row['points']} | {seen} | {near} | {median} | {high} | "
            f"{row['grip_rms_mm']:.2f} | {row['seconds']:.0f} |"
        )
    return "\n".join(lines) + "\n"
