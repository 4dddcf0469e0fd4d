"""Every fault is named with its numbers, and all of them at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scene_parts import POINTS, SIGMA, sound_parts

from physworld_scenes.declaration import parse_json
from physworld_scenes.validation import check_scene

Parts = tuple[dict[str, Any], dict[str, np.ndarray]]
Break = Callable[[dict[str, Any], dict[str, np.ndarray]], object]


def broken(change: Break) -> Parts:
    """The sound scene after ``change``."""
    declared, arrays = sound_parts()
    change(declared, arrays)
    return declared, arrays


def set_body(**facts: Any) -> Break:
    """Changes the body."""
    return lambda d, a: d["body"].update(facts)


def declare(**facts: Any) -> Break:
    """Changes the declaration."""
    return lambda d, a: d.update(facts)


def scale(*names: str, by: float) -> Break:
    """Multiplies arrays."""
    return lambda d, a: a.update({name: a[name] * by for name in names})


def put(name: str, at: Any, value: Any) -> Break:
    """Writes into an array."""
    return lambda d, a: a[name].__setitem__(at, value)


def replace_array(name: str, make: Callable[[np.ndarray], np.ndarray]) -> Break:
    """Replaces an array."""
    return lambda d, a: a.update({name: make(a[name])})


def grip(**facts: Any) -> Break:
    """Changes the grip."""
    return lambda d, a: d["grips"][0].update(facts)


@pytest.mark.parametrize("name", ["points", "controllers", "rest_volume_points"])
@pytest.mark.parametrize("far", [1e300, -2e300, 1001.0])
def test_a_place_that_is_absurdly_far_is_the_one_fault_with_its_number_and_the_limit(
    name: str, far: float
) -> None:
    declared, arrays = sound_parts()
    at = (3, 0, 1)[-arrays[name].ndim :]
    arrays[name] = arrays[name].astype(np.float64)
    arrays[name][at] = far
    if name == "points":
        arrays["visible"][3, 0] = True
    faults, _ = check_scene(declared, arrays)
    (fault,) = faults
    assert fault.loc == ["scene.npz", name]
    assert f"1 of {arrays[name].size} values are farther than 1000 m from the origin" in fault.msg
    assert f"the farthest {abs(far):.4g} m at {at}" in fault.msg


def test_a_place_that_is_not_visible_may_be_anywhere() -> None:
    declared, arrays = sound_parts()
    arrays["visible"][3, 0] = False
    arrays["points"] = arrays["points"].astype(np.float64)
    arrays["points"][3, 0] = 1e300
    assert check_scene(declared, arrays)[0] == []


def test_a_sound_scene_has_neither_fault_nor_warning() -> None:
    assert check_scene(*sound_parts()) == ([], [])


FAULTS: list[tuple[str, Break, str, str]] = [
    ("a word for a flag", set_body(self_contact="no"), "self_contact", "boolean"),
    ("a torsion below zero", set_body(torsion_ratio=-1.0), "torsion_ratio", "greater than or equal to 0"),
    ("a load without a mass", set_body(tip_load={"where": "x = 0"}), "mass_kg", "is missing"),
    ("a load in grams", set_body(tip_load={"mass_kg": "52 g"}), "mass_kg", "number"),
    ("a friction below zero", set_body(self_friction=-0.1), "self_friction", "greater than or equal to 0"),
    (
        "millimetres",
        scale("points", "controllers", "rest_volume_points", by=1000.0),
        "points",
        "millimetres: multiply by 0.001",
    ),
    (
        "centimetres",
        scale("points", "controllers", "rest_volume_points", by=100.0),
        "points",
        "centimetres: multiply by 0.01",
    ),
    (
        "kilometres",
        scale("points", "controllers", "rest_volume_points", by=1e-3),
        "points",
        "multiply by 1000",
    ),
    ("small centimetres", scale("points", "controllers", by=10.0), "size_m", "differ by 10?"),
    ("nan", put("points", (7, 2, 1), np.nan), "points", "frame 7 point 2"),
    (
        "inf controllers",
        put("controllers", (3, 1, 0), np.inf),
        "controllers",
        "1 of 360 values are not finite, first inf at (3, 1, 0)",
    ),
    ("nan times", put("times", 4, np.nan), "times", "first nan at (4,)"),
    (
        "frames disagree",
        replace_array("controllers", lambda x: x[:-1]),
        "controllers",
        "T is 29 here and 30 in points",
    ),
    (
        "points disagree",
        replace_array("visible", lambda x: x[:, 1:]),
        "visible",
        "N is 24 here and 25 in points",
    ),
    ("two dimensions", replace_array("points", lambda x: x[..., :2]), "points", "(30, 25, 2), not (T, N, 3)"),
    ("flat", replace_array("points", lambda x: x[0]), "points", "(25, 3)"),
    (
        "one frame",
        lambda d, a: a.update({k: v[:1] for k, v in a.items() if k != "rest_volume_points"}),
        "points",
        "1 frames",
    ),
    (
        "no point",
        lambda d, a: a.update(points=a["points"][:, :0], visible=a["visible"][:, :0]),
        "points",
        "no point",
    ),
    ("no array", lambda d, a: a.pop("controllers"), "controllers", "is missing"),
    ("words", replace_array("visible", lambda x: x.astype(float) + 0.5), "visible", "other than 0 and 1"),
    ("repeats", put("times", 9, 8 / 30.0), "times", "repeats in 1 of 29 steps, first at frame 9"),
    (
        "back",
        put("times", 9, 0.1),
        "times",
        "goes back in 1 of 29 steps, first at frame 9: 0.1 s after 0.266667 s",
    ),
    ("milliseconds", scale("times", by=1000.0), "times", "milliseconds: divide by 1000"),
    ("wrong rate", declare(fps=60.0), "times", "30 frames/s, declared are 60"),
    ("late", replace_array("times", lambda x: x + 2.0), "times", "begins at 2 s"),
    (
        "all invisible",
        put("visible", slice(None), False),
        "visible",
        "all 25 points are invisible in all 30 frames",
    ),
    ("start invisible", put("visible", 0, False), "visible", "invisible in frame 0"),
    (
        "jump",
        put("points", (12, 6), [9.0, 0.0, 0.5]),
        "points",
        "faster than 50 m/s, first point 6 into frame 12",
    ),
    (
        "controllers far",
        replace_array("controllers", lambda x: x + np.float32(2.0)),
        "controllers",
        "of its sizes",
    ),
    ("controllers jump", put("controllers", (12, 2), [9.0, 0.0, 0.5]), "controllers", "faster than 50 m/s"),
    (
        "split outside",
        declare(split={"train": [0, 21], "test": [21, 40]}),
        "test",
        "[21, 40) reaches outside the 30 frames",
    ),
    ("split empty", declare(split={"train": [0, 21], "test": [21, 21]}), "test", "[21, 21) is empty"),
    ("split overlap", declare(split={"train": [0, 24], "test": [21, 30]}), "split", "share 3 frames"),
    ("test invisible", put("visible", slice(21, None), False), "test", "nothing is visible"),
    ("gravity mm", declare(gravity_m_s2=[0, 0, -9810]), "gravity_m_s2", "mm/s2: divide by 1000"),
    ("gravity g", declare(gravity_m_s2=[0, 0, -1.0]), "gravity_m_s2", "g: multiply by 9.80665"),
    ("gravity up", declare(gravity_m_s2=[0, 0, 9.81]), "gravity_m_s2", "points up, 180.0 degrees"),
    ("noise zero", declare(noise_sigma_m=0.0), "noise_sigma_m", "is 0 m"),
    ("noise negative", declare(noise_sigma_m=-0.001), "noise_sigma_m", "is -0.001 m"),
    ("noise large", declare(noise_sigma_m=1.0), "noise_sigma_m", "more than the object's size"),
    ("grip controllers", grip(controllers=[0, 1, 7]), "controllers", "names [7], there are 4"),
    ("grip points", grip(points=[0, 99]), "points", "names [99], there are 25"),
    (
        "grip empty",
        grip(region_min_m=[0.5, 0, 0.5], region_max_m=[0.6, 0.04, 0.54]),
        "region_min_m",
        "none of the 200 volume points",
    ),
    ("grip inverted", grip(region_min_m=[0.1, 0, 0.5]), "region_min_m", "in x"),
    ("grip half", grip(region_max_m=None), "region_min_m", "together"),
    ("grip open too often", grip(open_s=[[k, k + 0.5] for k in range(1001)]), "open_s", "at most 1000"),
    ("grip open backwards", grip(open_s=[[0.2, 0.1]]), "open_s", "0.2 to 0.1 s"),
    ("grip open twice at once", grip(open_s=[[0.0, 0.2], [0.1, 0.3]]), "open_s", "0.1 to 0.3 s after 0.2 s"),
    ("grip by both", grip(radius_m=0.03), "radius_m", "not both"),
    ("grip by nothing", grip(radius_m=0.0), "radius_m", "greater than 0"),
    (
        "grip out of reach",
        lambda d, a: (
            grip(radius_m=0.001, region_min_m=None, region_max_m=None)(d, a),
            set_body(box_min_m=[0.0, 0.0, 5.0], box_max_m=[0.3, 0.04, 5.04])(d, a),
        ),
        "radius_m",
        "the nearest place in the declared body's box",
    ),
    (
        "two owners",
        lambda d, a: d["grips"].append({"controllers": [3]}),
        "controllers",
        "controller 3, which grip 0 holds",
    ),
    ("ground above", declare(ground={"height_m": 0.6}), "height_m", "below it in frame 0"),
    ("density", set_body(density_kg_m3=1.2), "density_kg_m3", "g/cm3: multiply by 1000"),
    ("heavy density", set_body(density_kg_m3=1e6), "density_kg_m3", "outside"),
    ("mass", set_body(mass_kg=5000.0), "mass_kg", "5000 kg"),
    ("declared size", set_body(size_m=[300, 40, 40]), "size_m", "differ by 1000?"),
    ("box", set_body(box_min_m=[0, 0, 0], box_max_m=[1, 1, 1]), "size_m", "the box measures"),
    ("edges", set_body(topology={"edges": [[0, 25]]}, segment_rest_lengths_m=[0.1]), "edges", "[[0, 25]]"),
    (
        "segments",
        set_body(segment_rest_lengths_m=[0.1]),
        "segment_rest_lengths_m",
        "has 1 entries for 2 segments",
    ),
    (
        "grid",
        set_body(topology={"n": 4}, segment_rest_lengths_m=None),
        "n",
        "a grid of 16 points; there are 25",
    ),
    ("kind", declare(kind="jelly"), "kind", "'jelly'"),
    ("version", declare(schema_version=2), "schema_version", "2"),
    ("no name", lambda d, a: d.pop("name"), "name", "is missing"),
    ("name with a path", declare(name="../x"), "name", "'../x'"),
    ("state", declare(initial_state="sleeping"), "initial_state", "'sleeping'"),
    ("negative size", set_body(size_m=[-0.3, 0.04, 0.04]), "0", "-0.3"),
    ("friction", declare(ground={"height_m": 0.0, "friction": -1.0}), "friction", "-1.0"),
    ("nan in the notes", lambda d, a: d["notes"].update(deep=[1, float("nan")]), "1", "is nan, which JSON"),
    ("nan declared", declare(fps=float("nan")), "fps", "is nan, which JSON"),
    (
        "colours",
        lambda d, a: a.update(colors=np.zeros((24, 3))),
        "colors",
        "(24, 3), neither (30, 25, 3) nor (25, 3)",
    ),
    (
        "features",
        lambda d, a: a.update(part_features=np.zeros((7, 2))),
        "part_features",
        "for 25 or 200 points",
    ),
    ("words kept", lambda d, a: a.update(labels=np.array(["a"])), "labels", "holds <U1"),
    (
        "clock without samples",
        lambda d, a: a.update(ctrl_times=np.zeros(0), ctrl_points=a["controllers"][:0]),
        "ctrl_times",
        "is empty",
    ),
    (
        "size of next to nothing",
        set_body(size_m=[1e-308, 1e-308, 1e-308], mass_kg=0.5),
        "size_m",
        "declares 1.732e-308 m",
    ),
    ("clock alone", lambda d, a: a.update(ctrl_times=np.arange(5.0)), "ctrl_times", "together"),
    (
        "short clock",
        lambda d, a: a.update(
            ctrl_times=np.linspace(0, 0.5, 6), ctrl_points=np.repeat(a["controllers"][:1], 6, axis=0)
        ),
        "ctrl_times",
        "covers 0 to 0.5 s, the recording 0 to 0.9667 s",
    ),
]


def with_covariances(by: float, **facts: Any) -> Break:
    """Covariances of the declared deviation, their third axis ``by`` times as wide in variance."""

    def change(declared: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        arrays["noise_covariance"] = np.tile(np.diag([1.0, 1.0, by]) * SIGMA**2, (POINTS, 1, 1))
        declared.update(facts)

    return change


def test_covariances_that_agree_with_the_deviation_are_sound() -> None:
    assert check_scene(*broken(with_covariances(1.0)))[0] == []
    assert check_scene(*broken(with_covariances(30.0, noise_sigma_m=None)))[0] == []


COVARIANCES: list[tuple[str, Break, str, str]] = [
    ("of other points", lambda d, a: a.update(noise_covariance=np.ones((3, 3, 3))), "noise_covariance", "N is 3"),
    ("as deviations", lambda d, a: a.update(noise_covariance=np.ones((POINTS, 3))), "noise_covariance", "shape"),
    ("not symmetric", lambda d, a: a.update(noise_covariance=np.tile(np.triu(np.ones((3, 3))), (POINTS, 1, 1))),
     "noise_covariance", "not symmetric at 25 of 25"),
    ("not positive", with_covariances(-1.0), "noise_covariance", "not positive definite"),
    ("flat", with_covariances(1e-9), "noise_covariance", "1e+06 times"),
    ("not finite", with_covariances(float("nan")), "noise_covariance", "not finite"),
    ("at odds with the deviation", with_covariances(30.0), "noise_sigma_m", "has 0.003266 m per axis"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "where", "says"), [c[1:] for c in COVARIANCES], ids=[c[0] for c in COVARIANCES]
)
def test_covariances_that_cannot_be_are_named(change: Break, where: str, says: str) -> None:
    faults, _ = check_scene(*broken(change))
    assert any(says in fault.msg for fault in faults if str(fault.loc[-1]) == where), faults


@pytest.mark.parametrize(("change", "where", "says"), [f[1:] for f in FAULTS], ids=[f[0] for f in FAULTS])
def test_a_fault_is_named_with_its_numbers(change: Break, where: str, says: str) -> None:
    faults, _ = check_scene(*broken(change))
    named = [fault for fault in faults if str(fault.loc[-1]) == where]
    assert any(says in fault.msg for fault in named), faults


WARNINGS: list[tuple[str, Break, str]] = [
    (
        "short reach",
        grip(radius_m=1e-4, region_min_m=None, region_max_m=None),
        "is 0.0001 m, the nearest visible point is",
    ),
    ("open late", grip(open_s=[[50.0, 60.0]]), "begins at 50 s, after the last frame"),
    ("tilted gravity", declare(gravity_m_s2=[0.5, 0, -9.8]), "2.9 degrees away from -z"),
    ("no gravity", declare(gravity_m_s2=[0, 0, 0]), "nothing falls"),
    ("moon", declare(gravity_m_s2=[0, 0, -1.62]), "1.62"),
    ("no noise", declare(noise_sigma_m=None), "not declared"),
    ("much noise", declare(noise_sigma_m=0.05), "16% of the object"),
    ("never seen", put("visible", (slice(None), 4), False), "1 of 25 points are never visible: 4"),
    ("blind frame", put("visible", 13, False), "nothing is visible in 1 of 30 frames: 13"),
    (
        "zeros",
        lambda d, a: a["visible"].__setitem__(slice(None), True),
        "4 visible values are exactly (0, 0, 0), first in frame 5 point 3",
    ),
    (
        "uneven",
        replace_array("times", lambda x: np.where(np.arange(30) > 25, x + 0.2, x)),
        "frame 26 comes 0.2333 s",
    ),
    ("other rate", declare(fps=34.0), "declared are 34"),
    ("large", scale("points", "controllers", "rest_volume_points", by=30.0), "not metres?"),
    ("light", set_body(density_kg_m3=7.0), "7 kg/m3"),
    ("mass of another body", set_body(mass_kg=9.0), "weighs 0.48 kg"),
    ("smaller than declared", set_body(size_m=[0.6, 0.08, 0.08]), "declares"),
    (
        "no controllers",
        lambda d, a: (a.update(controllers=a["controllers"][:, :0]), d.update(grips=None)),
        "nothing drives",
    ),
    ("late training", declare(split={"train": [2, 21], "test": [21, 30]}), "starts at frame 2"),
]


@pytest.mark.parametrize(("change", "says"), [w[1:] for w in WARNINGS], ids=[w[0] for w in WARNINGS])
def test_a_warning_is_given(change: Break, says: str) -> None:
    _, warnings = check_scene(*broken(change))
    assert any(says in warning for warning in warnings), warnings


def test_all_faults_come_at_once() -> None:
    declared, arrays = sound_parts()
    declared |= {"kind": "jelly", "fps": -1.0}
    arrays["points"][3, 3] = np.nan
    arrays["visible"][3, 3] = True
    arrays["controllers"] = arrays["controllers"][:-2]
    arrays["times"][5] = 0.0
    faults, _ = check_scene(declared, arrays)
    assert {str(fault.loc[-1]) for fault in faults} >= {"kind", "fps", "controllers"}
    declared, arrays = sound_parts()
    declared |= {"split": {"train": [0, 99], "test": [98, 120]}, "noise_sigma_m": 0.0}
    declared["grips"][0]["points"] = [77]
    arrays["points"][3, 1] = np.inf
    arrays["times"][5] = 0.0
    faults, _ = check_scene(declared, arrays)
    assert {str(fault.loc[-1]) for fault in faults} >= {"train", "test", "noise_sigma_m", "points", "times"}


def test_invisible_zeros_and_nan_are_no_fault() -> None:
    declared, arrays = sound_parts()
    arrays["points"][5:9, 3] = np.nan
    assert check_scene(declared, arrays) == ([], [])


def test_controllers_that_are_tracked_points_are_near() -> None:
    declared, arrays = sound_parts()
    arrays["controllers"] = arrays["points"][:, :4].copy()
    arrays["controllers"][5:9, 3] = arrays["controllers"][4, 3]
    assert check_scene(declared, arrays)[0] == []


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"{", "is not JSON"),
        (b"[]", "holds a list"),
        (b"\xff\xfe", "not UTF-8"),
        (b"[" * 100_000, "cannot be read"),
        (b'{"a":' * 80 + b"1" + b"}" * 80, "nests deeper"),
        (b'{"a": ' + b"1" * 5000 + b"}", "cannot be read"),
    ],
)
def test_a_json_that_is_none_is_named(text: bytes, says: str) -> None:
    _, faults = parse_json(text)
    assert says in faults[0].msg
