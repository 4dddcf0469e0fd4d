"""A frame of tf in the frame at the root of its tree: the transforms on the way are joined, each at its time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from physworld.arrays import Array
from physworld_scenes.errors import refused
from physworld_scenes.importers.tables.table import checked_times, shortened

DEEPEST = 64
"""Links between a frame and its root; more are a loop."""


@dataclass(frozen=True)
class Track:
    """Times (M,) [s], places (M, 3) [m] and quaternions (M, 4), scalar first, or None."""

    times: Array
    places: Array
    turns: Array | None


def chained(
    where: str, tracks: Mapping[str, Track], parents: Mapping[str, str], name: str
) -> tuple[Track, str]:
    """A frame's poses in its root frame, and the root's name.

    They are at the times of the link that is sent most often, as far as all links reach; one that is sent once holds
    always, as ROS has it of ``/tf_static``.

    Args:
        where: the log's name.
        tracks: by ``TOPIC:CHILD``, each in its parent frame.
        parents: the parent frame's name by the same.
        name: of the frame.

    Raises:
        SceneInvalid: the links are a loop, have no rotation, or are not sent over a common time.
    """
    by_child = {key.rpartition(":")[2]: key for key in parents}
    way, root = [name], parents[name]
    while root in by_child:
        way.append(by_child[root])
        root = parents[by_child[root]]
        if len(way) > DEEPEST:
            raise refused(where, f"the frames above {shortened(name)} are a loop, or more than {DEEPEST}")
    links = [tracks[key] for key in way]
    leader = max(links, key=lambda link: len(link.times))
    moving = [link for link in links if len(link.times) > 1]
    clock = checked_times(f"{where} {shortened(name)}", leader.times)
    if moving:
        first, last = max(link.times[0] for link in moving), min(link.times[-1] for link in moving)
        clock = clock[(clock >= first) & (clock <= last)]
        if not len(clock):
            raise refused(
                where, f"the frames from {shortened(root)} to {shortened(name)} are sent at no common time"
            )
    place, turn = np.zeros((len(clock), 3)), Rotation.identity(len(clock))
    for key, link in zip(way, links, strict=True):  # from the frame to the root
        there, turned = _at(where, key, link, clock)
        place, turn = turned.apply(place) + there, turned * turn
    quaternions = turn.as_quat()[:, [3, 0, 1, 2]]
    return Track(clock, place, quaternions), root


def _at(where: str, key: str, link: Track, clock: Array) -> tuple[Array, Rotation]:
    """A link's places and rotations at other times."""
    if link.turns is None or not np.isfinite(np.column_stack([link.places, link.turns])).all():
        raise refused(where, f"{shortened(key)} has transforms that are not finite")
    if (np.linalg.norm(link.turns, axis=1) < 0.5).any():
        raise refused(
            where,
            f"{shortened(key)} has a quaternion of length {np.linalg.norm(link.turns, axis=1).min():.3g}",
        )
    turns = Rotation.from_quat(link.turns[:, [1, 2, 3, 0]])
    if len(link.times) == 1:
        held = np.repeat(turns.as_quat(), len(clock), axis=0)
        return np.repeat(link.places, len(clock), axis=0), Rotation.from_quat(held)
    times = checked_times(f"{where} {shortened(key)}", link.times)
    there = np.stack([np.interp(clock, times, link.places[:, axis]) for axis in range(3)], axis=1)
    return there, Slerp(times, turns)(clock)
