"""What mcap reads of a log: the topics of poses and point clouds, as JSON or as ROS 2 messages.

A message counts as a pose if it has ``pose.position`` (geometry_msgs/PoseStamped) or ``transform.translation``
(TransformStamped), as points if it has ``points`` with x, y and z (sensor_msgs/PointCloud, foxglove's arrays of
points) or, of ROS 2, is a sensor_msgs/PointCloud2. Its time is that of its header, else that at which it was logged.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from physworld.arrays import Array

MAGIC = b"\x89MCAP0\r\n"
MOST_MESSAGES = 1_000_000
MOST_POINTS = 5_000_000


def is_mcap(data: bytes, filename: str) -> bool:
    """Whether a file begins like an MCAP log."""
    return data[: len(MAGIC)] == MAGIC


@dataclass(frozen=True)
class Message:
    """A message of a log: its topic, the name of its schema or encoding, and when it was logged [s]."""

    topic: str
    kind: str
    logged_s: float
    decode: Callable[[], Any] | None
    """What it says; None: nothing here reads its encoding."""


def messages(source: str) -> Iterator[Message]:
    """All messages of a log in the order in which they were logged. Raises ValueError: mcap is not there."""
    try:
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory
    except ImportError as error:
        raise ValueError("MCAP needs the package mcap: pip install 'physworld[tables]'") from error

    with open(source, "rb") as stream:  # noqa: PTH123  the reader wants a plain stream
        reader = make_reader(stream, validate_crcs=True)
        factory, decoders = DecoderFactory(), {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in decoders:
                decoders[channel.id] = (
                    json.loads
                    if channel.message_encoding == "json"
                    else factory.decoder_for(channel.message_encoding, schema)
                )
            decoder = decoders[channel.id]
            kind = schema.name if schema is not None else channel.message_encoding
            decode = None if decoder is None else partial(decoder, message.data)
            yield Message(channel.topic, kind, message.log_time * 1e-9, decode)


def content_of(source: str) -> tuple[dict[str, Array], dict[str, Any]]:
    """Of every topic: ``N.times`` (M,) [s], ``N.places`` (M, P, 3), of a pose ``N.turns`` (M, 4), scalar first.

    Raises:
        ValueError: mcap is not there, or there is too much in it.
    """
    times: dict[str, list[float]] = {}
    places: dict[str, list[Array]] = {}
    turns: dict[str, list[list[float]]] = {}
    left: dict[str, str] = {}
    points = 0
    for count, message in enumerate(messages(source), start=1):
        if count > MOST_MESSAGES:
            raise ValueError(f"holds more than {MOST_MESSAGES} messages")
        topic = message.topic
        found = None if message.decode is None else pose_or_points(message.decode())
        if found is None:
            left[topic] = message.kind
            continue
        stamp, place, turn = found
        points += len(place)
        if points > MOST_POINTS:
            raise ValueError(f"holds more than {MOST_POINTS} points")
        if topic in places and len(place) != len(places[topic][0]):
            first, number = len(places[topic][0]), len(places[topic]) + 1
            raise ValueError(
                f"{topic[:80]} has {first} points in its first message, {len(place)} in number {number}"
            )
        times.setdefault(topic, []).append(message.logged_s if stamp is None else stamp)
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


def pose_or_points(message: Any) -> tuple[float | None, Array, list[float] | None] | None:
    """Time, places (P, 3) and orientation of a message; None if it holds neither a pose nor points."""
    pose = field_of(message, "pose")
    pose = field_of(pose, "pose") or pose  # with covariance
    position = field_of(pose, "position")
    turn = field_of(pose, "orientation") or field_of(pose, "rotation")
    if position is None:
        transform = field_of(message, "transform")
        position, turn = field_of(transform, "translation"), field_of(transform, "rotation")
    stamp = stamp_of(message)
    if position is not None:
        quaternion = None if turn is None else [float(field_of(turn, axis)) for axis in "wxyz"]
        return stamp, np.array([[float(field_of(position, axis)) for axis in "xyz"]]), quaternion
    points = field_of(message, "points")
    if points is None:
        return None if field_of(message, "fields") is None else _cloud(message, stamp)
    if not isinstance(points, list | tuple) or not all(field_of(point, "z") is not None for point in points):
        return None
    return (
        stamp,
        np.array([[float(field_of(p, axis)) for axis in "xyz"] for p in points]).reshape(-1, 3),
        None,
    )


def _cloud(message: Any, stamp: float | None) -> tuple[float | None, Array, None] | None:
    """Points of a PointCloud2 with floats x, y, z."""
    fields = {
        field_of(field, "name"): (field_of(field, "offset"), field_of(field, "datatype"))
        for field in field_of(message, "fields")
    }
    if not {"x", "y", "z"} <= set(fields):
        return None
    order = ">" if field_of(message, "is_bigendian") else "<"
    kinds = {7: f"{order}f4", 8: f"{order}f8"}
    step, data = int(field_of(message, "point_step")), bytes(field_of(message, "data"))
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


def stamp_of(message: Any) -> float | None:
    """Seconds of a header's stamp, of ROS 2 (sec, nanosec), ROS 1 (secs, nsecs) or foxglove (sec, nsec)."""
    header = field_of(message, "header")
    stamp = field_of(header, "stamp") if header is not None else field_of(message, "timestamp")
    whole = next((field_of(stamp, key) for key in ("sec", "secs") if field_of(stamp, key) is not None), None)
    if whole is None:
        return None
    part = next(
        (field_of(stamp, key) for key in ("nanosec", "nsec", "nsecs") if field_of(stamp, key) is not None), 0
    )
    seconds = float(whole) + 1e-9 * float(part)
    return seconds if seconds > 0.0 else None


def field_of(thing: Any, key: str) -> Any:
    """Of a decoded message, JSON or ROS; None: it has no such field."""
    if isinstance(thing, Mapping):
        return thing.get(key)
    return getattr(thing, key, None)
