"""Made motion of a cloth under a rigid gripper, and writers of it in the layouts that motion capture programs
export.

Each writer takes tracks in the scene's world (metres, z up) and turns and scales them into the file's axes and unit,
so that an import has to give them back. Gaps are nan. The layouts are those of the programs' own exports: ``motive``
of OptiTrack Motive's format versions 1.1 to 1.25, ``vicon`` of Nexus' ASCII export, ``qualisys`` of QTM's TSV,
``trc`` of OpenSim.
"""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from physworld_scenes.importers.axes import ROTATION_FROM_UP

Array = np.ndarray
PER_METRE = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "in": 1 / 0.0254}
MOTIVE_UNITS = {"m": "Meters", "cm": "Centimeters", "mm": "Millimeters"}


@dataclass(frozen=True)
class Motion:
    """Tracks in metres, z up.

    Attributes:
        times: (T,) [s].
        points: on the body, (T, N, 3).
        gripper: markers of the gripper, (T, K, 3).
        origin, turns: the gripper's pose: (T, 3), and quaternions (T, 4), scalar first.
    """

    times: Array
    points: Array
    gripper: Array
    origin: Array
    turns: Array
    names: tuple[str, ...] = field(default=())

    @property
    def rate_hz(self) -> float:
        """Frames per second."""
        return round(1.0 / (self.times[1] - self.times[0]), 6)

    def tracks(self, gripper: str = "Gripper:Marker {}", body: str = "M{}") -> tuple[list[str], Array]:
        """All markers, gripper first: labels with numbers from 1, and places (T, K + N, 3)."""
        labels = [gripper.format(i + 1) for i in range(self.gripper.shape[1])] + [
            body.format(i + 1) for i in range(self.points.shape[1])
        ]
        return labels, np.concatenate([self.gripper, self.points], axis=1)


def made(frames: int = 120, rate_hz: float = 100.0, noise_m: float = 2e-4, side: int = 4) -> Motion:
    """A cloth of ``side`` squared markers, 0.1 m apart, that swings and waves under a gripper that moves and turns."""
    rng = np.random.default_rng(7)
    times = np.arange(frames) / rate_hz
    turn = Rotation.from_euler(
        "zyx", np.stack([0.4 * np.sin(3 * times), 0.2 * np.sin(2 * times), 0 * times], axis=1)
    )
    origin = np.stack(
        [0.1 * np.sin(2.5 * times), 0.05 * np.cos(1.7 * times) - 0.05, 1.2 + 0.05 * np.sin(4 * times)], axis=1
    )
    shape = np.array([[0.0, 0.03, 0.05], [0.06, -0.02, 0.05], [-0.05, -0.03, 0.06], [0.02, 0.0, 0.09]])
    gripper = np.stack([turn.apply(corner) for corner in shape], axis=1) + origin[:, None]
    across, down = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    rest = np.stack([0.1 * (across - (side - 1) / 2), 0 * across, -0.1 * (down + 0.2)], axis=2).reshape(-1, 3)
    depth = -rest[:, 2]
    wave = depth * 0.4 * np.sin(6 * times[:, None] - 5 * depth + rest[:, 0] * 4)
    points = rest + 0.7 * origin[:, None] + [0, 0, 0.36] + wave[..., None] * [0.3, 1.0, 0.25]
    points = points + noise_m * rng.standard_normal(points.shape)
    x, y, z, w = turn.as_quat().T
    return Motion(times, points, gripper, origin, np.stack([w, x, y, z], axis=1))


def in_file(places: Array, up: str, unit: str) -> Array:
    """Places [m], z up, in a file's axes and unit."""
    return places @ ROTATION_FROM_UP[up] * PER_METRE[unit]


def _cell(value: float, digits: int) -> str:
    return "" if not np.isfinite(value) else f"{value:.{digits}f}"


def _text(rows: list[list[str]], delimiter: str = ",", end: str = "\r\n") -> bytes:
    stream = io.StringIO()
    csv.writer(stream, delimiter=delimiter, lineterminator=end).writerows(rows)
    return stream.getvalue().encode()


