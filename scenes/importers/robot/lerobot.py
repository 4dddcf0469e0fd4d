"""The end effector's poses in an episode of a LeRobot data set, formats v2 and v3.

``meta/info.json`` names the components of ``observation.state``: a list, or a dictionary of one. Its place is three
names that end in x, y and z. Its rotation is roll, pitch, yaw [rad] about the fixed axes x, y, z in this order; or wx,
wy, wz or axis_angle, a rotation vector [rad], as LeRobot's own kinematics write it; or a quaternion qw, qx, qy, qz or
rx, ry, rz, rw. What stands before them, without words such as ``pos``, tells several arms apart. Joint states give no
pose: no kinematics of a robot are computed here.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld_scenes.errors import refused
from physworld_scenes.importers.library import parsed_file
from physworld_scenes.importers.robot.lerobot_content import MOST_COMPONENTS, STATE
from physworld_scenes.importers.tables.table import shortened

MOST_INFO_BYTES = 4 << 20
MOST_FILES = 10_000
MOST_TURN_RAD = 2.0 * np.pi + 0.1
"""An angle beyond is in degrees."""
MAGIC = b"PAR1"
PLACE = frozenset({"pos", "position", "translation", "trans", "xyz"})
QUATERNION = frozenset({"quat", "quaternion"})
VECTOR = frozenset({"rotvec", "axisangle", "aa"})
TURN = frozenset({"rot", "rotation", "orientation", "ori", "euler", "rpy"})
ELSE = frozenset({"vel", "velocity", "force", "torque", "delta", "goal", "target", "joint", "acc"})
"""Words of names that say nothing of where the end effector is."""
QUATERNION_PARTS, LOOSE_PARTS = (tuple(f"{kind}.{axis}" for axis in "wxyz") for kind in ("quat", "turn"))
MEANINGS = (
    ("quaternion", QUATERNION_PARTS),
    ("quaternion", LOOSE_PARTS),
    ("rotation vector", ("vector.x", "vector.y", "vector.z")),
    ("roll, pitch, yaw", ("turn.roll", "turn.pitch", "turn.yaw")),
)
UNCLEAR = ("turn.x", "turn.y", "turn.z")

Parts = dict[str, int]


def is_lerobot(path: Path) -> bool:
    """Whether a path is a data set's folder or a parquet file."""
    if path.is_dir():
        return (path / "meta/info.json").is_file()
    with path.open("rb") as stream:
        return stream.read(len(MAGIC)) == MAGIC


def read_episode(path: Path, pose: str | None, episode: int | None) -> tuple[Array, Array, Array | None, str]:
    """Times (L,) [s], places (L, 3) [m], quaternions (L, 4), scalar first, or None, and what was read in words.

    Args:
        path: of the data set's folder, or of a parquet file beside which or above which ``info.json`` lies.
        pose: what stands before x, y and z in the names; None: the only one.
        episode: its number; None: the only one.

    Raises:
        SceneInvalid: the data set is damaged, has no such episode or no pose; with what it has.
    """
    info = _info(path)
    names = _names(path.name, info)
    key, parts = _chosen(path.name, names, pose)
    state, times, number = _rows(path, episode)
    if state.shape[1] != len(names):
        raise refused(path.name, f"{STATE} has {state.shape[1]} components, info.json names {len(names)}")
    places = state[:, [parts["place.x"], parts["place.y"], parts["place.z"]]]
    kind, needed = next(((kind, part) for kind, part in MEANINGS if set(part) <= set(parts)), ("", ()))
    if not kind and set(UNCLEAR) <= set(parts):
        told = ", ".join(names[parts[part]] for part in UNCLEAR)
        raise refused(
            path.name,
            f"{shortened(told)} may be a rotation vector or angles: name them wx, wy, wz or roll, pitch, yaw",
        )
    turns = _turns(path.name, kind, state[:, [parts[part] for part in needed]]) if kind else None
    said = f"LeRobot, {shortened(key) or STATE} of episode {number}, {kind or 'no rotation'}"
    return times, places, turns, said


def _turns(where: str, kind: str, values: Array) -> Array:
    """Quaternions, scalar first; of a quaternion as it is."""
    if kind == "quaternion":
        return values
    known = np.isfinite(values).all(axis=1, keepdims=True)
    angles = np.where(known, values, 0.0)
    if (most := float(np.abs(angles).max(initial=0.0))) > MOST_TURN_RAD:
        raise refused(where, f"{kind} of up to {most:.4g}: radians are needed, at most {MOST_TURN_RAD:.3g}")
    vector = kind == "rotation vector"
    rotation = Rotation.from_rotvec(angles) if vector else Rotation.from_euler("xyz", angles)
    turned: Array = np.where(known, rotation.as_quat()[:, [3, 0, 1, 2]], np.nan)
    return turned


