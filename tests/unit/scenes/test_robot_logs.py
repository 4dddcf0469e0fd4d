"""A robot's log as the gripper's motion: MCAP with poses and tf, LeRobot's episodes, CSV; and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import robot_logs as logs
from scipy.spatial.transform import Rotation
from tracking_pictured import BOTTOM, FRAMES, LEFT, RIGHT, TOP, write

from physworld_scenes.bundle import read_bundle
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers import library
from physworld_scenes.importers.axes import ROTATION_FROM_UP
from physworld_scenes.importers.robot.log import RobotLog, read_log
from physworld_workers.commands import importing

Array = np.ndarray
TIMES = np.arange(60) / 50.0
PLACES, TURNS = logs.path_of(TIMES)
STAMP_M = 1e-6
"""Of a place: stamps of 1.7e9 s are known to 2e-7 s."""
FLOAT_M = 1e-6
"""Of a place in float32, as LeRobot stores it."""


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Libraries parse in this process, as in a tracking's; the tests of the command take the other way."""
    monkeypatch.setattr(library, "_limited_here", True)


def turned(log: RobotLog, turns: Array) -> float:
    """The largest angle between a log's rotations and others [rad]."""
    assert log.turns is not None
    found, wanted = (Rotation.from_quat(q[:, [1, 2, 3, 0]]) for q in (log.turns, turns))
    return float((found * wanted.inv()).magnitude().max())


def data_set(folder: Path, names: object = list(logs.EULER)) -> Path:
    """Two episodes in two files, as format v2 has them; the second one is the path."""
    logs.lerobot_info(folder, names)
    other = np.zeros((len(TIMES), 7))
    for number, states in ((0, other), (1, logs.states_of(TIMES))):
        logs.lerobot_file(folder / f"data/chunk-000/episode_{number:06d}.parquet", {number: (TIMES, states)})
    return folder


@pytest.mark.parametrize(
    "written",
    [
        lambda: logs.mcap_json({"/tool/pose": (TIMES, PLACES, TURNS)}, {"/joints": {"position": [1, 2]}}),
        lambda: logs.mcap_pose(TIMES, PLACES, TURNS),
        lambda: logs.mcap_transform(TIMES, PLACES, TURNS),
    ],
    ids=["JSON", "PoseStamped", "TransformStamped"],
)
def test_poses_of_mcap_come_back_on_a_clock_from_the_first_one(
    tmp_path: Path, written: Callable[[], bytes]
) -> None:
    (tmp_path / "take.mcap").write_bytes(written())
    log = read_log(tmp_path / "take.mcap")
    assert np.abs(log.times - TIMES).max() < 1e-6
    assert np.abs(log.places - PLACES).max() < STAMP_M and turned(log, TURNS) < 1e-6


def test_a_frame_of_tf_is_joined_up_to_its_root(tmp_path: Path) -> None:
    """base to flange moves, flange to tool is static, both turned; an arm beside it is not asked for."""
    mount = Rotation.from_euler("z", 0.7)
    flange = Rotation.from_quat(TURNS[:, [1, 2, 3, 0]])
    links = [
        ("base", "flange", TIMES, PLACES, TURNS),
        ("flange", "tool", TIMES[:1], np.array([[0.0, 0.0, 0.1]]), mount.as_quat()[None, [3, 0, 1, 2]]),
        ("base", "other", TIMES + 0.003, PLACES, TURNS),
    ]
    (tmp_path / "take.mcap").write_bytes(logs.mcap_tf(links))
    log = read_log(tmp_path / "take.mcap", "/tf_static:tool")
    assert log.told == "MCAP, /tf_static:tool in base" and len(log.times) == len(TIMES)
    assert np.abs(log.places - (PLACES + flange.apply([0.0, 0.0, 0.1]))).max() < STAMP_M
    assert turned(log, (flange * mount).as_quat()[:, [3, 0, 1, 2]]) < 1e-6
    with pytest.raises(SceneInvalid, match="poses /tf:flange, /tf:other, /tf_static:tool: say which"):
        read_log(tmp_path / "take.mcap")


