"""Three depth cameras to one scene: what they see more than one, that nothing counts twice, and what is refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cameras_pictured as recorded
import numpy as np
import pytest

from benchmarks.tracking.measure import followed_exactly
from physworld.scene import Scene
from physworld.tracking.view import Box
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers.options import ImportOptions
from physworld_scenes.importers.pictures import read_pictures
from physworld_scenes.importers.rgbd import PictureOptions, read_folder

pytestmark = pytest.mark.slow

MEDIAN_MM, HIGH_MM = 0.9, 6.0  # of pictures of 320 x 240 px, whose depth has a noise of 2 mm
NEAR_M = 0.012


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cameras") / "bar"
    recorded.write(folder)
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """A copy to spoil; its pictures are those of the first."""
    copy = tmp_path / "bar"
    shutil.copytree(made, copy, copy_function=lambda source, to: Path(to).hardlink_to(source))
    for name in ("metadata.json", "calibrate.json"):
        (copy / name).unlink()
        shutil.copy(made / name, copy / name)
    return copy


def scene_of(folder: Path, **options: object) -> tuple[Scene, list[str]]:
    box = Box(*json.loads((folder / "truth.json").read_text())["box_px"])
    pictures = PictureOptions(boxes={0: box}, points=80, **options)  # type: ignore[arg-type]
    scene, warnings, _ = read_folder(folder, ImportOptions(kind="beam"), pictures)
    return scene, warnings


def errors_mm(folder: Path, scene: Scene) -> np.ndarray:
    with np.load(folder / "truth.npz") as truth:
        exact = followed_exactly(truth["vertices"].astype(float), truth["triangles"], scene.points[0])
    return 1e3 * np.linalg.norm(scene.points - exact, axis=2)[scene.visible]


def covered(folder: Path, scene: Scene, frame: int) -> float:
    """Share of the body's surface that has a seen point nearby at a frame."""
    with np.load(folder / "truth.npz") as truth:
        surface = truth["vertices"][frame].astype(float)
    seen = scene.points[frame, scene.visible[frame]]
    return float((np.linalg.norm(surface[:, None] - seen[None], axis=2).min(axis=1) < NEAR_M).mean())


def test_three_cameras_see_more_of_the_body_than_one_and_nothing_twice(made: Path, tmp_path: Path) -> None:
    recorded.first_camera(made, tmp_path / "one")
    (one, _), (three, warnings) = scene_of(tmp_path / "one"), scene_of(made)
    for scene, folder in ((one, tmp_path / "one"), (three, made)):
        miss = errors_mm(folder, scene)
        assert np.median(miss) < MEDIAN_MM and np.percentile(miss, 95) < HIGH_MM
    assert (three.visible.sum(axis=1) > one.visible.sum(axis=1)).all()
    last = recorded.FRAMES - 1
    assert three.visible[last].sum() > 1.25 * one.visible[last].sum()
    assert covered(made, three, 0) > 1.4 * covered(tmp_path / "one", one, 0)
    assert covered(made, three, last) > 1.2 * covered(tmp_path / "one", one, last)
    # the clouds of the first frame are one, and so are places that two cameras follow
    assert three.surface_points is not None and one.surface_points is not None
    assert len(three.surface_points) > 1.4 * len(one.surface_points)
    notes = three.declared["notes"]["cameras"]
    assert notes["places_counted_once"] > 0 and notes["left_out"] == {}
    assert all(apart < 5e-3 for apart in notes["clouds_apart_m"].values())
    assert len(notes["noise_m"]) == 3 and all(1e-5 < sigma < 2e-3 for sigma in notes["noise_m"])
    assert sorted(set(three.extra_arrays["tracked_by_camera"])) == [0, 1, 2]
    # the ground is that of all of them, the post beside the bar is none of it
    assert three.declared["notes"]["ground"]["height_m"] == pytest.approx(recorded.TABLE_M, abs=2e-3)
    assert three.points[0, :, 0].min() > -0.004
    assert not any("left out" in line for line in warnings)