def motive(
    motion: Motion,
    *,
    version: str = "1.23",
    up: str = "y",
    unit: str = "m",
    pose: bool = True,
    solved: bool = True,
    measured: bool = True,
    unlabelled: int = 0,
    places: Array | None = None,
    digits: int = 6,
) -> bytes:
    """OptiTrack Motive's CSV: the rigid body Gripper (pose, solved markers, measured ones), then the body's markers.

    Args:
        version: from 1.24 on the rows have words in front and there may be time codes, from 1.25 on a row of parents;
            before 1.2 no IDs.
        places: (T, N, 3) [m] instead of the motion's points.
        unlabelled: how many markers without names to add.
    """
    number = tuple(int(part) for part in version.split("."))
    worded, coded = number >= (1, 24), number == (1, 24)
    frames = len(motion.times)
    columns: list[tuple[str, str, str, str, str, Array]] = []  # type, name, ID, kind, axis, values

    def thing(kind: str, name: str, key: str, value: str, axes: str, values: Array) -> None:
        columns.extend((kind, name, key, value, axis, values[:, at]) for at, axis in enumerate(axes))

    def turned(points: Array) -> Array:
        return in_file(points, up, unit)

    if pose:
        rotation = Rotation.from_quat(motion.turns[:, [1, 2, 3, 0]])
        seen = rotation.as_matrix()
        matrix = ROTATION_FROM_UP[up]
        quaternions = Rotation.from_matrix(matrix.T @ seen @ matrix).as_quat()
        thing("Rigid Body", "Gripper", "1", "Rotation", "XYZW", quaternions)
        thing("Rigid Body", "Gripper", "1", "Position", "XYZ", turned(motion.origin))
        error = "Error Per Marker" if number < (1, 23) else "Mean Marker Error"
        columns.append(("Rigid Body", "Gripper", "1", error, "", np.full(frames, 1e-4)))
    for kind, wanted in (("Rigid Body Marker", solved), ("Marker", measured)):
        for index in range(motion.gripper.shape[1] if wanted else 0):
            noise = 0.0 if kind != "Marker" else 1e-3
            thing(
                kind,
                f"Gripper:Marker{index + 1}",
                f"{index}",
                "Position",
                "XYZ",
                turned(motion.gripper[:, index] + noise),
            )
            if kind != "Marker":
                columns.append(
                    (kind, f"Gripper:Marker{index + 1}", f"{index}", "Marker Quality", "", np.ones(frames))
                )
    points = motion.points if places is None else places
    for index in range(points.shape[1]):
        thing("Marker", f"M{index + 1}", f"A{index}", "Position", "XYZ", turned(points[:, index]))
    for index in range(unlabelled):
        stray = np.where(np.arange(frames)[:, None] % 7 < 4, points[:, 0] + 0.3 + index, np.nan)
        thing("Marker", f"Unlabeled {1189 + index}", f"B{index}", "Position", "XYZ", turned(stray))
    facts = {
        "Format Version": version,
        "Take Name": "Take, of a cloth",
        "Capture Frame Rate": f"{motion.rate_hz:.6f}",
        "Export Frame Rate": f"{motion.rate_hz:.6f}",
        "Capture Start Time": "2024-05-03 02.11.45.344 PM",
        "Total Frames in Take": str(frames),
        "Total Exported Frames": str(frames),
        "Rotation Type": "Quaternion",
        "Length Units": MOTIVE_UNITS[unit],
        "Coordinate Space": "Global",
    }
    front = [["", "Type"], ["", "Name"], ["", "ID"], ["", "Parent"], ["", ""]] if worded else [["", ""]] * 5
    code = [""] if coded else []
    rows = [[part for pair in facts.items() for part in pair], []]
    rows.append(front[0] + code + [column[0] for column in columns])
    rows.append(front[1] + code + [column[1] for column in columns])
    if number >= (1, 2):
        rows.append(front[2] + code + [column[2] for column in columns])
    if number >= (1, 25):
        rows.append(front[3] + code + ["Gripper" if "Gripper" in column[1] else "" for column in columns])
    rows.append(front[4] + code + [column[3] for column in columns])
    rows.append(
        ["Frame", "Time (Seconds)", *(["TimeCode"] if coded else []), *(column[4] for column in columns)]
    )
    for t in range(frames):
        time = [str(t), f"{motion.times[t]:.6f}", *([f"15:26:46:{t % 60:02d}.02"] if coded else [])]
        rows.append(time + [_cell(column[5][t], digits) for column in columns])
    return _text(rows)


