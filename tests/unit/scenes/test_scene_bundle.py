"""Bundles come in as folder or archive, and go round without loss."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
import zipfile
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scene_parts import sound_parts

from physworld.scene import AS_MEASURED, UNDEFORMED_AT_REST, Scene
from physworld_scenes.archive_writing import write_arrays, write_zip
from physworld_scenes.bundle import (
    bundle_from_bytes,
    canonical_archive,
    parts_of,
    read_bundle,
    scene_from_parts,
    validate,
    write_bundle,
)
from physworld_scenes.errors import SceneInvalid

pytestmark = pytest.mark.slow


def sound_scene() -> Scene:
    """The sound parts as a scene."""
    return scene_from_parts(*sound_parts())


def files_of(declared: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, bytes]:
    """The two files of a bundle."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return {"scene.json": json.dumps(declared).encode(), "scene.npz": buffer.getvalue()}


def tar_of(files: dict[str, bytes], mode: str) -> bytes:
    """A tar of the files."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode=mode) as archive:  # type: ignore[call-overload]
        for name, content in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


def assert_same(one: Any, other: Any) -> None:
    """Equal in every field, arrays by type and value."""
    assert type(one) is type(other)
    if isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif hasattr(one, "__dataclass_fields__"):
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name))
    else:
        assert one == other


def test_folder_zip_and_tar_hold_the_same_scene(tmp_path: Path) -> None:
    files = files_of(*sound_parts())
    folder = tmp_path / "scene"
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    (tmp_path / "scene.tar.gz").write_bytes(tar_of(files, "w:gz"))
    read = [
        read_bundle(folder),
        read_bundle(tmp_path / "scene.tar.gz"),
        bundle_from_bytes(tar_of(files, "w"))[0],
        bundle_from_bytes(write_zip(files))[0],
        bundle_from_bytes(write_zip({f"beam/{k}": v for k, v in files.items()} | {"beam/README": b"x"}))[0],
        bundle_from_bytes(tar_of({f"./beam/{k}": v for k, v in files.items()}, "w:gz"))[0],
    ]
    for scene in read[1:]:
        assert_same(scene, read[0])


def test_what_is_declared_arrives(tmp_path: Path) -> None:
    scene = sound_scene()
    assert (scene.name, scene.kind, scene.fps, scene.noise_sigma_m) == ("test_beam", "beam", 30.0, 1e-3)
    assert (scene.train, scene.test) == ((0, 21), (21, 30))
    assert scene.initial_state == UNDEFORMED_AT_REST
    assert scene.points.dtype == scene.controllers.dtype == np.float64
    assert scene.visible.dtype == bool
    assert scene.body.size_m is not None
    assert scene.body.size_m.tolist() == [0.3, 0.04, 0.04]
    assert scene.body.edges is not None
    assert scene.body.edges.tolist() == [[0, 1], [1, 2]]
    assert scene.grips[0].controllers == (0, 1, 2, 3)
    assert scene.ground is not None
    assert scene.ground.friction == 0.5
    assert set(scene.extra_arrays) == {"base_markers"}


def test_a_grid_topology_becomes_a_grid_shape() -> None:
    declared, arrays = sound_parts()
    declared["body"]["topology"] = {"grid_order": "point index = i * n + j", "n": 5}
    del declared["body"]["segment_rest_lengths_m"]
    scene, _ = bundle_from_bytes(write_zip(files_of(declared, arrays)))
    assert scene.body.grid_shape == (5, 5)
    assert parts_of(scene)[0]["body"]["topology"] == declared["body"]["topology"]


def test_the_round_trip_is_exact_and_loses_nothing() -> None:
    scene = sound_scene()
    archive = canonical_archive(scene)
    again, _ = bundle_from_bytes(archive)
    assert canonical_archive(again) == archive
    for field in fields(Scene):
        if field.name != "declared":
            assert_same(getattr(again, field.name), getattr(scene, field.name))
    declared, _ = sound_parts()
    kept = again.declared
    assert kept["notes"] == declared["notes"]
    assert kept["body"]["tip_load"] == declared["body"]["tip_load"]
    assert kept["body"]["topology"] == declared["body"]["topology"]
    assert kept["body"]["mass_kg"] is None


def test_when_a_grip_is_open_survives_the_round_trip() -> None:
    declared, arrays = sound_parts()
    declared["grips"][0] = {"controllers": [0, 1, 2, 3], "open_s": [[0.2, 0.4], [0.5, 0.6]]}
    scene = scene_from_parts(declared, arrays)
    assert scene.grips[0].open_s == ((0.2, 0.4), (0.5, 0.6))
    again, _ = bundle_from_bytes(canonical_archive(scene))
    assert again.grips[0].open_s == scene.grips[0].open_s
    assert "open_s" not in parts_of(sound_scene())[0]["grips"][0]


def test_the_radius_of_a_grip_survives_the_round_trip() -> None:
    declared, arrays = sound_parts()
    declared["grips"][0] = {"controllers": [0, 1, 2, 3], "radius_m": 0.03}
    scene = scene_from_parts(declared, arrays)
    assert scene.grips[0].radius_m == 0.03 and scene.grips[0].region_min_m is None
    again, _ = bundle_from_bytes(canonical_archive(scene))
    assert again.grips[0].radius_m == 0.03
    assert "radius_m" not in parts_of(sound_scene())[0]["grips"][0]


def test_the_digest_depends_on_the_content_alone(tmp_path: Path) -> None:
    files = files_of(*sound_parts())
    wide, arrays = sound_parts()
    arrays = {name: a.astype(">f8") if a.dtype.kind == "f" else a for name, a in arrays.items()}
    arrays["base_markers"] = sound_parts()[1]["base_markers"]
    reordered = dict(reversed(list(files_of(dict(reversed(list(wide.items()))), arrays).items())))
    one = canonical_archive(bundle_from_bytes(write_zip(files))[0])
    other = canonical_archive(bundle_from_bytes(tar_of(reordered, "w:gz"))[0])
    assert one == other
    with zipfile.ZipFile(io.BytesIO(one)) as archive:
        assert archive.namelist() == ["scene.json", "scene.npz"]
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_the_sample_scene_has_the_digest_that_it_had(repository: Path) -> None:
    scene = read_bundle(repository / "sample" / "soft_beam")
    digest = hashlib.sha256(canonical_archive(scene)).hexdigest()
    text = (repository / "sample" / "soft_beam" / "scene.json").read_bytes()
    arrays = (repository / "sample" / "soft_beam" / "scene.npz").read_bytes()
    assert digest == hashlib.sha256(write_zip({"scene.json": text, "scene.npz": arrays})).hexdigest()


def test_fields_count_over_what_was_declared() -> None:
    scene = replace(sound_scene(), name="renamed", ground=None, grips=(), initial_state=AS_MEASURED)
    again, _ = bundle_from_bytes(canonical_archive(scene))
    assert (again.name, again.ground, again.grips, again.initial_state) == ("renamed", None, (), AS_MEASURED)


def test_a_written_folder_reads_back(tmp_path: Path) -> None:
    write_bundle(sound_scene(), tmp_path / "a" / "b")
    assert canonical_archive(read_bundle(tmp_path / "a" / "b")) == canonical_archive(sound_scene())


def test_doubles_that_float32_cannot_hold_stay_doubles() -> None:
    scene = sound_scene()
    scene = replace(scene, controllers=scene.controllers + 1e-12)
    again, _ = bundle_from_bytes(canonical_archive(scene))
    assert np.array_equal(again.controllers, scene.controllers)


def test_invisible_values_that_are_no_numbers_are_filled_from_the_last_seen() -> None:
    declared, arrays = sound_parts()
    arrays["points"][~arrays["visible"]] = np.nan
    scene, _ = bundle_from_bytes(write_zip(files_of(declared, arrays)))
    assert np.isfinite(scene.points).all()
    assert np.array_equal(scene.points[7, 3], scene.points[4, 3])


def test_an_extra_array_may_not_pose_as_a_field() -> None:
    scene = replace(sound_scene(), extra_arrays={"points": np.zeros(3)})
    with pytest.raises(ValueError, match="points"):
        parts_of(scene)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    noise=npst.arrays(np.float64, (6, 5, 3), elements=st.floats(-1e-3, 1e-3)),
    visible=npst.arrays(bool, (6, 5)),
    extra=npst.arrays(
        st.sampled_from([np.float32, np.float64, np.int16, np.uint8, bool]), npst.array_shapes()
    ),
    notes=st.recursive(
        st.none()
        | st.booleans()
        | st.integers()
        | st.floats(allow_nan=False, allow_infinity=False)
        | st.text(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
        max_leaves=8,
    ),
)
def test_any_scene_goes_round_exactly(
    noise: np.ndarray, visible: np.ndarray, extra: np.ndarray, notes: Any
) -> None:
    declared, arrays = sound_parts()
    visible[0] = visible[3] = visible[5] = True
    arrays = {
        "points": arrays["points"][:6, :5] + noise,
        "visible": visible,
        "controllers": arrays["controllers"][:6],
        "times": arrays["times"][:6],
        "extra": extra,
    }
    declared |= {"split": {"train": [0, 4], "test": [4, 6]}, "notes": {"any": notes}, "ground": None}
    scene, warnings = bundle_from_bytes(write_zip(files_of(declared, arrays)))
    archive = canonical_archive(scene)
    again, same_warnings = bundle_from_bytes(archive)
    assert canonical_archive(again) == archive
    assert warnings == same_warnings
    assert np.array_equal(again.points, arrays["points"])
    assert np.array_equal(again.extra_arrays["extra"], extra, equal_nan=extra.dtype.kind == "f")
    assert again.declared["notes"]["any"] == notes


def recordings(folder: Path) -> list[Path]:
    """Every scene below the shared data."""
    return sorted(path.parent for path in folder.glob("*/*/scene.json"))


def test_every_recording_at_hand_is_read_without_a_fault_or_warning(shared_data: Path) -> None:
    scenes = recordings(shared_data)
    assert len(scenes) >= 24
    for folder in scenes:
        scene = read_bundle(folder)
        assert validate(scene) == ([], []), folder
        archive = canonical_archive(scene)
        assert canonical_archive(bundle_from_bytes(archive)[0]) == archive
        with np.load(folder / "scene.npz") as stored:
            assert np.array_equal(scene.points, stored["points"].astype(float))
            assert set(parts_of(scene)[1]) == set(stored.files)


def test_missing_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(SceneInvalid, match=r"scene\.json.*scene\.npz"):
        read_bundle(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_bundle(tmp_path / "nowhere")
    with pytest.raises(SceneInvalid, match=r"no scene\.npz beside"):
        bundle_from_bytes(write_zip({"scene.json": b"{}"}))
    with pytest.raises(SceneInvalid, match=r"no scene\.json"):
        bundle_from_bytes(write_zip({"scene.npz": write_arrays({})}))
