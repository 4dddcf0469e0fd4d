"""Colliders of a scene: through the bundle and back, and every fault of them by name."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scene_parts import FRAMES, sound_parts

from physworld_scenes.archive_writing import write_arrays, write_zip
from physworld_scenes.bundle import bundle_from_bytes, canonical_archive, read_bundle, validate, write_bundle
from physworld_scenes.colliders import MeshRefused, read_mesh, write_mesh
from physworld_scenes.errors import SceneInvalid

PEG = trimesh.creation.icosphere(subdivisions=2, radius=0.03)


def push_parts() -> tuple[dict[str, Any], dict[str, np.ndarray], dict[str, bytes]]:
    """The sound scene with a ball that a controller carries, a peg from a mesh on a track, and a still shelf."""
    declared, arrays = sound_parts()
    declared["grips"][0]["controllers"] = [0]
    poses = np.zeros((FRAMES, 7))
    poses[:, 0], poses[:, 3] = np.linspace(0.4, 0.2, FRAMES), 1.0
    arrays["peg_poses"] = poses
    declared["colliders"] = [
        {"name": "ball", "shape": "sphere", "radius_m": 0.02, "friction": 0.3, "controllers": [1, 2, 3]},
        {"name": "peg", "shape": "mesh", "mesh": "tools/peg.stl", "poses": "peg_poses", "maker": "nobody"},
        {"name": "shelf", "shape": "box", "size_m": [0.5, 0.5, 0.02], "position_m": [0.0, 0.0, 0.2]},
    ]
    return declared, arrays, {"tools/peg.stl": PEG.export(file_type="stl")}


def archive(
    declared: dict[str, Any], arrays: dict[str, np.ndarray], files: dict[str, bytes], top: str = ""
) -> bytes:
    whole = {"scene.json": json.dumps(declared).encode(), "scene.npz": write_arrays(arrays), **files}
    return write_zip({top + name: content for name, content in whole.items()})


def faults_of(change: Callable[[dict[str, Any], dict[str, np.ndarray], dict[str, bytes]], None]) -> list[str]:
    parts = push_parts()
    change(*parts)
    with pytest.raises(SceneInvalid) as caught:
        bundle_from_bytes(archive(*parts))
    return [f"{'.'.join(map(str, fault.loc))}: {fault.msg}" for fault in caught.value.faults]


@pytest.mark.parametrize("top", ["", "push/"])
def test_colliders_come_out_of_a_bundle_as_declared(top: str) -> None:
    scene, _ = bundle_from_bytes(archive(*push_parts(), top=top))
    ball, peg, shelf = scene.colliders
    assert (ball.shape, ball.radius_m, ball.friction, ball.controllers) == ("sphere", 0.02, 0.3, (1, 2, 3))
    assert peg.mesh is not None and peg.mesh.volume_m3 == pytest.approx(PEG.volume, rel=1e-5)
    assert scene.extra_arrays["peg_poses"].shape == (FRAMES, 7)
    assert shelf.position_m.tolist() == [0, 0, 0.2] and shelf.quaternion_wxyz.tolist() == [1, 0, 0, 0]


def test_the_canonical_archive_of_a_pushed_scene_is_its_own(tmp_path: Path) -> None:
    scene, _ = bundle_from_bytes(archive(*push_parts()))
    stored = canonical_archive(scene)
    again, _ = bundle_from_bytes(stored)
    assert canonical_archive(again) == stored
    assert (
        again.declared["colliders"][1]["mesh"] == "peg.off"
        and again.declared["colliders"][1]["maker"] == "nobody"
    )
    write_bundle(scene, tmp_path / "push")
    assert canonical_archive(read_bundle(tmp_path / "push")) == stored
    assert validate(scene)[0] == []


def test_a_scene_without_colliders_says_nothing_of_them() -> None:
    scene, _ = bundle_from_bytes(archive(*sound_parts(), {}))
    again, _ = bundle_from_bytes(canonical_archive(scene))
    assert "colliders" not in again.declared


def shift(key: str, value: Any, number: int = 1) -> Callable[..., None]:
    def change(declared: dict[str, Any], arrays: dict[str, np.ndarray], files: dict[str, bytes]) -> None:
        declared["colliders"][number][key] = value

    return change


def holed(declared: dict[str, Any], arrays: dict[str, np.ndarray], files: dict[str, bytes]) -> None:
    files["tools/peg.stl"] = trimesh.Trimesh(PEG.vertices, PEG.faces[1:]).export(file_type="stl")


def in_millimetres(declared: dict[str, Any], arrays: dict[str, np.ndarray], files: dict[str, bytes]) -> None:
    files["tools/peg.stl"] = trimesh.Trimesh(1000 * PEG.vertices, PEG.faces).export(file_type="stl")


def broken_file(declared: dict[str, Any], arrays: dict[str, np.ndarray], files: dict[str, bytes]) -> None:
    files["tools/peg.stl"] = b"solid nothing"


def nan_pose(declared: dict[str, Any], arrays: dict[str, np.ndarray], files: dict[str, bytes]) -> None:
    arrays["peg_poses"][7, 2] = np.nan


def long_quaternion(declared: dict[str, Any], arrays: dict[str, np.ndarray], files: dict[str, bytes]) -> None:
    arrays["peg_poses"][5, 3] = 1.2


def short_track(declared: dict[str, Any], arrays: dict[str, np.ndarray], files: dict[str, bytes]) -> None:
    arrays["peg_poses"] = arrays["peg_poses"][:9]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (holed, "colliders.1.mesh: tools/peg.stl is not watertight: 3 of 957 edges"),
        (in_millimetres, "colliders.1.mesh: is 60 m long beside an object of 0.3053 m, 197 times: do their units"),
        (broken_file, "colliders.1.mesh: tools/peg.stl"),
        (shift("mesh", "peg.stl"), "colliders.1.mesh: is 'peg.stl', which is not in the bundle"),
        (shift("mesh", "../peg.stl"), "colliders.1.mesh: is '../peg.stl', which is no path inside of the bundle"),
        (shift("mesh", "/etc/peg.stl"), "colliders.1.mesh: is '/etc/peg.stl', which is no path inside"),
        (shift("mesh", "peg.blend"), "colliders.1.mesh: is 'peg.blend'; meshes are .stl, .obj, .ply, .off files"),
        (nan_pose, "colliders.1.poses: peg_poses is not finite in 1 poses, first in 7"),
        (long_quaternion, "colliders.1.poses: has a quaternion [1.2, 0.0, 0.0, 0.0] of length 1.2, not 1"),
        (short_track, "colliders.1.poses: peg_poses has shape (9, 7) of float64, not (30, 7)"),
        (shift("poses", "nowhere"), "colliders.1.poses: is 'nowhere'; scene.npz holds"),
        (shift("controllers", [2]), "colliders.1.controllers: names controller 2, which collider 'ball' has"),
        (shift("controllers", [0], 0), "colliders.0.controllers: names controller 0, which grip 0 has"),
        (shift("controllers", [9], 0), "colliders.0.controllers: names [9], there are 4 (0 to 3)"),
        (shift("controllers", [3]), "colliders.1.controllers: carry it, and so does the array 'peg_poses'"),
        (shift("name", "ball"), "colliders.1.name: is 'ball', as another collider's"),
        (shift("radius_m", None, 0), "colliders.0: is a sphere without radius_m"),
        (shift("radius_m", 80.0, 0), "colliders.0.radius_m: is 160 m long beside an object"),
        (shift("quaternion_wxyz", [0, 0, 0, 0], 2), "colliders.2.quaternion_wxyz: has a quaternion"),
        (shift("shape", "teapot", 2), "colliders.2.shape: "),
    ],
)  # fmt: skip
def test_a_fault_of_a_collider_is_named(change: Callable[..., None], message: str) -> None:
    assert any(message in fault for fault in faults_of(change)), faults_of(change)


def test_a_mesh_outside_of_a_folder_is_not_followed(tmp_path: Path) -> None:
    declared, arrays, files = push_parts()
    bundle = tmp_path / "push"
    (bundle / "tools").mkdir(parents=True)
    (bundle / "scene.json").write_text(json.dumps(declared))
    (bundle / "scene.npz").write_bytes(write_arrays(arrays))
    (tmp_path / "peg.stl").write_bytes(files["tools/peg.stl"])
    (bundle / "tools" / "peg.stl").symlink_to(tmp_path / "peg.stl")
    with pytest.raises(SceneInvalid, match="not in the bundle"):
        read_bundle(bundle)


def test_a_mesh_whose_member_is_damaged_is_a_fault_of_the_bundle() -> None:
    declared, arrays, files = push_parts()
    data, content = bytearray(archive(declared, arrays, files)), files["tools/peg.stl"]
    data[data.index(content) + len(content) // 2] ^= 1
    with pytest.raises(SceneInvalid, match="Bad CRC-32") as caught:
        bundle_from_bytes(bytes(data))
    assert [fault.loc for fault in caught.value.faults] == [["tools/peg.stl"]]


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off"])
def test_a_mesh_is_the_same_from_every_format_and_off_loses_nothing(suffix: str) -> None:
    exported = PEG.export(file_type=suffix)
    mesh = read_mesh(f"peg.{suffix}", exported if isinstance(exported, bytes) else exported.encode())
    assert mesh.fault() is None
    assert mesh.volume_m3 == pytest.approx(PEG.volume, rel=1e-5)
    again = read_mesh("peg.off", write_mesh(mesh))
    assert np.array_equal(again.vertices, mesh.vertices) and np.array_equal(again.faces, mesh.faces)


@pytest.mark.parametrize(
    "content", [b"", b"OFF\n1 1 0\n0 0 0\n3 0 1 2\n", b"\x00" * 100, b"ply\nformat ascii 1.0\n"]
)
@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off"])
def test_a_damaged_mesh_is_refused(suffix: str, content: bytes) -> None:
    with pytest.raises(MeshRefused):
        read_mesh(f"peg.{suffix}", content)
