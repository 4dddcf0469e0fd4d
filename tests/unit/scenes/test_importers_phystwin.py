"""PhysTwin's pickle: what is read, how it is turned, and what is refused."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
import tracemalloc
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physworld_scenes.bundle import write_archive
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers import ImportOptions, import_any, phystwin
from physworld_scenes.importers.array_pickle import VIEWED_BYTES, PickleRefused, load_arrays
from physworld_scenes.importers.options import median_of

FRAMES, POINTS, CONTROLLERS = 20, 40, 30


def final_data() -> dict[str, Any]:
    """A 20 cm cloud above the ground of a z-down world, lifted by 30 controllers."""
    rng = np.random.default_rng(5)
    cloud = rng.uniform(-0.1, 0.1, (POINTS, 3)) - [0.0, 0.0, 0.2]
    lift = np.linspace(0.0, 0.1, FRAMES)[:, None, None] * np.array([0.0, 0.0, -1.0])
    visibilities = rng.random((FRAMES, POINTS)) < 0.9
    visibilities[0] = True
    points = np.where(visibilities[..., None], cloud + lift + rng.normal(0, 1e-3, (FRAMES, POINTS, 3)), 0.0)
    valid = rng.random((FRAMES, POINTS)) < 0.95
    return {
        "object_points": points.astype(np.float32),
        "object_colors": rng.random((FRAMES, POINTS, 3)).astype(np.float32),
        "object_visibilities": visibilities,
        "object_motions_valid": valid,
        "controller_points": (rng.uniform(-0.1, 0.1, (CONTROLLERS, 3)) - [0, 0, 0.3] + lift).astype(
            np.float32
        ),
        "surface_points": rng.uniform(-0.1, 0.1, (50, 3)) - [0.0, 0.0, 0.2],
        "interior_points": rng.uniform(-0.1, 0.1, (60, 3)) - [0.0, 0.0, 0.2],
    }


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_the_scene_is_turned_to_z_up(protocol: int) -> None:
    data = final_data()
    scene, _ = import_any(pickle.dumps(data, protocol=protocol), "double_lift.pkl")
    assert scene.name == "double_lift"
    assert scene.kind == "toy"
    turned = data["object_points"].astype(float) * [1, -1, -1]
    assert np.array_equal(scene.points, turned)
    assert np.array_equal(scene.controllers, data["controller_points"].astype(float) * [1, -1, -1])
    assert (scene.points[scene.visible][:, 2] > 0).all()
    assert scene.ground is not None
    assert scene.ground.height_m == 0.0
    assert (scene.train, scene.test) == ((0, 14), (14, 20))
    assert scene.fps == 30.0
    assert scene.times[1] == pytest.approx(1 / 30)
    assert np.array_equal(scene.colors, data["object_colors"])


def test_handedness_is_kept() -> None:
    axes = phystwin._turn(np.eye(3))
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_visible_needs_sight_and_a_trusted_motion_into_the_frame() -> None:
    data = final_data()
    data["object_visibilities"][:] = True
    data["object_motions_valid"][:] = True
    data["object_motions_valid"][6, 3] = False
    scene = phystwin.read(pickle.dumps(data))
    assert np.argwhere(~scene.visible).tolist() == [[7, 3]]


def test_structure_points_keep_one_a_cell_and_fill_the_body() -> None:
    near = np.array([[0.001, 0.001, 0.001], [0.004, 0.004, 0.004], [0.006, 0.001, 0.001]])
    assert phystwin.structure_points(near, near + 1e-4).tolist() == [near[0].tolist(), near[2].tolist()]
    scene = phystwin.read(pickle.dumps(final_data()))
    assert scene.rest_volume_points is not None
    assert 120 < len(scene.rest_volume_points) <= 150
    assert scene.surface_points is not None
    assert scene.surface_points.shape == (50, 3)


def test_options_give_what_the_file_does_not_say() -> None:
    options = ImportOptions(name="cloth", kind="sheet", fps=15.0, noise_sigma_m=2e-3, body={"side_m": 0.2})
    scene = phystwin.read(pickle.dumps(final_data()), options)
    assert (scene.name, scene.kind, scene.fps, scene.noise_sigma_m) == ("cloth", "sheet", 15.0, 2e-3)
    assert scene.body.side_m == 0.2
    assert scene.times[-1] == pytest.approx(19 / 15)


def test_the_noise_is_estimated_from_third_differences() -> None:
    data = final_data()
    scene = phystwin.read(pickle.dumps(data))
    assert scene.noise_sigma_m == pytest.approx(1e-3, rel=0.15)  # 1500 samples of noise of 1 mm


class Caller:
    """Pickles to a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize(
    ("function", "arguments", "name"),
    [
        (os.system, ("touch /tmp/never",), "system"),
        (eval, ("1+1",), "builtins.eval"),
        (subprocess.Popen, (["true"],), "subprocess.Popen"),
        (getattr, ("a", "b"), "builtins.getattr"),
        (np.load, ("x.npy",), "numpy.load"),
        (np.frombuffer, (b"abcd",), "numpy.frombuffer"),
    ],
)
def test_a_pickle_that_calls_something_is_refused_by_that_name(
    function: Any, arguments: tuple[Any, ...], name: str
) -> None:
    data = final_data() | {"object_colors": Caller(function, *arguments)}
    with pytest.raises(SceneInvalid, match=name) as caught:
        import_any(pickle.dumps(data), "final_data.pkl")
    assert caught.value.faults[0].loc == ["final_data.pkl"]