def test_links_of_tf_are_interpolated_over_the_time_that_all_are_sent(tmp_path: Path) -> None:
    late = TIMES[5:50:5] + 0.004
    links = [
        ("base", "arm", TIMES, PLACES, np.tile([1.0, 0, 0, 0], (len(TIMES), 1))),
        ("arm", "tool", late, np.stack([0 * late, late, 0 * late], axis=1), np.tile([1.0, 0, 0, 0], (len(late), 1))),
    ]  # fmt: skip
    (tmp_path / "take.mcap").write_bytes(logs.mcap_tf(links))
    log = read_log(tmp_path / "take.mcap", "/tf:tool")
    inside = TIMES[np.searchsorted(TIMES, late[0]) : np.searchsorted(TIMES, late[-1])]
    assert np.abs(log.times - (inside - inside[0])).max() < 1e-6
    assert np.abs(log.places - logs.path_of(inside)[0] - np.outer(inside, [0, 1, 0])).max() < STAMP_M


def bad_mcap(times: Array = TIMES, places: Array = PLACES, turns: Array = TURNS) -> Callable[[], bytes]:
    return lambda: logs.mcap_json({"/tool/pose": (times, places, turns)}, {"/joints": {"position": [1]}})


def spoilt(values: Array, row: int, value: float) -> Array:
    changed = values.copy()
    changed[row] = value
    return changed


IDENTITY = np.array([[1.0, 0.0, 0.0, 0.0]])
LOOP = [(one, other, TIMES[:1], PLACES[:1], IDENTITY) for one, other in (("a", "b"), ("b", "a"))]
TWO = [(parent, "tool", TIMES[:1], PLACES[:1], IDENTITY) for parent in ("base", "cell")]
APART = [
    ("base", "arm", TIMES[:9], PLACES[:9], TURNS[:9]),
    ("arm", "tool", TIMES[20:], PLACES[20:], TURNS[20:]),
]
REFUSED: dict[str, tuple[Callable[[], bytes], str | None, str]] = {
    "no such topic": (bad_mcap(), "/tool", "holds no pose /tool; it has /tool/pose"),
    "no poses": (lambda: logs.mcap_json({}, {"/joints": {"a": 1}}), None, r"/joints \(sensor_msgs/JointState\)"),
    "empty": (lambda: logs.mcap_json({}), None, "its topics are none"),
    "two topics": (
        lambda: logs.mcap_json({"/a": (TIMES, PLACES, TURNS), "/b": (TIMES, PLACES, TURNS)}),
        None,
        "holds the poses /a, /b: say which",
    ),
    "one pose": (bad_mcap(TIMES[:1], PLACES[:1], TURNS[:1]), None, "holds 1 poses of MCAP, /tool/pose; at least 2"),
    "NaN": (bad_mcap(places=spoilt(PLACES, 7, np.nan)), None, "1 of 60 poses are not finite, the first is number 7"),
    "far": (bad_mcap(places=1e3 * PLACES), None, "coordinate of 300 m"),
    "a clock that stands": (bad_mcap(spoilt(TIMES, 9, TIMES[8])), None, r"after .* \(1 of 59 steps\)"),
    "no rotation": (bad_mcap(turns=0.5 * TURNS), None, "quaternion of pose 0 has length 0.5, not 1"),
    "cut short": (lambda: logs.mcap_pose(TIMES, PLACES, TURNS)[:900], None, "take.mcap: cannot be read"),
    "a loop": (lambda: logs.mcap_tf(LOOP), "/tf_static:a", "are a loop"),
    "two parents": (lambda: logs.mcap_tf(TWO), None, "in the frame base, then in cell"),
    "apart": (lambda: logs.mcap_tf(APART), "/tf:tool", "from base to /?.*tool are sent at no common time"),
}  # fmt: skip


