"""What mcap reads of a robot's log: topics of poses, and the frames of tf.

A message counts as in :mod:`physworld_scenes.importers.tables.mcap_content`; beside it tf2_msgs/TFMessage and
foxglove.FrameTransform(s), each of whose frames is called ``TOPIC:CHILD``. A topic whose first message holds no pose is
left out and not decoded again.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld_scenes.importers.tables.mcap_content import (
    MOST_MESSAGES,
    Message,
    field_of,
    messages,
    pose_or_points,
    stamp_of,
)

Pose = tuple[str, str | None, float | None, Array, list[float] | None]
"""Name, parent frame, time of its own [s], place (1, 3) [m], quaternion, scalar first."""


def content_of(source: str) -> tuple[dict[str, Array], dict[str, Any]]:
    """Of every pose ``N.times`` (M,) [s], ``N.places`` (M, 3) [m] and, if it turns, ``N.turns`` (M, 4), scalar first.

    Returns:
        the arrays, and ``names``, ``parents`` (of a frame of tf the frame that it is given in), ``left``: schemas of
        topics without poses.

    Raises:
        ValueError: mcap is not there, there is too much in it, or a frame of tf changes its parent.
    """
    times: dict[str, list[float]] = {}
    places: dict[str, list[Array]] = {}
    turns: dict[str, list[list[float]]] = {}
    parents: dict[str, str] = {}
    left: dict[str, str] = {}
    count = 0
    for message in messages(source):
        if message.topic in left:
            continue
        poses = _poses(message)
        if poses is None:
            left[message.topic] = message.kind
            continue
        for name, parent, stamp, place, turn in poses:
            count += 1
            if count > MOST_MESSAGES:
                raise ValueError(f"holds more than {MOST_MESSAGES} poses")
            if parent is not None and parents.setdefault(name, parent) != parent:
                raise ValueError(
                    f"{name[:80]} is given in the frame {parents[name][:80]}, then in {parent[:80]}"
                )
            times.setdefault(name, []).append(message.logged_s if stamp is None else stamp)
            places.setdefault(name, []).append(place[0])
            if turn is not None:
                turns.setdefault(name, []).append(turn)
    names = sorted(places)
    arrays: dict[str, Array] = {}
    for number, name in enumerate(names):
        arrays[f"{number}.times"] = np.array(times[name])
        arrays[f"{number}.places"] = np.stack(places[name])
        if len(turns.get(name, [])) == len(places[name]):
            arrays[f"{number}.turns"] = np.array(turns[name])
    return arrays, {"names": names, "parents": parents, "left": left}


def _poses(message: Message) -> list[Pose] | None:
    """Of a message; None: it holds none."""
    if message.decode is None:
        return None
    content = message.decode()
    transforms = field_of(content, "transforms")
    if transforms is None and field_of(content, "translation") is not None:
        transforms = [content]
    if isinstance(transforms, list | tuple):
        return [_frame(message.topic, transform) for transform in transforms]
    found = pose_or_points(content)
    if found is None or field_of(content, "points") is not None or field_of(content, "fields") is not None:
        return None
    stamp, place, turn = found
    return [(message.topic, None, stamp, place, turn)]


def _frame(topic: str, transform: Any) -> Pose:
    """Of one frame of tf, ROS' or foxglove's."""
    inner = field_of(transform, "transform") or transform
    translation, rotation = field_of(inner, "translation"), field_of(inner, "rotation")
    parent = field_of(transform, "parent_frame_id") or field_of(field_of(transform, "header"), "frame_id")
    child = field_of(transform, "child_frame_id")
    place = np.array([[float(field_of(translation, axis)) for axis in "xyz"]])
    turn = [float(field_of(rotation, axis)) for axis in "wxyz"]
    return f"{topic}:{str(child).lstrip('/')}", str(parent).lstrip("/"), stamp_of(transform), place, turn