def test_a_file_of_calibration_a_camera_is_the_same_recording(folder: Path) -> None:
    before = read_pictures(folder)
    lenses = json.loads((folder / "metadata.json").read_text())["intrinsics"]
    poses = json.loads((folder / "calibrate.json").read_text())
    (folder / "metadata.json").unlink()
    for part in ("intrinsics", "extrinsics"):
        (folder / part).mkdir()
    for number, (lens, pose) in enumerate(zip(lenses, poses, strict=True)):
        columns = {"intrinsic_matrix": np.array(lens).T.ravel().tolist()}
        (folder / f"intrinsics/{number}.json").write_text(json.dumps(columns if number else lens))
        place = {"camera_to_world": pose} if number else {"world_to_camera": np.linalg.inv(pose).tolist()}
        (folder / f"extrinsics/{number}.json").write_text(json.dumps(place))
    after = read_pictures(folder)
    assert after.layout == "a file a camera" and after.placed
    for one, other in zip(before.views, after.views, strict=True):
        assert np.allclose(one.camera.world_to_camera, other.camera.world_to_camera)
        assert one.camera.fx == other.camera.fx and one.camera.cy == other.camera.cy
    (folder / "extrinsics/0.json").write_text(
        json.dumps({"camera_to_world": poses[0], "world_to_camera": poses[0]})
    )
    with pytest.raises(SceneInvalid, match=r"extrinsics/0\.json: has 2 of the keys"):
        read_pictures(folder)
    (folder / "intrinsics/2.json").unlink()
    with pytest.raises(SceneInvalid, match=r"intrinsics: has no 2\.json; there are 3 cameras"):
        read_pictures(folder)
    shutil.rmtree(folder / "intrinsics")
    with pytest.raises(SceneInvalid, match="says nothing of its lens"):
        read_pictures(folder)


def moved_mm(*shift: float) -> np.ndarray:
    by = np.eye(4)
    by[:3, 3] = np.array(shift) / 1e3
    return by


def test_places_that_put_the_clouds_apart_are_refused_with_how_far(folder: Path) -> None:
    recorded.turned_poses(folder, 1, moved_mm(0, 0, 25))
    with pytest.raises(
        SceneInvalid, match=r"cameras 0 and 1 are 2\d\.\d mm apart at the object .* at most 15 mm"
    ):
        scene_of(folder)
    recorded.turned_poses(folder, 1, moved_mm(0, 0, -17))
    _, warnings = scene_of(folder)
    assert any("cameras 0 and 1 are" in line and "mm apart" in line for line in warnings)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            lambda poses: [np.linalg.inv(pose).tolist() for pose in poses],
            "sees through|apart at the object|pixels",
        ),
        (lambda poses: [poses[0], poses[2], poses[1]], "sees through|apart at the object"),
        (
            lambda poses: [poses[0], np.diag([1e3, 1e3, 1e3, 1]) @ np.array(poses[1]), poses[2]],
            "no turn and shift",
        ),
        (
            lambda poses: [poses[0], moved_mm(6e5, 0, 0) @ np.array(poses[1]), poses[2]],
            r"camera 1 stands 600\.5 m from",
        ),
        (lambda poses: [poses[0], np.diag([-1, 1, 1, 1]) @ np.array(poses[1]), poses[2]], "determinant -1"),
        (lambda poses: poses[:2], "there are 3 cameras, but 3 intrinsics and 2 poses"),
        (lambda poses: [*poses[:2], [[float("nan")] * 4] * 4], "not of its form"),
        (lambda poses: None, "is missing: 3 cameras need their places"),
    ],
)
def test_calibrations_that_are_wrong_at_large_are_refused(
    folder: Path, spoil: Callable[[list[list[list[float]]]], list[object] | None], said: str
) -> None:
    spoilt = spoil(json.loads((folder / "calibrate.json").read_text()))
    (folder / "calibrate.json").unlink()
    if spoilt is not None:
        (folder / "calibrate.json").write_text(json.dumps([np.array(pose).tolist() for pose in spoilt]))
    with pytest.raises(SceneInvalid, match=said):
        scene_of(folder)


def test_cameras_of_other_numbers_of_frames_or_other_names_are_refused(folder: Path) -> None:
    last = recorded.FRAMES - 1
    for kind in ("color", "depth"):
        (folder / f"{kind}/2/{last}.png").unlink()
    with pytest.raises(SceneInvalid, match=rf"cameras have \[{last + 1}, {last + 1}, {last}\] frames"):
        read_pictures(folder)
    (folder / "depth/2").rename(folder / "depth/3")
    with pytest.raises(SceneInvalid, match=r"have depth \(0, 1, 3\), 3 have colours \(0, 1, 2\)"):
        read_pictures(folder)


def test_options_of_a_camera_that_there_is_not_are_refused(folder: Path) -> None:
    with pytest.raises(SceneInvalid, match="mask: is of camera 3; there are 3, counted from 0"):
        scene_of(folder, masks={3: folder / "mask.png"})


def test_a_camera_that_does_not_show_the_object_is_left_out_and_said(folder: Path) -> None:
    poses = json.loads((folder / "calibrate.json").read_text())
    poses[2] = (np.array(poses[2]) @ np.diag([-1.0, 1, -1, 1])).tolist()  # it looks the other way
    (folder / "calibrate.json").write_text(json.dumps(poses))
    scene, warnings = scene_of(folder)
    assert any(line.startswith("camera 2 is left out: the object is behind the camera") for line in warnings)
    assert set(scene.extra_arrays["tracked_by_camera"]) == {0, 1}
