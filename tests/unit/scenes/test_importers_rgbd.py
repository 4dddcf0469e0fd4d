"""A folder of pictures to a scene, by the command that people use; damaged and hostile folders."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tracking_pictured import BOTTOM, FRAMES, LEFT, RIGHT, TOP, write

from physworld.tracking.ground import Plane
from physworld.tracking.view import Box
from physworld.video import Renderer, from_ply
from physworld_scenes.bundle import read_bundle
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers import rgbd
from physworld_scenes.importers.options import ImportOptions
from physworld_scenes.importers.pictures import is_pictures, read_pictures
from physworld_scenes.importers.rgbd import PictureOptions, read_folder
from physworld_scenes.importers.upright import upright
from physworld_workers.commands import importing
from physworld_workers.commands.video import camera_in

pytestmark = pytest.mark.slow

BOX = f"--box={LEFT - 8},{TOP - 8},{RIGHT + 8},{BOTTOM + 8}"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path / "plate")
    return tmp_path / "plate"


def test_the_command_writes_a_scene_with_z_up(folder: Path, tmp_path: Path) -> None:
    out, picture = tmp_path / "scene", tmp_path / "look.png"
    arguments = [str(folder), f"--out={out}", BOX, "--kind=sheet", "--fps=30", "--points=40", "--up=-y",
                 f"--patch={LEFT},{TOP},{LEFT + 30},{BOTTOM}", f"--held={LEFT},{TOP},{LEFT + 15},{BOTTOM}",
                 f"--picture={picture}", f"--pictures={tmp_path / 'pictures'}"]  # fmt: skip
    assert importing.main(arguments) == 0
    scene = read_bundle(out)
    assert scene.frame_count == FRAMES and scene.kind == "sheet" and scene.fps == 30.0
    assert scene.visible.mean() > 0.8
    # half a metre before the camera; the picture's rows are heights now
    assert np.allclose(scene.points[scene.visible][:, 1], 0.5, atol=2e-3)
    assert np.ptp(scene.points[0, :, 2]) > 0.05
    assert scene.controllers.shape == (FRAMES, 8, 3) and len(scene.grips) == 1
    assert scene.surface_points is not None and len(scene.surface_points) > 100 and picture.is_file()
    # the splat lies where the scene does and shows what the camera saw
    splat = from_ply((tmp_path / "pictures/splat.ply").read_bytes())
    assert np.abs(splat.means[:, 1] - 0.5).mean() < 5e-3
    with np.load(tmp_path / "pictures/frames.npz") as kept:
        frames = kept["frames"]
    camera = camera_in(tmp_path / "pictures/camera.json")
    assert frames.shape == (FRAMES, camera.height, camera.width, 3)
    seen = Renderer(camera).render(splat)
    inside = np.s_[TOP + 4 : BOTTOM - 4, LEFT + 4 : RIGHT - 4]
    assert (seen.alpha[inside] > 0.5).mean() > 0.98
    assert np.mean((seen.rgb[inside] - frames[0][inside] / 255.0) ** 2) < 10**-2.5  # a PSNR of 25 dB


def test_a_solid_without_a_declared_shape_is_filled_to_a_far_side_that_nothing_measures(
    tmp_path: Path,
) -> None:
    radius = 0.05
    write(tmp_path / "cylinder", round_m=radius)
    box = Box(LEFT - 8, TOP - 8, RIGHT + 8, BOTTOM + 8)
    given = PictureOptions(boxes={0: box}, up="-y", points=40)
    scene, warnings, _ = read_folder(tmp_path / "cylinder", ImportOptions(kind="blob", fps=30.0), given)
    volume = scene.rest_volume_points
    assert volume is not None and np.isclose(np.ptp(volume[:, 1]), 2 * radius, rtol=0.15)
    assert scene.surface_points is not None and np.ptp(scene.surface_points[:, 1]) < 1.1 * radius
    assert any("no camera sees the far side" in line and "mirror image" in line for line in warnings)
    declared = ImportOptions(
        kind="blob", fps=30.0, body={"box_min_m": [-0.08, 0.5, -0.06], "box_max_m": [0.08, 0.6, 0.06]}
    )
    scene, warnings, _ = read_folder(tmp_path / "cylinder", declared, given)
    assert scene.rest_volume_points is None and not any("far side" in line for line in warnings)


def test_a_guessed_far_side_ends_at_the_ground(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "cylinder", round_m=0.05)
    given = PictureOptions(boxes={0: Box(LEFT - 8, TOP - 8, RIGHT + 8, BOTTOM + 8)}, up="-y", points=40)
    lowest = -0.02

    def over_ground(*told: Any) -> Any:
        recording, _, how = upright(*told)
        return recording, Plane(np.array([0.0, 0.0, 1.0]), lowest, 0.5, 1e-3), how

    monkeypatch.setattr(rgbd, "upright", over_ground)
    scene, _, _ = read_folder(tmp_path / "cylinder", ImportOptions(kind="blob", fps=30.0), given)
    volume = scene.rest_volume_points
    assert volume is not None and lowest <= volume[:, 2].min() < lowest + 0.01


def test_without_a_box_it_says_what_is_missing(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert importing.main([str(folder), f"--out={tmp_path / 'scene'}", "--up=-y"]) == 2
    assert "Give a box or a mask" in capsys.readouterr().err
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize("option", ["--picture", "--pictures"])
def test_pictures_of_a_source_without_any_are_refused_before_a_scene_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    table = tmp_path / "markers.csv"
    table.write_text("t,x,y,z\n0,0,0,0\n0.1,0,0,0\n")
    out = tmp_path / "scene"
    assert importing.main([str(table), f"--out={out}", f"{option}={tmp_path / 'kept.png'}"]) == 2
    assert f"{option} {tmp_path / 'kept.png'} needs pictures" in capsys.readouterr().err
    assert not out.exists()


def test_pictures_that_disagree_or_are_cut_short_are_refused_by_name(folder: Path) -> None:
    assert is_pictures(folder)
    (folder / "depth/11.png").unlink()
    with pytest.raises(SceneInvalid, match="11 frames of depth and 12 of colour"):
        read_pictures(folder)
    (folder / "color/11.png").unlink()
    content = (folder / "depth/0.png").read_bytes()
    (folder / "depth/0.png").write_bytes(content[: len(content) // 2])
    with pytest.raises(SceneInvalid, match=r"0\.png.*damaged"):
        read_pictures(folder)


def test_a_picture_that_claims_to_be_huge_is_refused_before_it_is_decoded(folder: Path) -> None:
    head = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + head
    forged = (
        b"\x89PNG\r\n\x1a\n" + struct.pack(">I", len(head)) + chunk + struct.pack(">I", zlib.crc32(chunk))
    )
    (folder / "color/0.png").write_bytes(forged + bytes(64))
    with pytest.raises(SceneInvalid, match=r"0\.png"):
        read_pictures(folder)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "is no JSON"),
        ("[]", "not of its form"),
        (json.dumps({"intrinsic_matrix": [1, 2, 3]}), "not of its form"),
        (json.dumps({"intrinsic_matrix": [0] * 9}), "not of its form"),
        ("[" * 100_000, "is no JSON"),
    ],
)
def test_a_lens_that_is_none_is_refused(folder: Path, content: str, said: str) -> None:
    (folder / "camera_intrinsic.json").write_text(content)
    with pytest.raises(SceneInvalid, match=said):
        read_pictures(folder)


def test_calibrations_that_call_something_are_refused(folder: Path) -> None:
    import os
    import pickle

    class Evil:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.system, ("true",)

    (folder / "metadata.json").write_text(json.dumps({"intrinsics": [np.eye(3).tolist()]}))
    (folder / "calibrate.pkl").write_bytes(pickle.dumps([Evil()]))
    with pytest.raises(SceneInvalid, match="wants"):
        read_pictures(folder)