def test_a_pickle_without_protocol_mark_is_refused_too() -> None:
    with pytest.raises(SceneInvalid, match=r"wants os\.system"):
        import_any(b"cos\nsystem\n(S'true'\ntR.", "final_data.pkl")


@pytest.mark.parametrize(
    "forged",
    [
        b"\x80\x04r\xff\xff\xff\xff.",  # memo index of 4 billion
        b"\x80\x04B\xff\xff\xff\x7fab.",  # 2 GB of bytes claimed
        b"\x80\x04\x82\x01.",  # extension registry
        b"\x80\x04P1\n.",  # object outside the file
        b"\x80\x04" + b"(" * 1000 + b".",
        b"\x80\x04]" + b"]" * 100 + b"a" * 100 + b".",  # deep nesting
        b"\x80\x04K\x01K\x02b.",  # state for a number
        b"\x80\x04",
        b"\x80\x09.",
    ],
)
def test_forged_streams_are_refused(forged: bytes) -> None:
    with pytest.raises(PickleRefused):
        load_arrays(forged)


@pytest.mark.parametrize(
    "value",
    [
        np.array([{"a": 1}], dtype=object),
        np.zeros(3, dtype=[("a", "f4")]),
        np.array(["2020-01-01"], dtype="M8[D]"),
        {1, 2},
        1 + 2j,
        pytest,
    ],
    ids=["objects", "structured", "dates", "set", "complex", "module"],
)
def test_only_arrays_of_numbers_are_read(value: Any) -> None:
    try:
        data = pickle.dumps({"a": value})
    except TypeError:
        data = b"\x80\x04cpytest\nraises\n."
    with pytest.raises(PickleRefused):
        load_arrays(data)


def test_an_array_that_claims_more_than_it_holds_is_refused() -> None:
    honest = pickle.dumps(np.arange(5, dtype="<i8"), protocol=4)
    at = honest.index(b"K\x05")
    with pytest.raises(PickleRefused, match=r"claims shape \(9,\)"):
        load_arrays(honest[:at] + b"K\x09" + honest[at + 2 :])