def _info(path: Path) -> Mapping[str, Any]:
    """What ``meta/info.json`` says."""
    near = (
        [path / "meta/info.json"]
        if path.is_dir()
        else [
            path.parent / "info.json",
            *(above / "meta/info.json" for above in list(path.resolve().parents)[:3]),
        ]
    )
    found = next((one for one in near if one.is_file()), None)
    if found is None:
        raise refused(
            path.name, "needs info.json of its data set, which names the components: beside it or in meta/"
        )
    if found.stat().st_size > MOST_INFO_BYTES:
        raise refused(found.name, f"has {found.stat().st_size} bytes, at most {MOST_INFO_BYTES} are read")
    try:
        info = json.loads(found.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise refused(found.name, f"is no JSON: {str(error)[:160]}") from error
    if not isinstance(info, dict):
        raise refused(found.name, "is no JSON object")
    return info


def _names(where: str, info: Mapping[str, Any]) -> list[str]:
    """Of the components of the state."""
    features = info.get("features")
    state = features.get(STATE) if isinstance(features, dict) else None
    if not isinstance(state, dict):
        raise refused(where, f"info.json has no feature {STATE}")
    names = state.get("names")
    if isinstance(names, dict):
        lists = [one for one in names.values() if isinstance(one, list)]
        names = lists[0] if len(lists) == 1 else list(names) if not lists else None
    if not isinstance(names, list) or not 0 < len(names) <= MOST_COMPONENTS:
        raise refused(where, f"info.json does not name the components of {STATE}")
    return [str(name)[:80] for name in names]


def _chosen(where: str, names: Sequence[str], pose: str | None) -> tuple[str, Parts]:
    """The pose that is meant, and the column of each of its parts."""
    poses: dict[str, Parts] = {}
    for column, name in enumerate(names):
        if (read := _part(name)) is not None:
            poses.setdefault(read[0], {}).setdefault(read[1], column)
    whole = {key: parts for key, parts in poses.items() if {"place.x", "place.y", "place.z"} <= set(parts)}
    shown = shortened(", ".join(names), 160)
    if not whole:
        raise refused(
            where,
            f"{STATE} is {shown}: no x, y and z of an end effector. Its pose is not computed from joint states here; "
            "log the pose, or give it as CSV",
        )
    if pose is None and len(whole) > 1:
        raise refused(where, f"{STATE} has the poses {', '.join(whole)}: say which moves with the gripper")
    wanted = next(iter(whole)) if pose is None else ".".join(_words(pose))
    if wanted not in whole:
        raise refused(
            where, f"{STATE} has no pose {shortened(wanted)}; its poses are {', '.join(whole) or shown}"
        )
    return wanted, whole[wanted]


def _words(name: str) -> list[str]:
    return [word for word in re.split(r"[^a-z0-9]+", name.lower().replace("axis_angle", "axisangle")) if word]


def _part(name: str) -> tuple[str, str] | None:
    """What stands before a component's name, and its part such as ``place.x``; None: it is no part of a pose."""
    *before, last = _words(
        re.sub(r"(?<=[a-z])([123])$", r" \1", name.lower().replace("axis_angle", "axisangle"))
    ) or [""]
    words = set(before)
    key = ".".join(word for word in before if word not in PLACE | QUATERNION | VECTOR | TURN)
    if words & ELSE:
        return None
    if last in ("roll", "pitch", "yaw"):
        return key, f"turn.{last}"
    if re.fullmatch("q[wxyz]", last):
        return key, f"quat.{last[1]}"
    if re.fullmatch("w[xyz]", last):
        return key, f"vector.{last[1]}"
    if re.fullmatch("r[xyzw]", last):
        return key, f"turn.{last[1]}"
    if words & VECTOR and last in ("x", "y", "z", "1", "2", "3"):
        return key, f"vector.{ {'1': 'x', '2': 'y', '3': 'z'}.get(last, last) }"
    if words & QUATERNION and last in ("w", "x", "y", "z"):
        return key, f"quat.{last}"
    if words & TURN and last in ("w", "x", "y", "z"):
        return key, f"turn.{last}"
    return (key, f"place.{last}") if last in ("x", "y", "z") else None


def _rows(path: Path, episode: int | None) -> tuple[Array, Array, int]:
    """States (L, D) and times (L,) [s] of an episode, and its number."""
    files = sorted(path.glob("data/**/*.parquet")) if path.is_dir() else [path]
    if not 0 < len(files) <= MOST_FILES:
        raise refused(path.name, f"holds {len(files)} parquet files under data/")
    if episode is not None and path.is_dir():
        own = [file for file in files if file.stem == f"episode_{episode:06d}"]
        files = own or files
    held: dict[int, tuple[Array, Array]] = {}
    for file in files:
        arrays, _ = parsed_file("lerobot", file, file.name)
        state, times = arrays["state"], arrays["times"]
        numbers = arrays.get("episodes", np.zeros(len(times), dtype=np.int64))
        if episode is not None and episode in numbers:
            return state[numbers == episode], times[numbers == episode], episode
        held |= {int(number): (state, times) for number in np.unique(numbers)}
        if episode is None and len(held) > 1:
            raise refused(path.name, f"has several episodes, {_range(held)} among them: say which")
    if episode is not None or not held:
        raise refused(
            path.name, f"has no episode{'' if episode is None else f' {episode}'}; it has {_range(held)}"
        )
    (number, (state, times)) = next(iter(held.items()))
    return state, times, number


def _range(numbers: Iterable[int]) -> str:
    held = sorted(numbers)
    return f"{len(held)} from {held[0]} to {held[-1]}" if held else "none"
