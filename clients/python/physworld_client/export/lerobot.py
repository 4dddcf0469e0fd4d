"""LeRobot's dataset format v3.0: parquet files of frames, and what describes them under ``meta/``.

::

    meta/info.json                              features with shapes and names, counts, fps, paths
    meta/stats.json                             min, max, mean, std, count of every feature
    meta/tasks.parquet                          task_index by task (the index, as pandas reads it)
    meta/episodes/chunk-000/file-000.parquet    length, tasks, place and statistics of every episode
    meta/physworld.json                         which particles were taken, and every episode's attributes
    data/chunk-000/file-000.parquet             frames, one row group an episode, at most about 100 MB a file

Features: ``observation.state``, the control points [m]; ``observation.environment_state``, particles [m];
``observation.properties``, their log factors of stiffness and density, and of the ground's friction under them where
it was perturbed as a field; ``observation.parameters``, where the episodes differ in them, the strengths of effects
and the ground's one coefficient, in their units; ``action``, the control points' velocities until the next frame [m/s],
zero in the last one. A task is the pattern of the motion.

The format counts in whole frames a second. Where the clock's rate is no whole number ``fps`` is written as it is, and
readers that expect an integer refuse it or need a larger tolerance.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from physworld_client.errors import ExportRefused
from physworld_client.export.properties import attributes_of, property_names, scalars_of
from physworld_client.export.sampling import spread_points
from physworld_client.types import Array

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = "v3.0"
CHUNK_FILES = 1000
DATA_FILE_MB, VIDEO_FILE_MB = 100, 200
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA_PATH = f"data/{FILE}"
EPISODES_PATH = f"meta/episodes/{FILE}"
STATE, SURROUNDINGS, PROPERTIES, PARAMETERS, ACTION = (
    "observation.state",
    "observation.environment_state",
    "observation.properties",
    "observation.parameters",
    "action",
)
INDICES = ("frame_index", "episode_index", "index", "task_index")
DEFAULT_POINTS = 256


class LeRobotWriter:
    """Writes frames as they come, and ``meta/`` at the end.

    Raises:
        ExportRefused: pyarrow is missing (the extra ``export`` brings it), or an episode is of another size or clock.
    """

    title: ClassVar[str] = "LeRobot v3.0"
    help: ClassVar[str] = "data/, meta/info.json, stats.json, tasks.parquet, episodes/"

    def __init__(self, folder: Path, points: int | None = None) -> None:
        _parquet()
        self._folder = folder
        self.unfinished: Path | None = None
        self._points = DEFAULT_POINTS if points is None else points
        self._chosen = np.empty(0, dtype=np.int64)
        self._shape: tuple[int, int] | None = None
        self._properties: tuple[str, ...] = ()
        self._parameters: tuple[str, ...] = ()
        self._step_s = 0.0
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._attributes: dict[str, Any] = {}
        self._totals = _Totals()
        self._frames = 0
        self._file = 0
        self._written_bytes = 0
        self._writer: Any = None

    def add(self, index: int, arrays: Mapping[str, Array]) -> None:
        """Write one episode's frames; ``index`` is kept in ``meta/physworld.json``, the format counts on its own."""
        attributes = attributes_of(arrays)
        self._check(index, arrays, attributes)
        task = str(attributes.get("motion") or "demonstration").replace("_", " ")
        number = len(self._episodes)
        columns = self._columns(arrays, attributes, number, self._tasks.setdefault(task, len(self._tasks)))
        table = _table(columns)
        if self._writer is not None and self._written_bytes + table.nbytes > DATA_FILE_MB * 2**20:
            self._close()
            self._file += 1
        if self._writer is None:
            path = self._folder / DATA_PATH.format(**self._place())
            path.parent.mkdir(parents=True, exist_ok=True)
            self.unfinished = path
            self._writer = _parquet().ParquetWriter(path, table.schema, compression="snappy")
        self._writer.write_table(table, row_group_size=len(table))
        self._written_bytes += table.nbytes
        statistics = {name: _statistics(values) for name, values in columns.items()}
        self._totals.add(statistics)
        self._episodes.append(
            {
                "episode_index": number,
                "tasks": [task],
                "length": len(table),
                "data/chunk_index": self._place()["chunk_index"],
                "data/file_index": self._place()["file_index"],
                "dataset_from_index": self._frames,
                "dataset_to_index": self._frames + len(table),
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                **{f"stats/{n}/{k}": v.tolist() for n, own in statistics.items() for k, v in own.items()},
            }
        )
        self._attributes[str(number)] = {"index": index, **attributes}
        self._frames += len(table)

    def finish(self) -> None:
        """Write ``meta/``. Raises ExportRefused where no episode was added."""
        if not self._episodes:
            raise ExportRefused("the dataset holds no episode")
        self._close()
        import pyarrow as pa

        episodes = self._folder / EPISODES_PATH.format(chunk_index=0, file_index=0)
        episodes.parent.mkdir(parents=True, exist_ok=True)
        _parquet().write_table(pa.Table.from_pylist(self._episodes), episodes)
        _parquet().write_table(_tasks_table(self._tasks), self._folder / "meta/tasks.parquet")
        stats = {n: {k: v.tolist() for k, v in own.items()} for n, own in self._totals.merged().items()}
        own = {"particles": self._chosen.tolist(), "step_s": self._step_s, "episodes": self._attributes}
        for name, content in (("info", self._info()), ("stats", stats), ("physworld", own)):
            (self._folder / f"meta/{name}.json").write_text(json.dumps(content, indent=4, ensure_ascii=False))

    def _check(self, index: int, arrays: Mapping[str, Array], attributes: Mapping[str, Any]) -> None:
        """Take the first episode's size, clock and what it was made with, and refuse another one's that differ."""
        times, particles, controllers = arrays["times"], arrays["particles"], arrays["controllers"]
        step = float(times[-1] - times[0]) / max(len(times) - 1, 1)
        shape = (particles.shape[1], controllers.shape[1])
        made = property_names(arrays), tuple(scalars_of(attributes))
        if self._shape is None:
            self._shape, self._step_s = shape, step
            self._properties, self._parameters = made
            self._chosen = spread_points(particles[0], self._points)
        if shape != self._shape or abs(step - self._step_s) > 1e-6:
            raise ExportRefused(
                f"episode {index} has {shape[0]} particles, {shape[1]} control points and {step:.6f} s a frame; the "
                f"first one had {self._shape[0]}, {self._shape[1]} and {self._step_s:.6f} s"
            )
        if made != (self._properties, self._parameters):
            known = ", ".join((*self._properties, *self._parameters))
            raise ExportRefused(
                f"episode {index} was made with {', '.join((*made[0], *made[1]))}; the first one with {known}"
            )

    def _columns(
        self, arrays: Mapping[str, Array], attributes: Mapping[str, Any], number: int, task: int
    ) -> dict[str, Array]:
        """Features of one episode by name, each (T, …), (T,) where there is one number."""
        times, controllers = arrays["times"], arrays["controllers"]
        frames = len(times)
        velocity = np.zeros(controllers.shape)
        velocity[:-1] = np.diff(controllers.astype(np.float64), axis=0) / np.diff(times)[:, None, None]
        properties = np.tile(arrays["properties"][self._chosen].ravel(), (frames, 1))
        parameters = np.tile(list(scalars_of(attributes).values()), (frames, 1)).astype(np.float32)
        if len(self._parameters) == 1:  # the format holds features of one number as plain values
            parameters = parameters[:, 0]
        counted = np.arange(frames)
        return {
            STATE: controllers.reshape(frames, -1).astype(np.float32),
            SURROUNDINGS: arrays["particles"][:, self._chosen].reshape(frames, -1).astype(np.float32),
            PROPERTIES: properties.astype(np.float32),
            **({PARAMETERS: parameters} if self._parameters else {}),
            ACTION: velocity.reshape(frames, -1).astype(np.float32),
            "timestamp": (times - times[0]).astype(np.float32),
            "frame_index": counted,
            "episode_index": np.full(frames, number),
            "index": self._frames + counted,
            "task_index": np.full(frames, task),
        }

    def _info(self) -> dict[str, Any]:
        assert self._shape is not None
        rate = 1.0 / self._step_s
        return {
            "codebase_version": VERSION,
            "robot_type": None,
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": DATA_FILE_MB,
            "video_files_size_in_mb": VIDEO_FILE_MB,
            "fps": round(rate) if abs(rate - round(rate)) < 1e-6 else rate,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": DATA_PATH,
            "video_path": None,
            "features": self._features(),
        }

    def _features(self) -> dict[str, Any]:
        controls = [f"control_{k}" for k in range(0 if self._shape is None else self._shape[1])]
        points = [f"particle_{p}" for p in self._chosen]

        def feature(names: list[str], kind: str = "float32") -> dict[str, Any]:
            return {"dtype": kind, "shape": [len(names)], "names": names}

        def each(parts: list[str], *ends: str) -> list[str]:
            return [f"{part}.{end}" for part in parts for end in ends]

        return {
            STATE: feature(each(controls, *"xyz")),
            SURROUNDINGS: feature(each(points, *"xyz")),
            PROPERTIES: feature(each(points, *self._properties)),
            **({PARAMETERS: feature(list(self._parameters))} if self._parameters else {}),
            ACTION: feature(each(controls, "vx", "vy", "vz")),
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
            **{name: {"dtype": "int64", "shape": [1], "names": None} for name in INDICES},
        }

    def _place(self) -> dict[str, int]:
        return {"chunk_index": self._file // CHUNK_FILES, "file_index": self._file % CHUNK_FILES}

    def _close(self) -> None:
        if self._writer is not None:
            self._writer.close()
        self._writer, self._written_bytes, self.unfinished = None, 0, None


class _Totals:
    """Statistics of all episodes from those of each: exact, without the frames."""

    def __init__(self) -> None:
        self._all: list[dict[str, dict[str, Array]]] = []

    def add(self, statistics: dict[str, dict[str, Array]]) -> None:
        self._all.append(statistics)

    def merged(self) -> dict[str, dict[str, Array]]:
        found = {}
        for name in self._all[0]:
            parts = {key: np.stack([one[name][key] for one in self._all]) for key in self._all[0][name]}
            weights = parts["count"] / parts["count"].sum()
            mean = np.sum(weights * parts["mean"], axis=0)
            variance = np.sum(weights * (parts["std"] ** 2 + (parts["mean"] - mean) ** 2), axis=0)
            found[name] = {
                "min": parts["min"].min(axis=0),
                "max": parts["max"].max(axis=0),
                "mean": mean,
                "std": np.sqrt(variance),
                "count": parts["count"].sum(axis=0),
            }
        return found


def _statistics(values: Array) -> dict[str, Array]:
    """Over the frames of one episode's feature (T, …), each (n,)."""
    flat = values.reshape(len(values), -1).astype(np.float64)
    kind = np.int64 if values.dtype.kind == "i" else np.float64
    return {
        "min": flat.min(axis=0).astype(kind),
        "max": flat.max(axis=0).astype(kind),
        "mean": flat.mean(axis=0),
        "std": flat.std(axis=0),
        "count": np.array([len(flat)]),
    }


def _table(columns: Mapping[str, Array]) -> pa.Table:
    """Columns (T,) as plain values, (T, n) as lists of fixed length."""
    import pyarrow as pa

    arrays = [
        pa.array(values)
        if values.ndim == 1
        else pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
        for values in columns.values()
    ]
    return pa.table(arrays, names=list(columns))


def _tasks_table(tasks: Mapping[str, int]) -> pa.Table:
    """Task numbers under their texts, the texts marked as the index for pandas, which LeRobot reads it with."""
    import pyarrow as pa

    def column(name: str, pandas_type: str, numpy_type: str) -> dict[str, Any]:
        types = {"pandas_type": pandas_type, "numpy_type": numpy_type}
        return {"name": name, "field_name": name, **types, "metadata": None}

    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    numbers, texts = pa.array(tasks.values(), pa.int64()), pa.array(tasks.keys(), pa.string())
    table = pa.table([numbers, texts], names=["task_index", "task"])
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def _parquet() -> Any:
    """pyarrow's parquet module. Raises ExportRefused where it is not installed."""
    try:
        import pyarrow.parquet as parquet
    except ImportError as error:
        raise ExportRefused(
            "the LeRobot format needs pyarrow: pip install 'physworld-client[export]'"
        ) from error
    return parquet