def vicon(
    motion: Motion, *, up: str = "z", places: Array | None = None, others: bool = True, delimiter: str = ","
) -> bytes:
    """Vicon Nexus' CSV in millimetres: a section of devices, then Trajectories, with subjects before the names."""
    labels, tracks = motion.tracks("Hand:grip{}", "Cloth:M{}")
    tracks = tracks if places is None else places
    values = in_file(tracks, up, "mm")
    rows: list[list[str]] = []
    if others:
        rows += [
            ["Devices"],
            ["1000"],
            ["", "", "Force Plate - Force", "", ""],
            ["Frame", "Sub Frame", "Fx", "Fy", "Fz"],
        ]
        rows += [["", "", "N", "N", "N"], *[["1", str(sub), "0.1", "0.2", "0.3"] for sub in range(10)], []]
    rows += [["Trajectories"], [f"{motion.rate_hz:g}"]]
    rows.append(["", "", *(cell for label in labels for cell in (label, "", ""))])
    rows.append(["Frame", "Sub Frame", *(["X", "Y", "Z"] * len(labels))])
    rows.append(["", "", *(["mm"] * 3 * len(labels))])
    for t, frame in enumerate(values):
        rows.append([str(t + 1), "0", *(_cell(value, 6) for value in frame.ravel())])
    if others:
        rows += [[], ["Model Outputs"], [f"{motion.rate_hz:g}"], ["", "", "Cloth:Com", "", ""]]
        rows += [["Frame", "Sub Frame", "X", "Y", "Z"], ["", "", "mm", "mm", "mm"], ["1", "0", "1", "2", "3"]]
    return _text(rows, delimiter)


def qualisys(
    motion: Motion, *, up: str = "z", heads: bool = False, timed: bool = False, version: str | None = None,
    missing: str = "", places: Array | None = None,
) -> bytes:  # fmt: skip
    """Qualisys QTM's TSV in millimetres, with or without heads of columns, frame and time."""
    labels, tracks = motion.tracks("grip_{}", "M{}")
    tracks = tracks if places is None else places
    values = in_file(tracks, up, "mm")
    rows = [["FILE_VERSION", version]] if version else []
    rows += [
        ["NO_OF_FRAMES", str(len(values))],
        ["NO_OF_CAMERAS", "13"],
        ["NO_OF_MARKERS", str(len(labels))],
        ["FREQUENCY", f"{motion.rate_hz:g}"],
        ["NO_OF_ANALOG", "0"],
        ["ANALOG_FREQUENCY", "0"],
        ["DESCRIPTION", "--"],
        ["TIME_STAMP", "2024-04-15, 10:39:38.777", "406646.66137317"],
        ["DATA_INCLUDED", "3D"],
        ["EVENT", "Start", "1", "0.01"],
        ["MARKER_NAMES", *labels],
        ["TRAJECTORY_TYPES", *(["Measured"] * len(labels))],
    ]
    if heads:
        rows.append(
            [
                *(["Frame", "Time"] if timed else []),
                *(f"{label} {axis}" for label in labels for axis in "XYZ"),
            ]
        )
    for t, frame in enumerate(values):
        front = [str(t + 1), f"{motion.times[t]:.5f}"] if timed else []
        cells = [_cell(value, 6) if np.isfinite(value) else missing for value in frame.ravel()]
        rows.append(front + cells)
    return _text(rows, "\t")


def trc(
    motion: Motion, *, up: str = "y", unit: str = "mm", blank: bool = True, places: Array | None = None
) -> bytes:
    """TRC, with or without the empty line before the numbers."""
    labels, tracks = motion.tracks("Gripper{}", "M{}")
    tracks = tracks if places is None else places
    values = in_file(tracks, up, unit)
    count, rate = len(labels), f"{motion.rate_hz:.2f}"
    rows = [
        ["PathFileType", "4", "(X/Y/Z)", "made.trc"],
        [
            "DataRate",
            "CameraRate",
            "NumFrames",
            "NumMarkers",
            "Units",
            "OrigDataRate",
            "OrigDataStartFrame",
            "OrigNumFrames",
        ],
        [rate, rate, str(len(values)), str(count), unit, rate, "1", str(len(values))],
        ["Frame#", "Time", *(cell for label in labels for cell in (label, "", ""))],
        ["", "", *(f"{axis}{index + 1}" for index in range(count) for axis in "XYZ")],
        *([[]] if blank else []),
    ]
    for t, frame in enumerate(values):
        rows.append([str(t + 1), f"{motion.times[t]:.6f}", *(_cell(value, 6) for value in frame.ravel())])
    return _text(rows, "\t")