@pytest.mark.parametrize("what", list(REFUSED))
def test_mcap_that_tells_no_motion_is_refused_with_its_numbers(tmp_path: Path, what: str) -> None:
    written, pose, words = REFUSED[what]
    (tmp_path / "take.mcap").write_bytes(written())
    with pytest.raises(SceneInvalid, match=words) as refusal:
        read_log(tmp_path / "take.mcap", pose)
    assert len(refusal.value.faults) == 1 and len(str(refusal.value)) < 400


def test_an_episode_is_read_by_its_number_or_by_its_file(tmp_path: Path) -> None:
    folder = data_set(tmp_path / "set")
    for path, episode in ((folder, 1), (folder / "data/chunk-000/episode_000001.parquet", None)):
        log = read_log(path, episode=episode)
        assert "episode 1, roll, pitch, yaw" in log.told and np.abs(log.times - TIMES).max() < 1e-6
        assert np.abs(log.places - PLACES).max() < FLOAT_M and turned(log, TURNS) < 1e-5
    with pytest.raises(SceneInvalid, match="several episodes, 2 from 0 to 1"):
        read_log(folder)
    with pytest.raises(SceneInvalid, match="has no episode 7; it has 2 from 0 to 1"):
        read_log(folder, episode=7)


def test_an_episode_is_found_in_a_file_of_several(tmp_path: Path) -> None:
    """Format v3; states as lists of a fixed size, and info.json beside the file."""
    logs.lerobot_info(tmp_path, list(logs.EULER))
    file = tmp_path / "file-000.parquet"
    states = logs.states_of(TIMES)
    logs.lerobot_file(file, {4: (TIMES[:9], 0 * states[:9]), 5: (TIMES, states)}, pa.list_(pa.float32(), 7))
    (tmp_path / "meta/info.json").rename(tmp_path / "info.json")
    log = read_log(file, episode=5)
    assert len(log.times) == len(TIMES) and np.abs(log.places - PLACES).max() < FLOAT_M


VECTOR = Rotation.from_quat(TURNS[:, [1, 2, 3, 0]]).as_rotvec()
NAMED: dict[str, tuple[object, Array, str | None]] = {
    "LeRobot's kinematics": ([f"ee.{n}" for n in ("x", "y", "z", "wx", "wy", "wz")], VECTOR, None),
    "axis_angle": ({"motors": ["x", "y", "z", "axis_angle1", "axis_angle2", "axis_angle3"]}, VECTOR, None),
    "a quaternion": ({"axes": [*(f"eef_pos_{a}" for a in "xyz"), *(f"eef_quat_{a}" for a in "wxyz")]}, TURNS, "eef"),
    "rx to rw": (["x", "y", "z", "rx", "ry", "rz", "rw"], TURNS[:, [1, 2, 3, 0]], None),
    "indices by name": ({n: i for i, n in enumerate(["x", "y", "z", "qw", "qx", "qy", "qz"])}, TURNS, None),
}  # fmt: skip


@pytest.mark.parametrize("what", list(NAMED))
def test_names_tell_how_a_rotation_is_written(tmp_path: Path, what: str) -> None:
    names, rotation, pose = NAMED[what]
    logs.lerobot_info(tmp_path, names)
    file = tmp_path / "data/chunk-000/episode_000000.parquet"
    logs.lerobot_file(file, {0: (TIMES, np.column_stack([PLACES, rotation]))})
    log = read_log(file, pose)
    assert np.abs(log.places - PLACES).max() < FLOAT_M and turned(log, TURNS) < 1e-5


def test_one_of_two_arms_is_chosen_by_what_stands_before_its_names(tmp_path: Path) -> None:
    arms = [f"{arm}_{name}" for arm in ("left", "right") for name in logs.EULER]
    logs.lerobot_info(tmp_path, arms)
    file = tmp_path / "data/chunk-000/episode_000000.parquet"
    states = logs.states_of(TIMES)
    logs.lerobot_file(file, {0: (TIMES, np.column_stack([0 * states, states]))})
    assert np.abs(read_log(file, "right").places - PLACES).max() < FLOAT_M
    assert not read_log(file, "left").places.any()
    with pytest.raises(SceneInvalid, match="has the poses left, right: say which"):
        read_log(file)
    with pytest.raises(SceneInvalid, match="no pose middle; its poses are left, right"):
        read_log(file, "middle")


