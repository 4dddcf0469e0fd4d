"""A robot's log of any form as poses of its end effector over time.

``read_log`` tells the form by the file: a folder with ``meta/info.json`` and parquet are LeRobot's, MCAP begins with
its magic bytes, all else is CSV with a head. Places are in the log's frame [m]. The clock of CSV and LeRobot is the
file's; that of MCAP counts from the first message of the pose, whose stamps are dates.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from physworld.arrays import Array
from physworld.tracking.grips import UNIT_WITHIN
from physworld_scenes.errors import refused
from physworld_scenes.importers.library import parsed_file
from physworld_scenes.importers.robot.frames import Track, chained
from physworld_scenes.importers.robot.lerobot import is_lerobot, read_episode
from physworld_scenes.importers.tables.mcap_content import MAGIC
from physworld_scenes.importers.tables.table import shortened

MOST_LOG_BYTES = 64 << 20
"""Of CSV."""
FARTHEST_M = 100.0
SHOWN = 12


@dataclass(frozen=True)
class RobotLog:
    """Poses of an end effector in the frame of the log: the scene's world, or a robot's base.

    Attributes:
        times: on the log's clock [s], (L,) increasing.
        places: [m], (L, 3).
        turns: quaternions of length 1, scalar first, (L, 4); None: it says none.
        told: what was read, in words.
    """

    times: Array
    places: Array
    turns: Array | None
    told: str


def read_log(path: Path, pose: str | None = None, episode: int | None = None) -> RobotLog:
    """The poses in a robot's log.

    Args:
        path: CSV, MCAP, parquet of LeRobot, or the folder of its data set.
        pose: which of several: a topic, ``TOPIC:FRAME`` of tf, or what stands before x, y and z in LeRobot's names.
        episode: of LeRobot; None: the only one.

    Raises:
        SceneInvalid: it cannot be read, says no such pose, or poses that are not finite, in order and plausible.
    """
    name = path.name
    if is_lerobot(path):
        log = RobotLog(*read_episode(path, pose, episode))
    elif episode is not None:
        raise refused(name, f"is no data set of LeRobot: it has no episode {episode}")
    elif _begins_as_mcap(path):
        log = _mcap(path, pose)
    elif pose is not None:
        raise refused(name, f"is read as CSV, which holds one pose: it has no {shortened(pose)}")
    else:
        log = _csv(path)
    return _checked(name, log)


def _begins_as_mcap(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(len(MAGIC)) == MAGIC


def _csv(path: Path) -> RobotLog:
    if path.stat().st_size > MOST_LOG_BYTES:
        raise refused(path.name, f"has {path.stat().st_size} bytes, at most {MOST_LOG_BYTES} are read")
    with path.open(newline="", encoding="utf-8", errors="replace") as stream:
        reader = csv.reader(stream)
        try:
            head = [name.strip().lower() for name in next(reader, [])]
            wanted = ["t", "x", "y", "z"]
            turning = ["qw", "qx", "qy", "qz"]
            missing = [name for name in wanted if name not in head]
            if missing:
                raise refused(
                    path.name, f"has no column {', '.join(missing)}; it has {', '.join(head)[:160]}"
                )
            turns = set(turning) <= set(head)
            columns = [head.index(name) for name in (wanted + turning if turns else wanted)]
            rows = [[float(row[column]) for column in columns] for row in reader if row]
        except (ValueError, IndexError, csv.Error) as error:
            raise refused(path.name, f"holds what is no number: {str(error)[:160]}") from error
    table = np.array(rows, dtype=np.float64).reshape(-1, len(columns))
    return RobotLog(table[:, 0], table[:, 1:4], table[:, 4:8] if turns else None, "CSV")


def _mcap(path: Path, pose: str | None) -> RobotLog:
    arrays, facts = parsed_file("mcap_poses", path, path.name)
    names: list[str] = facts["names"]
    parents: dict[str, str] = facts["parents"]
    if not names:
        left = [f"{topic} ({kind})" for topic, kind in facts["left"].items()]
        raise refused(path.name, f"holds no poses; its topics are {_listed(left)}")
    if pose is None and len(names) > 1:
        raise refused(path.name, f"holds the poses {_listed(names)}: say which moves with the gripper")
    wanted = names[0] if pose is None else pose
    if wanted not in names:
        raise refused(path.name, f"holds no pose {shortened(wanted)}; it has {_listed(names)}")
    tracks = {
        name: Track(arrays[f"{n}.times"], arrays[f"{n}.places"], arrays.get(f"{n}.turns"))
        for n, name in enumerate(names)
    }
    told = wanted
    if wanted in parents:
        track, root = chained(path.name, tracks, parents, wanted)
        told = f"{wanted} in {root}"
    else:
        track = tracks[wanted]
    return RobotLog(track.times - track.times[0], track.places, track.turns, f"MCAP, {shortened(told)}")


def _checked(name: str, log: RobotLog) -> RobotLog:
    """The log with quaternions of length 1. Raises SceneInvalid: what it says cannot be."""
    times, places, turns = log.times, log.places, log.turns
    if len(times) < 2:
        raise refused(name, f"holds {len(times)} poses of {log.told}; at least 2 are needed")
    values = np.column_stack([times, places, *([] if turns is None else [turns])])
    if not (finite := np.isfinite(values).all(axis=1)).all():
        at = int(np.argmin(finite))
        raise refused(
            name, f"{int((~finite).sum())} of {len(times)} poses are not finite, the first is number {at}"
        )
    steps = np.diff(times)
    if (steps <= 0.0).any():
        at = int(np.argmax(steps <= 0.0))
        raise refused(
            name,
            f"time does not increase: {times[at + 1]:.6g} s in pose {at + 1} after {times[at]:.6g} s "
            f"({int((steps <= 0.0).sum())} of {len(steps)} steps)",
        )
    if (farthest := float(np.abs(places).max())) > FARTHEST_M:
        raise refused(
            name, f"a coordinate of {farthest:.4g} m: at most {FARTHEST_M:g} m are taken; are these metres?"
        )
    if turns is not None:
        lengths = np.linalg.norm(turns, axis=1)
        if (strange := np.abs(lengths - 1.0) > UNIT_WITHIN).any():
            at = int(np.argmax(strange))
            raise refused(name, f"the quaternion of pose {at} has length {lengths[at]:.4g}, not 1")
        turns = turns / lengths[:, None]
    return RobotLog(times, places, turns, log.told)


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(shortened(name) for name in names[:SHOWN])
    return f"{shown} and {len(names) - SHOWN} more" if len(names) > SHOWN else shown or "none"