NAMINGS = {
    "underscore": "{name}_{axis}",
    "dot": "{name}.{axis}",
    "axis first": "{axis}_{name}",
    "capital": "{name}{AXIS}",
    "with unit": "{name}_{axis}_mm",
    "brackets": "{name} {axis} [mm]",
    "position": "{name}.position.{axis}",
    "colon": "{name}:{AXIS}",
}


def columns(
    motion: Motion, *, naming: str = "underscore", up: str = "z", unit: str = "m", time: str = "time",
    delimiter: str = ",", decimal: str = ".", comment: str = "", places: Array | None = None,
) -> bytes:  # fmt: skip
    """Plain columns, one row a frame; ``naming`` is a key of ``NAMINGS`` or 'two rows'."""
    labels, tracks = motion.tracks("grip{}", "m{}")
    tracks = tracks if places is None else places
    values = in_file(tracks, up, unit)
    if naming == "two rows":
        rows = [["", *(label for label in labels for _ in "xyz")], [time, *("xyz" * len(labels))]]
    else:
        form = NAMINGS[naming]
        rows = [[time, *(form.format(name=n, axis=a, AXIS=a.upper()) for n in labels for a in "xyz")]]
    rows[0][0] = comment + rows[0][0]
    scale = 1e3 if time.endswith("ms") else 1.0
    for t, frame in enumerate(values):
        cells = [f"{motion.times[t] * scale:.6f}", *(_cell(value, 7) for value in frame.ravel())]
        rows.append([cell.replace(".", decimal) for cell in cells])
    return _text(rows, delimiter, "\n")


def long_columns(motion: Motion, *, up: str = "z", unit: str = "m", by_marker: bool = False) -> bytes:
    """Plain columns, one row a marker and frame; what is not seen has no row."""
    labels, tracks = motion.tracks("grip{}", "m{}")
    values = in_file(tracks, up, unit)
    rows = [["time", "marker", "x", "y", "z"]]
    pairs = [(t, i) for t in range(len(values)) for i in range(len(labels))]
    for t, i in sorted(pairs, key=lambda pair: pair[::-1]) if by_marker else pairs:
        if np.isfinite(values[t, i]).all():
            rows.append([f"{motion.times[t]:.6f}", labels[i], *(f"{value:.7f}" for value in values[t, i])])
    return _text(rows, ",", "\n")


def c3d(motion: Motion, path: Path, *, up: str = "z", screen: bool = False) -> bytes:
    """C3D in millimetres, as ezc3d writes it."""
    import ezc3d

    labels, tracks = motion.tracks("grip{}", "M{}")
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [motion.rate_hz]
    file["parameters"]["POINT"]["LABELS"]["value"] = labels
    file.add_parameter("POINT", "UNITS", ["mm"])
    if screen:
        file.add_parameter("POINT", "X_SCREEN", ["+X"])
        file.add_parameter("POINT", "Y_SCREEN", [f"+{up.upper()}" if len(up) == 1 else up.upper()])
    content = np.ones((4, len(labels), len(tracks)))
    content[:3] = in_file(tracks, up, "mm").transpose(2, 1, 0)
    file["data"]["points"] = content
    file.write(str(path))
    return path.read_bytes()


def arrays(motion: Motion, *, up: str = "z", unit: str = "m", said: bool = True) -> dict[str, Any]:
    """The arrays of an npz or an HDF5 file: points, gripper, times, names; unit and up where ``said``."""
    content: dict[str, Any] = {
        "points": in_file(motion.points, up, unit),
        "gripper": in_file(motion.gripper, up, unit),
        "times": motion.times,
        "labels": np.array([f"m{i + 1}" for i in range(motion.points.shape[1])]),
    }
    return content | ({"unit": np.array(unit), "up": np.array(up)} if said else {})


