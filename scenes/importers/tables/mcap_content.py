"""What mcap reads of a log: the topics of poses and point clouds, as JSON or as ROS 2 messages.

A message counts as a pose if it has ``pose.position`` (geometry_msgs/PoseStamped) or ``transform.translation``
(TransformStamped), as points if it has ``points`` with x, y and z (sensor_msgs/PointCloud, foxglove's arrays of
points) or, of ROS 2, is a sensor_msgs/PointCloud2. Its time is that of its header, else that at which it was logged.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from physworld.arrays import Array

MAGIC = b"\x89MCAP0\r\n"
MOST_MESSAGES = 1_000_000
MOST_POINTS = 5_000_000


def is_mcap(data: bytes, filename: str) -> bool:
    """Whether a file begins like an MCAP log."""
    return data[: len(MAGIC)] == MAGIC


def content_of(source: str) -> tuple[dict[str, Array], dict[str, Any]]:
    """Of every topic: ``N.times`` (M,) [s], ``N.places`` (M, P, 3), of a pose ``N.turns`` (M, 4), scalar first.

    Raises:
        ValueError: mcap is not there, or there is too much in it.
    """
    try:
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    except ImportError as error:
        raise ValueError("MCAP needs the package mcap: pip install 'physworld[tables]'") from error

    times: dict[str, list[float]] = {}
    places: dict[str, list[Array]] = {}
    turns: dict[str, list[list[float]]] = {}
    left: dict[str, str] = {}
    count = points = 0
    with open(source, "rb") as stream:  # noqa: PTH123  the reader wants a plain stream
        reader = make_reader(stream, validate_crcs=True)
        factory, decoders = DecoderFactory(), {}
        for schema, channel, message in reader.iter_messages():
            count += 1
            if count > MOST_MESSAGES:
                raise ValueError(f"holds more than {MOST_MESSAGES} messages")
            if channel.id not in decoders:
                decoders[channel.id] = (
                    json.loads
                    if channel.message_encoding == "json"
                    else factory.decoder_for(channel.message_encoding, schema)
                )
            decode = decoders[channel.id]
            found = None if decode is None else _found(decode(message.data))
            if found is None:
                left[channel.topic] = schema.name if schema is not None else channel.message_encoding
                continue
            stamp, place, turn = found
            topic = channel.topic
            points += len(place)
            if points > MOST_POINTS:
                raise ValueError(f"holds more than {MOST_POINTS} points")
            if topic in places and len(place) != len(places[topic][0]):
                first, number = len(places[topic][0]), len(places[topic]) + 1
                raise ValueError(
                    f"{topic[:80]} has {first} points in its first message, {len(place)} in number {number}"
                )
            times.setdefault(topic, []).append(message.log_time * 1e-9 if stamp is None else stamp)
            places.setdefault(topic, []).append(place)
            if turn is not None:
                turns.setdefault(topic, []).append(turn)
    arrays: dict[str, Array] = {}
    names = sorted(places)
    for number, topic in enumerate(names):
        arrays[f"{number}.times"] = np.array(times[topic])
        arrays[f"{number}.places"] = np.stack(places[topic])
        if len(turns.get(topic, [])) == len(places[topic]):
            arrays[f"{number}.turns"] = np.array(turns[topic])
    return arrays, {
        "topics": names,
        "left": {topic: left[topic] for topic in sorted(left) if topic not in places},
    }


def _found(message: Any) -> tuple[float | None, Array, list[float] | None] | None:
    """Time, places (P, 3) and orientation of a message; None if it holds neither a pose nor points."""
    pose = _get(message, "pose")
    pose = _get(pose, "pose") or pose  # with covariance
    position = _get(pose, "position")
    turn = _get(pose, "orientation") or _get(pose, "rotation")
    if position is None:
        transform = _get(message, "transform")
        position, turn = _get(transform, "translation"), _get(transform, "rotation")
    stamp = _stamp(message)
    if position is not None:
        quaternion = None if turn is None else [float(_get(turn, axis)) for axis in "wxyz"]
        return stamp, np.array([[float(_get(position, axis)) for axis in "xyz"]]), quaternion
    points = _get(message, "points")
    if points is None:
        return None if _get(message, "fields") is None else _cloud(message, stamp)
    if not isinstance(points, list | tuple) or not all(_get(point, "z") is not None for point in points):
        return None
    return stamp, np.array([[float(_get(p, axis)) for axis in "xyz"] for p in points]).reshape(-1, 3), None


def _cloud(message: Any, stamp: float | None) -> tuple[float | None, Array, None] | None:
    """Points of a PointCloud2 with floats x, y, z."""
    fields = {
        _get(field, "name"): (_get(field, "offset"), _get(field, "datatype"))
        for field in _get(message, "fields")
    }
    if not {"x", "y", "z"} <= set(fields):
        return None
    order = ">" if _get(message, "is_bigendian") else "<"
    kinds = {7: f"{order}f4", 8: f"{order}f8"}
    step, data = int(_get(message, "point_step")), bytes(_get(message, "data"))
    if any(fields[axis][1] not in kinds for axis in "xyz"):
        return None
    record = np.dtype({
        "names": ["x", "y", "z"],
        "formats": [kinds[fields[axis][1]] for axis in "xyz"],
        "offsets": [fields[axis][0] for axis in "xyz"],
        "itemsize": step,
    })  # fmt: skip
    rows = np.frombuffer(data, dtype=record, count=len(data) // step)
    return stamp, np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1), None


def _stamp(message: Any) -> float | None:
    """Seconds of a header's stamp, of ROS 2 (sec, nanosec), ROS 1 (secs, nsecs) or foxglove (sec, nsec)."""
    header = _get(message, "header")
    stamp = _get(header, "stamp") if header is not None else _get(message, "timestamp")
    whole = next((_get(stamp, key) for key in ("sec", "secs") if _get(stamp, key) is not None), None)
    if whole is None:
        return None
    part = next((_get(stamp, key) for key in ("nanosec", "nsec", "nsecs") if _get(stamp, key) is not None), 0)
    seconds = float(whole) + 1e-9 * float(part)
    return seconds if seconds > 0.0 else None


def _get(thing: Any, key: str) -> Any:
    if isinstance(thing, Mapping):
        return thing.get(key)
    return getattr(thing, key, None)