def test_every_array_kind_comes_through() -> None:
    values = {
        "f": np.asfortranarray(np.random.default_rng(0).normal(size=(3, 4))),
        "big": np.arange(4, dtype=">i4"),
        "bool": np.array([True, False]),
        "scalar": np.float64(2.5),
        "empty": np.zeros((0, 3), np.float32),
        "list": [1, "a", (2.0, None)],
    }
    for protocol in (3, 4, 5):
        loaded = load_arrays(pickle.dumps(values, protocol=protocol))
        for name in ("f", "big", "bool", "empty", "scalar"):
            assert np.array_equal(loaded[name], values[name])
        assert loaded["list"] == [1, "a", [2.0, None]]


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_large_arrays_are_views_of_the_file_that_nobody_can_write_to(protocol: int) -> None:
    large = np.random.default_rng(0).normal(size=(VIEWED_BYTES // 8, 2))
    values = {"a": large, "again": large, "bytes": bytes(VIEWED_BYTES), "turned": np.asfortranarray(large)}
    data = pickle.dumps(values, protocol=protocol)
    loaded = load_arrays(data)
    for name in ("a", "again", "turned"):
        assert np.array_equal(loaded[name], values[name]) and not loaded[name].flags.writeable
    assert loaded["bytes"] == values["bytes"]
    if protocol < 5:  # there arrays are bytearrays
        assert np.shares_memory(loaded["a"], np.frombuffer(data, dtype=np.uint8))
    for cut in (len(data) // 5, len(data) // 2, len(data) - 1):
        with pytest.raises(PickleRefused):
            load_arrays(data[:cut])


def test_an_import_holds_less_than_four_times_its_points() -> None:
    """Beside the file: once in the scene, once checked, and what the checks note of every point and frame."""
    frames, points = 100, 12_000
    data = final_data()
    cloud = np.random.default_rng(0).uniform(-0.1, 0.1, (points, 3)) - [0.0, 0.0, 0.2]
    lift = np.linspace(0.0, 0.1, frames)[:, None, None] * np.array([0.0, 0.0, -1.0])
    places = cloud + lift
    data |= {"object_points": places, "object_colors": np.zeros((frames, points, 3))}
    data |= {
        name: np.ones((frames, points), bool) for name in ("object_visibilities", "object_motions_valid")
    }
    data["controller_points"] = places[:, :CONTROLLERS]
    packed = pickle.dumps(data, protocol=4)
    size = places.nbytes
    del data, places
    tracemalloc.start()
    try:
        scene, _ = import_any(packed, "large.pkl")
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        with tempfile.TemporaryFile() as stream:
            write_archive(scene, stream)
        _, written = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert scene.points.nbytes == size
    assert peak < 4.0 * size and written < 4.0 * size, (peak / size, written / size)


@pytest.mark.parametrize("count", [1, 2, 3, 1000, 1001])
def test_the_median_in_blocks_is_that_of_all_at_once(count: int) -> None:
    rng = np.random.default_rng(count)
    spread = np.abs(rng.normal(size=count)) * 10.0 ** rng.integers(-12, 3, count)
    for numbers in (
        spread,
        np.round(spread, 2),
        np.zeros(count),
        np.where(rng.random(count) < 0.5, 0, spread),
    ):
        blocks = np.array_split(numbers, 7)
        assert median_of(lambda blocks=blocks: iter(blocks)) == np.median(numbers)
    assert median_of(lambda: iter([])) is None
    assert np.isnan(median_of(lambda: iter([np.array([1.0, np.nan])])) or 0.0)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_pickles_raise_nothing_else(data: st.DataObject) -> None:
    honest = bytearray(pickle.dumps({"a": np.arange(6.0).reshape(2, 3), "b": [1, "x"]}, protocol=4))
    for _ in range(data.draw(st.integers(1, 4))):
        honest[data.draw(st.integers(0, len(honest) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(1, len(honest)))
    with suppress(PickleRefused):
        load_arrays(bytes(honest[:cut]))


def test_missing_and_misshaped_arrays_are_all_named() -> None:
    data = final_data()
    del data["surface_points"]
    data["object_visibilities"] = data["object_visibilities"][:, :-1]
    with pytest.raises(SceneInvalid) as caught:
        phystwin.read(pickle.dumps(data))
    text = str(caught.value)
    assert "has no surface_points" in text
    assert "object_visibilities has shape (20, 39): N is 39 here, 40 before" in text


def test_millimetres_are_named() -> None:
    data = final_data()
    for key in ("object_points", "controller_points", "surface_points", "interior_points"):
        data[key] = data[key] * 1000.0
    with pytest.raises(SceneInvalid, match=r"millimetres: multiply by 0\.001"):
        phystwin.read(pickle.dumps(data))


def test_reading_runs_no_foreign_code_in_a_fresh_interpreter(tmp_path: Any) -> None:
    flag = tmp_path / "flag"
    forged = tmp_path / "final_data.pkl"
    forged.write_bytes(pickle.dumps(Caller(os.system, f"touch {flag}")))
    code = (
        "import sys; from physworld_scenes.importers import phystwin\n"
        "from physworld_scenes.errors import SceneInvalid\n"
        "try: phystwin.read(sys.argv[1])\n"
        "except SceneInvalid as error: print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(forged)], capture_output=True, text=True, check=True
    )
    assert "system" in done.stdout
    assert not flag.exists()