JOINTS = [
    "shoulder_pan.pos",
    "shoulder_lift.pos",
    "elbow_flex.pos",
    "wrist_flex.pos",
    "wrist_roll.pos",
    "a",
    "b",
]
UNREAD: dict[str, tuple[object, Array, str]] = {
    "joints": (JOINTS, logs.states_of(TIMES), "shoulder_pan.pos.*no x, y and z of an end effector.*joint states"),
    "no names": (None, logs.states_of(TIMES), "does not name the components"),
    "fewer names": (["x", "y", "z"], logs.states_of(TIMES), "has 7 components, info.json names 3"),
    "rx without rw": (["x", "y", "z", "rx", "ry", "rz", "g"], logs.states_of(TIMES), "may be a rotation vector"),
    "degrees": (list(logs.EULER), 57.3 * logs.states_of(TIMES), "radians are needed, at most 6.38"),
    "NaN": (list(logs.EULER), spoilt(logs.states_of(TIMES), 3, np.nan), "1 of 60 poses are not finite"),
    "one row": (list(logs.EULER), logs.states_of(TIMES)[:1], "at least 2 are needed"),
    "millimetres": (list(logs.EULER)[:3], 1e3 * PLACES, "coordinate of 300 m"),
}  # fmt: skip


@pytest.mark.parametrize("what", list(UNREAD))
def test_states_that_tell_no_pose_are_refused_with_the_reason(tmp_path: Path, what: str) -> None:
    names, states, words = UNREAD[what]
    logs.lerobot_info(tmp_path, names)
    file = tmp_path / "data/chunk-000/episode_000000.parquet"
    logs.lerobot_file(file, {0: (TIMES[: len(states)], states)})
    with pytest.raises(SceneInvalid, match=words) as refusal:
        read_log(file)
    assert len(refusal.value.faults) == 1


def test_damaged_data_sets_are_refused(tmp_path: Path) -> None:
    file = data_set(tmp_path / "set") / "data/chunk-000/episode_000001.parquet"
    whole = file.read_bytes()
    for content in (whole[: len(whole) // 2], b"PAR1" + b"\xff" * 400 + b"PAR1"):
        file.write_bytes(content)
        with pytest.raises(SceneInvalid, match="cannot be read"):
            read_log(file)
    table = pa.table({"timestamp": pa.array([0.0, 1.0]), "observation.state": pa.array(["a", "b"])})
    pa.parquet.write_table(table, file)
    with pytest.raises(SceneInvalid, match=r"observation\.state is string, no list"):
        read_log(file)
    uneven = pa.table({"timestamp": pa.array([0.0, 1.0]), "observation.state": pa.array([[1.0], [1.0, 2.0]])})
    pa.parquet.write_table(uneven, file)
    with pytest.raises(SceneInvalid, match="rows of 1, 2 numbers"):
        read_log(file)
    pa.parquet.write_table(pa.table({"action": pa.array([[1.0]])}), file)
    with pytest.raises(SceneInvalid, match=r"no column observation\.state and no timestamp; it has action"):
        read_log(file)
    file.write_bytes(whole)
    for info, words in (
        ("{", "is no JSON"),
        ("[]", "no JSON object"),
        (json.dumps({"features": 3}), "no feature"),
    ):
        (tmp_path / "set/meta/info.json").write_text(info)
        with pytest.raises(SceneInvalid, match=words):
            read_log(file)
    (tmp_path / "set/meta/info.json").unlink()
    with pytest.raises(SceneInvalid, match=r"needs info\.json"):
        read_log(file)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,x,y\n0,0,0\n", "has no column z; it has t, x, y"),
        ("t,x,y,z\n0,0,0,0\n", "holds 1 poses of CSV"),
        ("t,x,y,z\n0,0,0,0\n1,0,zero,0\n", "holds what is no number"),
        ("t,x,y,z\n0,0,0,0\n1,0,nan,0\n", "1 of 2 poses are not finite, the first is number 1"),
        ("t,x,y,z\n1,0,0,0\n0,0,0,0\n", "time does not increase: 0 s in pose 1 after 1 s"),
    ],
)
def test_csv_that_tells_no_motion_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "robot.csv").write_text(text)
    with pytest.raises(SceneInvalid, match=words):
        read_log(tmp_path / "robot.csv")


