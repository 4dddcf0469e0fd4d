"""Writes a play as a depth camera's recording, in PhysTwin's layout, with its truth beside it.

``color/CAMERA/FRAME.png``, ``depth/CAMERA/FRAME.png`` (uint16 [mm]), ``metadata.json`` (``intrinsics``, ``WH``,
``fps``), ``calibrate.json`` (camera to world, as PhysTwin's ``calibrate.pkl``), and for the measurement ``truth.npz``,
``truth.json``.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from benchmarks.tracking.depth_camera import DepthCamera
from benchmarks.tracking.plays import FPS, PLAYS, Play, marker_picture
from benchmarks.tracking.raycast import Stage


def write(name: str, folder: Path, cameras: int = 1, frames: int = 90, seed: int = 0) -> Play:
    """Simulate and render; the play.

    Args:
        name: of ``PLAYS``.
        folder: made if absent.
        cameras: 1 to 3.
        frames: T.
        seed: of the cameras' noise.
    """
    play = PLAYS[name](frames)
    render(play, folder, cameras, seed)
    return play


def render(play: Play, folder: Path, cameras: int = 1, seed: int = 0) -> None:
    """Write the play's pictures, calibration and truth into ``folder``."""
    stage = Stage(play.surfaces, play.table_m, marker_picture())
    errors = DepthCamera()
    for number, camera in enumerate(play.cameras[:cameras]):
        rng = np.random.default_rng([seed, number])
        for kind in ("color", "depth"):
            (folder / kind / str(number)).mkdir(parents=True, exist_ok=True)
        pattern = errors.pattern((camera.height, camera.width), rng)
        for frame, vertices in enumerate(play.vertices):
            exact, depth, _ = stage.show(vertices, camera, frame)
            colour = errors.colour(exact, rng)
            cv2.imwrite(
                str(folder / f"color/{number}/{frame}.png"),
                colour[..., ::-1],
                [cv2.IMWRITE_PNG_COMPRESSION, 1],
            )
            cv2.imwrite(
                str(folder / f"depth/{number}/{frame}.png"), errors.depth_mm(depth, camera.fx, pattern, rng)
            )
    shown = play.cameras[:cameras]
    metadata = {
        "intrinsics": [[[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]] for c in shown],
        "WH": [shown[0].width, shown[0].height],
        "fps": FPS,
        "frame_num": len(play.vertices),
    }
    (folder / "metadata.json").write_text(json.dumps(metadata, indent=1) + "\n")
    poses = [np.linalg.inv(camera.world_to_camera).tolist() for camera in shown]
    (folder / "calibrate.json").write_text(json.dumps(poses, indent=1) + "\n")
    np.savez_compressed(
        folder / "truth.npz",
        vertices=play.vertices[:, : play.object_vertices].astype(np.float32),
        triangles=play.triangles,
        grip_turns=play.grip_poses[0],
        grip_shifts=play.grip_poses[1],
        grip_centre=play.grip_centre,
        **({} if play.line is None else {"line": play.line.astype(np.float32)}),
    )
    facts = {"kind": play.kind, "box_px": play.box_px, "declared": play.declared, "truth": play.truth}
    (folder / "truth.json").write_text(json.dumps(facts, indent=1) + "\n")
