"""Made motion, written in the layout of every program, imported: the scene is the truth within the file's rounding."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import marker_files as files
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physworld.scene import Scene
from physworld_scenes.importers import ImportOptions, import_any, importer_of, look_at
from physworld_scenes.importers.axes import ROTATION_FROM_UP

pytestmark = pytest.mark.slow

MOTION = files.made()
FACTS = ImportOptions(kind="sheet", body={"mass_kg": 0.08, "thickness_m": 1e-3, "side_m": 0.4}, assume=False)
MICROMETRE = 1e-6
"""Six digits of a metre: half of it, and the float of the arithmetic."""


def imported(data: bytes, filename: str, options: ImportOptions = FACTS) -> Scene:
    return import_any(data, filename, options)[0]


def assert_truth(scene: Scene, motion: files.Motion = MOTION, tolerance: float = MICROMETRE) -> None:
    """The scene's points, what is seen of them, its clock and its controllers are the motion's."""
    seen = np.isfinite(motion.points).all(axis=2)
    assert np.array_equal(scene.visible, seen)
    assert np.abs(scene.points[seen] - motion.points[seen]).max() < tolerance
    assert scene.controllers.shape == motion.gripper.shape
    assert np.abs(scene.controllers - motion.gripper).max() < tolerance
    assert np.abs(scene.times - motion.times).max() < 1e-6
    assert scene.fps == pytest.approx(motion.rate_hz, rel=1e-4)
    assert scene.gravity_m_s2.tolist() == [0.0, 0.0, -9.81]


@pytest.mark.parametrize("unit", ["m", "mm", "cm"])
@pytest.mark.parametrize("version", ["1.1", "1.2", "1.22", "1.23", "1.24", "1.25"])
def test_motive(version: str, unit: str) -> None:
    data = files.motive(MOTION, version=version, unit=unit)
    scene = imported(data, "take.csv")
    assert_truth(scene)
    assert scene.declared["notes"]["source"] == {
        "format": f"OptiTrack Motive CSV {version}",
        "unit": unit,
        "up": "y",
    }


@pytest.mark.parametrize("up", list(ROTATION_FROM_UP))
def test_motive_exported_with_another_axis_up_is_told(up: str) -> None:
    options = ImportOptions(kind="sheet", body=FACTS.body, up=up)
    assert_truth(imported(files.motive(MOTION, up=up), "take.csv", options))


@pytest.mark.parametrize("up", ["y", "z", "-x"])
def test_a_pose_alone_becomes_four_controllers_that_turn_with_it(up: str) -> None:
    data = files.motive(MOTION, up=up, solved=False, measured=False, digits=9)
    scene = imported(data, "take.csv", ImportOptions(kind="sheet", body=FACTS.body, up=up))
    turns = Rotation.from_quat(MOTION.turns[:, [1, 2, 3, 0]])
    arms = np.vstack([np.zeros(3), 0.05 * ROTATION_FROM_UP[up].T])  # the body's axes are the file's
    expected = np.stack([turns.apply(arm) for arm in arms], axis=1) + MOTION.origin[:, None]
    assert np.abs(scene.controllers - expected).max() < MICROMETRE
    assert scene.declared["notes"]["controller_labels"] == [
        "Gripper origin",
        "Gripper x",
        "Gripper y",
        "Gripper z",
    ]


def test_markers_of_a_rigid_body_without_its_pose_are_a_group_by_name() -> None:
    scene = imported(files.motive(MOTION, pose=False, measured=False), "take.csv")
    assert_truth(scene)


def test_measured_markers_give_way_to_solved_ones_and_unlabelled_ones_are_dropped() -> None:
    scene = imported(files.motive(MOTION, unlabelled=3), "take.csv")
    assert_truth(scene)
    said = scene.declared["notes"]["left_out"]
    assert "4 measured markers of rigid bodies give way to the solved ones" in said[0]
    assert said[-1] == "3 markers are dropped: Unlabeled 1189, Unlabeled 1190, Unlabeled 1191"


@pytest.mark.parametrize("others", [True, False])
@pytest.mark.parametrize("delimiter", [",", "\t"])
def test_vicon(others: bool, delimiter: str) -> None:
    scene = imported(files.vicon(MOTION, others=others, delimiter=delimiter), "trial.csv")
    assert_truth(scene)
    assert scene.declared["notes"]["point_labels"][0] == "Cloth:M1"
    assert scene.declared["notes"]["left_out"] == (
        ["sections left out: Devices, Model Outputs"] if others else []
    )


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("heads", [True, False])
@pytest.mark.parametrize("version", [None, "2.0.0"])
def test_qualisys(version: str | None, heads: bool, timed: bool) -> None:
    assert_truth(imported(files.qualisys(MOTION, version=version, heads=heads, timed=timed), "trial.tsv"))


@pytest.mark.parametrize("missing", ["", "0.000", "NULL"])
def test_qualisys_writes_what_it_does_not_see_in_three_ways(missing: str) -> None:
    motion = with_gaps()
    _, tracks = motion.tracks()
    assert_truth(imported(files.qualisys(motion, missing=missing, places=tracks), "trial.tsv"), motion)


@pytest.mark.parametrize("blank", [True, False])
@pytest.mark.parametrize("unit", ["mm", "m"])
def test_trc(unit: str, blank: bool) -> None:
    assert_truth(imported(files.trc(MOTION, unit=unit, blank=blank), "trial.trc"))


@pytest.mark.parametrize("naming", [*files.NAMINGS, "two rows"])
def test_plain_columns_by_any_naming(naming: str) -> None:
    unit = "mm" if "unit" in naming or "brackets" in naming else "m"
    assert_truth(imported(files.columns(MOTION, naming=naming, unit=unit), "tracks.csv"))


@pytest.mark.parametrize(
    "written",
    [
        {"delimiter": ";", "decimal": ","},
        {"delimiter": "\t"},
        {"time": "time_ms"},
        {"time": "Time (Seconds)"},
        {"time": "t"},
        {"comment": "# "},
    ],
    ids=str,
)
def test_plain_columns_as_other_programs_write_them(written: dict[str, str]) -> None:
    assert_truth(imported(files.columns(MOTION, **written), "tracks.csv"))


@pytest.mark.parametrize("by_marker", [True, False])
def test_plain_columns_in_the_long_layout(by_marker: bool) -> None:
    motion = with_gaps()
    assert_truth(imported(files.long_columns(motion, by_marker=by_marker), "tracks.csv"), motion)


@pytest.mark.parametrize("unit", ["m", "cm", "mm"])
@pytest.mark.parametrize("up", ["y", "z", "-y"])
def test_unit_and_axis_of_plain_columns_are_guessed_from_the_data(up: str, unit: str) -> None:
    """The cloth hangs from its gripper, and spans half a metre."""
    data = files.columns(MOTION, up=up, unit=unit)
    assert_truth(imported(data, "tracks.csv"))
    found = {what: (value, how) for what, value, how, _ in look_at(data, "tracks.csv")[1].guesses}
    assert found["up"] == (up, "guessed: the body hangs from its gripper along it")
    assert found["unit"][0] == unit and "guessed: the markers span" in found["unit"][1]


@pytest.mark.parametrize("screen", [True, False])
@pytest.mark.parametrize("up", ["z", "y"])
def test_c3d(up: str, screen: bool, tmp_path: Path) -> None:
    data = files.c3d(MOTION, tmp_path / "trial.c3d", up=up, screen=screen)
    options = FACTS if screen or up == "z" else ImportOptions(kind="sheet", body=FACTS.body, up=up)
    assert_truth(imported(data, "trial.c3d", options))


@pytest.mark.parametrize("unit", ["m", "mm"])
@pytest.mark.parametrize("up", ["z", "y"])
def test_npz(up: str, unit: str) -> None:
    scene = imported(files.npz(MOTION, up=up, unit=unit), "tracks.npz")
    assert_truth(scene)
    assert scene.declared["notes"]["point_labels"][:2] == ["m1", "m2"]


@pytest.mark.parametrize("unit", ["m", "mm"])
@pytest.mark.parametrize("up", ["z", "-y"])
def test_hdf5(up: str, unit: str, tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    assert_truth(imported(files.hdf5(MOTION, tmp_path / "tracks.h5", up=up, unit=unit), "tracks.h5"))


@pytest.mark.parametrize("write", [files.mcap_json, files.mcap_ros2])
def test_mcap(write: Callable[[files.Motion], bytes]) -> None:
    pytest.importorskip("mcap_ros2")
    scene = imported(write(MOTION), "log.mcap")
    turns = Rotation.from_quat(MOTION.turns[:, [1, 2, 3, 0]])
    arms = np.vstack([np.zeros(3), 0.05 * np.eye(3)])
    expected = np.stack([turns.apply(arm) for arm in arms], axis=1) + MOTION.origin[:, None]
    assert np.abs(scene.points - MOTION.points).max() < 1e-9
    assert np.abs(scene.controllers - expected).max() < 1e-9
    assert np.abs(scene.times - MOTION.times).max() < 1e-6


def test_the_content_decides_and_the_name_may_be_said() -> None:
    data = files.trc(MOTION)
    assert importer_of(data, "anything.csv").name == "trc"
    assert importer_of(files.columns(MOTION), "x.csv").name == "columns"
    assert importer_of(files.columns(MOTION), "no suffix").name == "columns"
    assert importer_of(data, "x", ImportOptions(importer="columns")).name == "columns"


def with_gaps() -> files.Motion:
    """The motion with markers that are lost for some frames."""
    points = MOTION.points.copy()
    points[10:20, 3] = np.nan
    points[50, :5] = np.nan
    points[-4:, 9] = np.nan
    return files.Motion(MOTION.times, points, MOTION.gripper, MOTION.origin, MOTION.turns)


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (lambda m: files.motive(m), "a.csv"),
        (lambda m: files.vicon(m), "a.csv"),
        (lambda m: files.trc(m), "a.trc"),
        (lambda m: files.columns(m), "a.csv"),
        (lambda m: files.npz(m), "a.npz"),
    ],
    ids=["motive", "vicon", "trc", "columns", "npz"],
)
def test_markers_that_are_lost_are_not_visible(write: Callable[[files.Motion], bytes], name: str) -> None:
    motion = with_gaps()
    scene = imported(write(motion), name)
    assert_truth(scene, motion)
    between = scene.points[10:20, 3]
    assert np.isfinite(between).all() and not scene.visible[10:20, 3].any()