def test_options_of_another_form_are_refused(tmp_path: Path) -> None:
    (tmp_path / "robot.csv").write_text("t,x,y,z\n0,0,0,0\n1,0,0,0\n")
    with pytest.raises(SceneInvalid, match="CSV, which holds one pose: it has no /tool"):
        read_log(tmp_path / "robot.csv", "/tool")
    with pytest.raises(SceneInvalid, match="no data set of LeRobot: it has no episode 3"):
        read_log(tmp_path / "robot.csv", episode=3)


@pytest.mark.slow
@pytest.mark.parametrize("form", ["mcap", "lerobot", "base"])
def test_the_command_moves_the_gripper_as_the_log_says(
    tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The pictures begin 0.1 s after the log; a log that ends before them is refused with both spans. A log in the
    frame of a robot's base is carried to the scene's world, over the cameras' world."""
    monkeypatch.setattr(library, "_limited_here", False)
    write(tmp_path / "plate")
    source = tmp_path / "take.mcap"
    if form != "lerobot":
        source.write_bytes(logs.mcap_pose(TIMES, PLACES, TURNS))
    else:
        source = data_set(tmp_path / "set")
    box = f"{LEFT - 8},{TOP - 8},{RIGHT + 8},{BOTTOM + 8}"
    arguments = [str(tmp_path / "plate"), f"--out={tmp_path / 'scene'}", f"--box={box}", "--kind=sheet", "--fps=30",
                 "--points=40", "--up=-y", f"--log={source}", "--log-delay=0.1",
                 f"--held={LEFT},{TOP},{LEFT + 15},{BOTTOM}"]  # fmt: skip
    arguments += ["--log-episode=1"] if form == "lerobot" else []
    base, place = Rotation.identity(), np.zeros(3)
    if form == "base":
        base, place = Rotation.from_euler("xyz", [0.3, -0.2, 0.9]), np.array([0.1, -0.2, 0.4])
        given = ",".join(f"{number:.17g}" for number in (*place, *base.as_quat()[[3, 0, 1, 2]]))
        arguments += [f"--log-base={given}"]
        up = Rotation.from_matrix(ROTATION_FROM_UP["-y"])
        base, place = up * base, up.apply(place)
    assert importing.main(arguments) == 0
    scene = read_bundle(tmp_path / "scene")
    places, turns = logs.path_of(0.1 + np.arange(FRAMES) / 30.0)
    places, rotation = base.apply(places) + place, base * Rotation.from_quat(turns[:, [1, 2, 3, 0]])
    first = rotation[0].inv().apply(scene.controllers[0] - places[0])
    wanted = np.stack([r.apply(first) + place for r, place in zip(rotation, places, strict=True)])
    assert (
        np.abs(scene.controllers - wanted).max() < 1e-4
    )  # between two poses of the log the path is straight
    if form == "base":
        assert importing.main([*arguments, "--log-base=0,0,0,1,1,0,0"]) == 2
        assert "the robot's base has length 1.414, not 1" in capsys.readouterr().err
        assert importing.main([*arguments, "--log-base=nan,0,0,1,0,0,0"]) == 2
        assert "--log-base takes 7 numbers" in capsys.readouterr().err
    assert importing.main([*arguments, "--log-delay=1.0"]) == 2
    assert (
        "the log runs from -1.000 to 0.180 s, the recording from 0.000 to 0.367 s" in capsys.readouterr().err
    )
