"""Exports read back by other libraries: npz, trimesh for PLY, pyarrow for LeRobot's layout."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow.parquet as parquet
import pytest
import trimesh
from physworld_client.errors import ExportRefused
from physworld_client.export import lerobot as lerobot_module
from physworld_client.export import open_export
from physworld_client.export.sampling import spread_points

from physworld_schemas.dataset import Dataset, DatasetConfig

FRAMES, PARTICLES, CONTROLS = 7, 40, 3
STEP_S = 1.0 / 30.0
EPISODES = 3


def dataset(state: str = "sealed") -> Dataset:
    return Dataset(
        id="dat_1",
        fit_id="fit_1",
        scene_id="scn_1",
        state=state,  # type: ignore[arg-type]
        created_at=datetime(2030, 1, 1, tzinfo=UTC),
        job_id="job_1",
        config=DatasetConfig(episodes=EPISODES),
        episodes_done=EPISODES,
    )


def episode(seed: int, frames: int = FRAMES, step_s: float = STEP_S) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(seed)
    attributes = {"motion": ("lift", "twist")[seed % 2], "seed": seed, "log_modulus_mean": 0.1}
    return {
        "times": np.arange(frames) * step_s,
        "particles": generator.standard_normal((frames, PARTICLES, 3)).astype(np.float32),
        "controllers": generator.standard_normal((frames, CONTROLS, 3)).astype(np.float32),
        "properties": generator.standard_normal((PARTICLES, 2)).astype(np.float32),
        "attributes": np.array(json.dumps(attributes)),
    }


def rubbing(seed: int, frames: int = FRAMES, **more: dict[str, float]) -> dict[str, np.ndarray]:
    """An episode with a field of friction under the particles, and ``more`` attributes."""
    plain = episode(seed, frames)
    attributes = json.loads(str(plain["attributes"])) | more
    friction = np.random.default_rng(100 + seed).standard_normal((PARTICLES, 1)).astype(np.float32)
    return plain | {
        "properties": np.concatenate([plain["properties"], friction], axis=1),
        "attributes": np.array(json.dumps(attributes)),
    }


def exported(
    format: str,
    folder: Path,
    points: int | None = None,
    made: Callable[[int, int], dict[str, np.ndarray]] = episode,
) -> list[dict[str, np.ndarray]]:
    episodes = [made(seed, FRAMES + seed) for seed in range(EPISODES)]
    writer = open_export(format, folder, dataset(), points)
    for index, arrays in enumerate(episodes):
        writer.add(index, arrays)
    writer.finish()
    assert json.loads((folder / "dataset.json").read_text())["id"] == "dat_1"
    return episodes


def test_npz_holds_what_the_service_gave(tmp_path: Path) -> None:
    for index, arrays in enumerate(exported("npz", tmp_path / "out")):
        with np.load(tmp_path / "out" / f"episode-{index:05d}.npz", allow_pickle=False) as stored:
            assert set(stored.files) == set(arrays)
            for name, values in arrays.items():
                np.testing.assert_array_equal(stored[name], values)


def test_a_ply_of_every_frame_is_read_by_trimesh(tmp_path: Path) -> None:
    episodes = exported("ply", tmp_path / "out")
    for index, arrays in enumerate(episodes):
        folder = tmp_path / "out" / f"episode-{index:05d}"
        assert len(list(folder.glob("frame-*.ply"))) == len(arrays["times"])
        for frame in (0, len(arrays["times"]) - 1):
            cloud = trimesh.load(folder / f"frame-{frame:05d}.ply")
            expected = np.concatenate([arrays["particles"][frame], arrays["controllers"][frame]])
            np.testing.assert_array_equal(np.asarray(cloud.vertices, np.float32), expected)
            data = cloud.metadata["_ply_raw"]["vertex"]["data"]
            np.testing.assert_array_equal(data["kind"], [0] * PARTICLES + [1] * CONTROLS)
            np.testing.assert_array_equal(data["log_modulus"][:PARTICLES], arrays["properties"][:, 0])
        times = [float(line) for line in (folder / "times.txt").read_text().split()]
        assert times == arrays["times"].tolist()


def test_a_ply_of_fewer_points_has_those_spread_over_the_body(tmp_path: Path) -> None:
    first = exported("ply", tmp_path / "out", points=8)[0]
    cloud = trimesh.load(tmp_path / "out" / "episode-00000" / "frame-00003.ply")
    chosen = spread_points(first["particles"][0], 8)
    np.testing.assert_array_equal(np.asarray(cloud.vertices[:8], np.float32), first["particles"][3, chosen])


def test_a_ply_holds_the_friction_of_an_episode_that_has_it(tmp_path: Path) -> None:
    strengths = {"air_drag_linear.rate_per_s": 0.4}
    made = exported("ply", tmp_path / "out", 8, lambda *given: rubbing(*given, effect_strengths=strengths))
    for index, arrays in enumerate(made):
        folder = tmp_path / "out" / f"episode-{index:05d}"
        data = trimesh.load(folder / "frame-00002.ply").metadata["_ply_raw"]["vertex"]["data"]
        chosen = spread_points(arrays["particles"][0], 8)
        for column, name in enumerate(("log_modulus", "log_density", "log_friction")):
            np.testing.assert_array_equal(
                data[name], [*arrays["properties"][chosen, column], *[0] * CONTROLS]
            )
        assert json.loads((folder / "attributes.json").read_text())["effect_strengths"] == strengths
    exported("ply", tmp_path / "without")
    plain = trimesh.load(tmp_path / "without/episode-00000/frame-00002.ply").metadata["_ply_raw"]["vertex"]
    assert "log_friction" not in plain["data"].dtype.names


def test_lerobot_holds_the_friction_and_strengths_that_episodes_were_made_with(tmp_path: Path) -> None:
    def drawn(seed: int, frames: int) -> dict[str, np.ndarray]:
        strengths = {"viscosity.time_s": 0.01 * seed, "air_drag_linear.rate_per_s": 0.5 + seed}
        return rubbing(seed, frames, effect_strengths=strengths)

    episodes = exported("lerobot", tmp_path / "out", 10, drawn)
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    own = json.loads((tmp_path / "out/meta/physworld.json").read_text())
    whole = parquet.read_table(tmp_path / "out/data/chunk-000/file-000.parquet").to_pydict()
    of_episode = np.array(whole["episode_index"])
    factors = info["features"]["observation.properties"]
    assert factors["shape"] == [30]
    first = own["particles"][0]
    assert factors["names"][:3] == [
        f"particle_{first}.log_{name}" for name in ("modulus", "density", "friction")
    ]
    names = info["features"]["observation.parameters"]["names"]
    assert names == ["air_drag_linear.rate_per_s", "viscosity.time_s"]
    for number, arrays in enumerate(episodes):
        properties = np.array(whole["observation.properties"], np.float32)[of_episode == number]
        expected = arrays["properties"][own["particles"]].ravel()
        np.testing.assert_array_equal(properties, np.tile(expected, (FRAMES + number, 1)))
        strengths = own["episodes"][str(number)]["effect_strengths"]
        parameters = np.array(whole["observation.parameters"])[of_episode == number]
        np.testing.assert_allclose(
            parameters, np.tile([strengths[name] for name in names], (FRAMES + number, 1)), rtol=1e-6
        )


def test_lerobot_holds_one_coefficient_as_a_plain_value(tmp_path: Path) -> None:
    """As the format does with features of one number; episodes that drew none have no such feature."""

    def drawn(seed: int, frames: int) -> dict[str, np.ndarray]:
        return rubbing(seed, frames, parameters={"ground_friction": 0.3 + seed})

    exported("lerobot", tmp_path / "out", 10, drawn)
    feature = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]["observation.parameters"]
    assert feature == {"dtype": "float32", "shape": [1], "names": ["ground_friction"]}
    whole = parquet.read_table(tmp_path / "out/data/chunk-000/file-000.parquet")
    assert str(whole.schema.field("observation.parameters").type) == "float"
    expected = 0.3 + np.array(whole["episode_index"])
    np.testing.assert_allclose(np.array(whole["observation.parameters"]), expected, rtol=1e-6)
    stats = json.loads((tmp_path / "out/meta/stats.json").read_text())["observation.parameters"]
    assert stats["max"] == pytest.approx([0.3 + EPISODES - 1], rel=1e-6)
    exported("lerobot", tmp_path / "none", 10)
    assert (
        "observation.parameters" not in json.loads((tmp_path / "none/meta/info.json").read_text())["features"]
    )


def test_an_episode_made_with_something_else_is_refused(tmp_path: Path) -> None:
    writer = open_export("lerobot", tmp_path / "out", dataset())
    writer.add(0, episode(0))
    with pytest.raises(ExportRefused, match="episode 1 was made with log_modulus, log_density, log_friction"):
        writer.add(1, rubbing(1))
    with pytest.raises(
        ExportRefused, match=r"with .*drag.rate; the first one with log_modulus, log_density$"
    ):
        writer.add(1, rubbing(1, effect_strengths={"drag.rate": 1.0}))


def test_lerobot_has_the_documented_layout(tmp_path: Path) -> None:
    episodes = exported("lerobot", tmp_path / "out", points=10)
    root = tmp_path / "out"
    info = json.loads((root / "meta/info.json").read_text())
    lengths = [len(arrays["times"]) for arrays in episodes]
    assert info["codebase_version"] == "v3.0" and info["fps"] == 30 and isinstance(info["fps"], int)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (EPISODES, sum(lengths), 2)
    assert info["splits"] == {"train": f"0:{EPISODES}"} and info["video_path"] is None
    assert info["data_path"] == "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    for name, feature in info["features"].items():
        assert set(feature) == {"dtype", "shape", "names"} and "/" not in name
        assert feature["names"] is None or len(feature["names"]) == feature["shape"][0]
    assert {"timestamp", "frame_index", "episode_index", "index", "task_index"} < set(info["features"])

    rows = parquet.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["episode_index"] for row in rows] == list(range(EPISODES))
    assert [row["length"] for row in rows] == lengths
    ends = np.cumsum(lengths).tolist()
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows] == list(
        zip([0, *ends[:-1]], ends, strict=True)
    )
    assert [row["tasks"] for row in rows] == [["lift"], ["twist"], ["lift"]]
    tasks = parquet.read_table(root / "meta/tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0, 1], "task": ["lift", "twist"]}
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_lerobot_frames_are_those_of_the_episodes(tmp_path: Path) -> None:
    episodes = exported("lerobot", tmp_path / "out", points=10)
    root = tmp_path / "out"
    info = json.loads((root / "meta/info.json").read_text())
    chosen = json.loads((root / "meta/physworld.json").read_text())["particles"]
    rows = parquet.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    file = parquet.ParquetFile(root / "data/chunk-000/file-000.parquet")
    assert file.num_row_groups == EPISODES
    whole = file.read()
    for name, feature in info["features"].items():
        kind = whole.schema.field(name).type
        if feature["shape"] == [1]:
            assert str(kind) == {"float32": "float", "int64": "int64"}[feature["dtype"]]
        else:
            assert kind.list_size == feature["shape"][0] and str(kind.value_type) == "float"
    for number, (arrays, row) in enumerate(zip(episodes, rows, strict=True)):
        part = whole.slice(row["dataset_from_index"], row["length"]).to_pydict()
        frames = len(arrays["times"])
        assert part["frame_index"] == list(range(frames)) and set(part["episode_index"]) == {number}
        np.testing.assert_allclose(part["timestamp"], np.arange(frames) / info["fps"], atol=1e-6)
        places = np.array(part["observation.environment_state"], np.float32).reshape(frames, -1, 3)
        np.testing.assert_array_equal(places, arrays["particles"][:, chosen])
        state = np.array(part["observation.state"]).reshape(frames, CONTROLS, 3)
        action = np.array(part["action"]).reshape(frames, CONTROLS, 3)
        np.testing.assert_allclose(state[:-1] + STEP_S * action[:-1], state[1:], atol=1e-5)
        assert not action[-1].any()
        properties = np.array(part["observation.properties"], np.float32).reshape(frames, -1, 2)
        np.testing.assert_array_equal(
            properties, np.broadcast_to(arrays["properties"][chosen], properties.shape)
        )


def test_lerobot_statistics_are_those_of_all_frames(tmp_path: Path) -> None:
    exported("lerobot", tmp_path / "out", points=10)
    stats = json.loads((tmp_path / "out/meta/stats.json").read_text())
    whole = parquet.read_table(tmp_path / "out/data/chunk-000/file-000.parquet").to_pydict()
    assert set(stats) == set(whole)
    for name, own in stats.items():
        values = np.array(whole[name], dtype=np.float64).reshape(len(whole[name]), -1)
        assert set(own) == {"min", "max", "mean", "std", "count"}
        np.testing.assert_allclose(own["mean"], values.mean(axis=0), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(own["std"], values.std(axis=0), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(own["min"], values.min(axis=0))
        np.testing.assert_allclose(own["max"], values.max(axis=0))
        assert own["count"] == [len(values)]


def test_lerobot_goes_on_in_another_file_when_one_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot_module, "DATA_FILE_MB", 0)
    monkeypatch.setattr(lerobot_module, "CHUNK_FILES", 2)
    exported("lerobot", tmp_path / "out")
    files = sorted(
        path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out/data").rglob("*.parquet")
    )
    assert files == [
        "data/chunk-000/file-000.parquet",
        "data/chunk-000/file-001.parquet",
        "data/chunk-001/file-000.parquet",
    ]
    rows = parquet.read_table(tmp_path / "out/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(row["data/chunk_index"], row["data/file_index"]) for row in rows] == [(0, 0), (0, 1), (1, 0)]


def test_a_rate_that_is_no_whole_number_is_not_rounded(tmp_path: Path) -> None:
    writer = open_export("lerobot", tmp_path / "out", dataset())
    writer.add(0, episode(0, step_s=0.032))
    writer.finish()
    assert json.loads((tmp_path / "out/meta/info.json").read_text())["fps"] == pytest.approx(31.25)


def test_an_episode_of_another_body_is_refused(tmp_path: Path) -> None:
    writer = open_export("lerobot", tmp_path / "out", dataset())
    writer.add(0, episode(0))
    other = episode(1)
    with pytest.raises(ExportRefused, match="episode 1 has 39 particles"):
        writer.add(1, {**other, "particles": other["particles"][:, 1:]})


def test_what_cannot_be_exported_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ExportRefused, match="unknown format 'csv'; there are npz, ply, lerobot"):
        open_export("csv", tmp_path / "a", dataset())
    with pytest.raises(ExportRefused, match="dat_1 is writing"):
        open_export("npz", tmp_path / "b", dataset("writing"))
    with pytest.raises(ExportRefused, match="0 points"):
        open_export("ply", tmp_path / "c", dataset(), 0)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("keep")
    with pytest.raises(ExportRefused, match="not an empty folder"):
        open_export("npz", tmp_path / "full", dataset())
    assert not any((tmp_path / name).exists() for name in "abc")
    for format in ("npz", "ply", "lerobot"):
        with pytest.raises(ExportRefused, match="holds no episode"):
            open_export(format, tmp_path / f"empty-{format}", dataset()).finish()
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(ExportRefused, match="needs pyarrow"):
        open_export("lerobot", tmp_path / "d", dataset())