def npz(motion: Motion, **options: Any) -> bytes:
    """An npz of these arrays."""
    stream = io.BytesIO()
    np.savez(stream, **arrays(motion, **options))
    return stream.getvalue()


def hdf5(motion: Motion, path: Path, **options: Any) -> bytes:
    """An HDF5 file of these arrays in a group, unit and up as attributes of it."""
    import h5py

    with h5py.File(path, "w") as file:
        group = file.create_group("trial")
        for name, value in arrays(motion, **options).items():
            if name in ("unit", "up"):
                group.attrs[name] = str(value)
            else:
                group.create_dataset(name, data=value.astype("S") if value.dtype.kind == "U" else value, **(
                    {"compression": "gzip"} if value.ndim == 3 else {}
                ))  # fmt: skip
    return path.read_bytes()


RULE = f"{'=' * 80}\n"
HEADER = f"""{RULE}MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{RULE}MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
QUATERNION = f"""{RULE}MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
POSE_SCHEMA = f"""std_msgs/Header header
geometry_msgs/Pose pose
{RULE}MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
{RULE}MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
{QUATERNION}{HEADER}"""
CLOUD_SCHEMA = f"""std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
{HEADER}{RULE}MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
"""


def _stamp(time: float) -> dict[str, int]:
    whole, part = divmod(round(time * 1e9) + 10**18, 10**9)
    return {"sec": whole, "nanosec": part}


def mcap_json(motion: Motion) -> bytes:
    """An MCAP log of JSON: the gripper's pose, and all points in one message a frame."""
    from mcap.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    schemas = {
        n: writer.register_schema(n, "jsonschema", b'{"type": "object"}')
        for n in ("geometry_msgs/PoseStamped", "sensor_msgs/PointCloud")
    }
    grip = writer.register_channel("/gripper/pose", "json", schemas["geometry_msgs/PoseStamped"])
    body = writer.register_channel("/cloth/points", "json", schemas["sensor_msgs/PointCloud"])
    for t, time in enumerate(motion.times):
        header = {"stamp": _stamp(time), "frame_id": "world"}
        pose = {
            "position": dict(zip("xyz", motion.origin[t], strict=True)),
            "orientation": dict(zip("wxyz", motion.turns[t], strict=True)),
        }
        cloud = [dict(zip("xyz", point, strict=True)) for point in motion.points[t]]
        now = round(time * 1e9)
        for channel, message in (
            (grip, {"header": header, "pose": pose}),
            (body, {"header": header, "points": cloud}),
        ):
            writer.add_message(channel, log_time=now, publish_time=now, data=json.dumps(message).encode())
    writer.finish()
    return stream.getvalue()


def mcap_ros2(motion: Motion) -> bytes:
    """An MCAP log of ROS 2 messages: PoseStamped of the gripper, PointCloud2 of the points (doubles)."""
    from mcap_ros2.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream)
    pose = writer.register_msgdef("geometry_msgs/msg/PoseStamped", POSE_SCHEMA)
    cloud = writer.register_msgdef("sensor_msgs/msg/PointCloud2", CLOUD_SCHEMA)
    fields = [{"name": axis, "offset": 8 * at, "datatype": 8, "count": 1} for at, axis in enumerate("xyz")]
    for t, time in enumerate(motion.times):
        header = {"stamp": _stamp(time), "frame_id": "world"}
        now = round(time * 1e9)
        place = {
            "position": dict(zip("xyz", motion.origin[t], strict=True)),
            "orientation": dict(zip("wxyz", motion.turns[t], strict=True)),
        }
        writer.write_message(
            "/gripper/pose", pose, {"header": header, "pose": place}, log_time=now, publish_time=now
        )
        points = motion.points[t]
        message = {
            "header": header, "height": 1, "width": len(points), "fields": fields, "is_bigendian": False,
            "point_step": 24, "row_step": 24 * len(points), "data": points.astype("<f8").tobytes(), "is_dense": True,
        }  # fmt: skip
        writer.write_message("/cloth/points", cloud, message, log_time=now, publish_time=now)
    writer.finish()
    return stream.getvalue()
