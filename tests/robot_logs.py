"""Writers of a robot's logs: MCAP of JSON and ROS 2, with tf, and LeRobot data sets; and what they were made of."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
from marker_files import HEADER, POSE_SCHEMA, QUATERNION, RULE
from scipy.spatial.transform import Rotation

Array = np.ndarray
EPOCH_S = 1.7e9
TRANSFORM = f"""std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
{RULE}MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
{RULE}MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
{QUATERNION}{HEADER}"""
TF = f"""geometry_msgs/TransformStamped[] transforms
{RULE}MSG: geometry_msgs/TransformStamped
{TRANSFORM}"""
EULER = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")


def path_of(times: Array) -> tuple[Array, Array]:
    """Places (L, 3) [m] and quaternions (L, 4), scalar first, of an end effector at times [s]."""
    places = np.stack([0.1 * times, 0.05 * np.sin(2 * times), 0.3 + 0 * times], axis=1)
    angles = np.stack([0.5 * times, 0.2 * np.sin(times), 0.1 * times], axis=1)
    return places, Rotation.from_euler("xyz", angles).as_quat()[:, [3, 0, 1, 2]]


def stamp(time: float) -> dict[str, int]:
    whole, part = divmod(round((time + EPOCH_S) * 1e9), 10**9)
    return {"sec": whole, "nanosec": part}


def vector(place: Array) -> dict[str, float]:
    return dict(zip("xyz", map(float, place), strict=True))


def quaternion(turn: Array) -> dict[str, float]:
    return dict(zip("wxyz", map(float, turn), strict=True))


def mcap_json(topics: dict[str, tuple[Array, Array, Array]], others: dict[str, Any] | None = None) -> bytes:
    """PoseStamped as JSON by topic: times, places, quaternions; and one message each of what holds no pose."""
    from mcap.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    schema = writer.register_schema("geometry_msgs/PoseStamped", "jsonschema", b'{"type": "object"}')
    for topic, (times, places, turns) in topics.items():
        channel = writer.register_channel(topic, "json", schema)
        for time, place, turn in zip(times, places, turns, strict=True):
            pose = {"position": vector(place), "orientation": quaternion(turn)}
            message = {"header": {"stamp": stamp(time), "frame_id": "world"}, "pose": pose}
            now = round((time + 10.0) * 1e9)
            writer.add_message(channel, log_time=now, publish_time=now, data=json.dumps(message).encode())
    strange = writer.register_schema("sensor_msgs/JointState", "jsonschema", b'{"type": "object"}')
    for topic, content in (others or {}).items():
        channel = writer.register_channel(topic, "json", strange)
        writer.add_message(channel, log_time=0, publish_time=0, data=json.dumps(content).encode())
    writer.finish()
    return stream.getvalue()


def mcap_pose(times: Array, places: Array, turns: Array) -> bytes:
    """PoseStamped of ROS 2 on /tool/pose."""
    from mcap_ros2.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream)
    schema = writer.register_msgdef("geometry_msgs/msg/PoseStamped", POSE_SCHEMA)
    for time, place, turn in zip(times, places, turns, strict=True):
        pose = {"position": vector(place), "orientation": quaternion(turn)}
        message = {"header": {"stamp": stamp(time), "frame_id": "base"}, "pose": pose}
        now = round(time * 1e9)
        writer.write_message("/tool/pose", schema, message, log_time=now, publish_time=now)
    writer.finish()
    return stream.getvalue()


def mcap_transform(times: Array, places: Array, turns: Array) -> bytes:
    """TransformStamped of ROS 2 on a topic of its own, /vicon/tool."""
    from mcap_ros2.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream)
    schema = writer.register_msgdef("geometry_msgs/msg/TransformStamped", TRANSFORM)
    for time, place, turn in zip(times, places, turns, strict=True):
        message = _transform("world", "tool", time, place, turn)
        now = round(time * 1e9)
        writer.write_message("/vicon/tool", schema, message, log_time=now, publish_time=now)
    writer.finish()
    return stream.getvalue()


def mcap_tf(links: Sequence[tuple[str, str, Array, Array, Array]]) -> bytes:
    """TFMessages of ROS 2: parent, child, times, places, quaternions of each link; one of a single time is static."""
    from mcap_ros2.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream)
    schema = writer.register_msgdef("tf2_msgs/msg/TFMessage", TF)
    for parent, child, times, places, turns in links:
        for time, place, turn in zip(times, places, turns, strict=True):
            message = {"transforms": [_transform(parent, child, time, place, turn)]}
            now = round((time + 10.0) * 1e9)
            topic = "/tf_static" if len(times) == 1 else "/tf"
            writer.write_message(topic, schema, message, log_time=now, publish_time=now)
    writer.finish()
    return stream.getvalue()


def _transform(parent: str, child: str, time: float, place: Array, turn: Array) -> dict[str, Any]:
    inner = {"translation": vector(place), "rotation": quaternion(turn)}
    return {"header": {"stamp": stamp(time), "frame_id": parent}, "child_frame_id": child, "transform": inner}


def lerobot_file(path: Path, episodes: dict[int, tuple[Array, Array]], kind: Any = None) -> None:
    """A parquet file of episodes: times (L,) [s] and states (L, D) each; ``kind``: of the state, else lists."""
    path.parent.mkdir(parents=True, exist_ok=True)
    times = np.concatenate([times for times, _ in episodes.values()])
    states = np.concatenate([states for _, states in episodes.values()]).astype(np.float32)
    numbers = np.concatenate([np.full(len(t), number) for number, (t, _) in episodes.items()])
    state = pa.array(states.tolist(), type=kind or pa.list_(pa.float32()))
    columns = {
        "action": state,
        "observation.state": state,
        "timestamp": pa.array(times.astype(np.float32)),
        "frame_index": pa.array(np.arange(len(times))),
        "episode_index": pa.array(numbers.astype(np.int64)),
    }
    parquet.write_table(pa.table(columns), path)


def lerobot_info(folder: Path, names: Any) -> None:
    """``meta/info.json``, as much of it as an import reads."""
    (folder / "meta").mkdir(parents=True, exist_ok=True)
    state = {"dtype": "float32", "shape": [len(EULER)], "names": names}
    info = {"codebase_version": "v2.1", "fps": 30, "features": {"observation.state": state, "action": state}}
    (folder / "meta/info.json").write_text(json.dumps(info))


def states_of(times: Array) -> Array:
    """The end effector's states as ``EULER`` names them, (L, 7)."""
    places, turns = path_of(times)
    angles = Rotation.from_quat(turns[:, [1, 2, 3, 0]]).as_euler("xyz")
    return np.column_stack([places, angles, np.ones(len(times))])
