"""What an import of markers guesses, what it drops and says so, and what it asks for."""

from __future__ import annotations

import dataclasses
from typing import Any

import marker_files as files
import numpy as np
import pytest

from physworld.scene import Scene
from physworld_scenes.errors import SceneInvalid
from physworld_scenes.importers import ImportOptions, import_any, look_at
from physworld_scenes.importers.tables.belonging import rigid_groups
from physworld_scenes.importers.tables.guesses import noise
from physworld_scenes.importers.tables.swaps import swapped

pytestmark = pytest.mark.slow

MOTION = files.made()
SHEET: dict[str, Any] = {"mass_kg": 0.08, "thickness_m": 1e-3}


def named(places: np.ndarray, labels: list[str], times: np.ndarray = MOTION.times) -> bytes:
    """Plain columns in metres, z up."""
    rows = [",".join(["time", *(f"{label}_{axis}" for label in labels for axis in "xyz")])]
    for t, frame in enumerate(places):
        cells = [f"{times[t]:.6f}", *("" if not np.isfinite(v) else f"{v:.7f}" for v in frame.ravel())]
        rows.append(",".join(cells))
    return "\n".join(rows).encode()


def guessed(data: bytes, **options: Any) -> dict[str, tuple[str, str]]:
    rows = look_at(data, "a.csv", ImportOptions(**options))[1].guesses
    return {what: (value, how) for what, value, how, _ in rows}


def imported(data: bytes, **options: Any) -> tuple[Scene, list[str]]:
    return import_any(data, "a.csv", ImportOptions(kind="sheet", body=SHEET, assume=False, **options))


def test_markers_that_keep_their_distances_while_others_do_not_are_the_gripper() -> None:
    labels, tracks = MOTION.tracks("a{}", "b{}")
    scene, _ = imported(named(tracks, labels))
    assert scene.declared["notes"]["controller_labels"] == ["a1", "a2", "a3", "a4"]
    assert np.abs(scene.controllers - MOTION.gripper).max() < 1e-6


def test_two_rigid_groups_that_move_have_to_be_told_apart() -> None:
    labels, tracks = MOTION.tracks("a{}", "b{}")
    second = MOTION.gripper[::-1] + np.array([1.0, 0.0, 0.0])
    both = np.concatenate([tracks, second], axis=1)
    labels = [*labels, "c1", "c2", "c3", "c4"]
    with pytest.raises(
        SceneInvalid, match=r"2 groups keep their distances \(a1, a2, a3, a4; c1, c2, c3, c4\)"
    ):
        imported(named(both, labels))
    scene, _ = imported(named(both, labels), controllers=("a*", "c*"))
    assert scene.controllers.shape[1] == 8 and scene.points.shape[1] == 16


def test_a_body_that_is_all_there_is_asks_for_its_gripper() -> None:
    with pytest.raises(SceneInvalid, match=r"--gripper NAMES, or none.*its markers are b1, b2"):
        imported(named(MOTION.points, [f"b{i + 1}" for i in range(16)]))
    scene, warnings = imported(named(MOTION.points, [f"b{i + 1}" for i in range(16)]), controllers=("none",))
    assert scene.controllers.shape[1] == 0
    assert any("controllers" in warning for warning in warnings)


def test_groups_of_a_noisy_recording_with_gaps_are_found() -> None:
    rng = np.random.default_rng(1)
    tracks = np.concatenate([MOTION.points, MOTION.gripper], axis=1)
    tracks = tracks + 3e-4 * rng.standard_normal(tracks.shape)
    seen = rng.random(tracks.shape[:2]) > 0.1
    assert rigid_groups(tracks, seen) == [[16, 17, 18, 19]]


def test_a_marker_may_be_the_grippers_and_the_bodys() -> None:
    """The gripped end of a rope: its markers drive, and are points of the rope."""
    labels, tracks = MOTION.tracks("a{}", "b{}")
    scene, _ = imported(named(tracks, labels), controllers=("a1", "a2"), markers=("a*", "b*"))
    assert scene.points.shape[1] == 20 and scene.controllers.shape[1] == 2
    assert np.array_equal(scene.points[:, :2], scene.controllers)


def test_names_that_there_are_not_are_said_with_those_that_there_are() -> None:
    labels, tracks = MOTION.tracks("a{}", "b{}")
    with pytest.raises(
        SceneInvalid, match=r"no marker thumb for the gripper; its markers are a1, a2.*\(20 in all\)"
    ):
        imported(named(tracks, labels), controllers=("thumb",))


def test_labels_that_change_hands_are_dropped_while_they_do_and_it_is_said() -> None:
    labels, tracks = MOTION.tracks("grip{}", "m{}")
    bent = tracks.copy()
    bent[40:55, [5, 11]] = tracks[40:55, [11, 5]]
    scene, _ = imported(named(bent, labels))
    wrong = np.zeros((120, 16), dtype=bool)
    wrong[40:55, [1, 7]] = True
    assert np.array_equal(scene.visible, ~wrong)
    assert np.abs(scene.points - MOTION.points)[~wrong].max() < 1e-6
    assert scene.declared["notes"]["left_out"] == [
        "15 samples of m2 are dropped, frames 40 to 54: its label is on another marker",
        "15 samples of m8 are dropped, frames 40 to 54: its label is on another marker",
    ]


def test_labels_that_never_come_back_are_dropped_altogether() -> None:
    labels, tracks = MOTION.tracks("grip{}", "m{}")
    bent = tracks.copy()
    bent[30:, [5, 11]] = tracks[30:, [11, 5]]
    scene, _ = imported(named(bent, labels))
    assert scene.points.shape[1] == 14
    assert scene.declared["notes"]["left_out"] == [
        "2 markers are dropped, whose labels are on others most of the time: m2, m8"
    ]


@pytest.mark.parametrize("noise_m", [0.0, 2e-4, 1e-3])
def test_no_label_changes_hands_in_a_sound_recording(noise_m: float) -> None:
    motion = files.made(frames=400, noise_m=noise_m, side=6)
    _, tracks = motion.tracks()
    seen = np.random.default_rng(3).random(tracks.shape[:2]) > 0.05
    assert not swapped(tracks, seen, np.full(tracks.shape[1], noise_m)).any()


def test_a_marker_that_is_never_seen_is_dropped_and_the_first_blind_frames_are_left_out() -> None:
    labels, tracks = MOTION.tracks("grip{}", "m{}")
    bent = tracks.copy()
    bent[:, 6] = np.nan
    bent[:5, 4:] = np.nan
    scene, _ = imported(named(bent, labels))
    assert scene.points.shape == (115, 15, 3)
    assert scene.times[0] == 0.0
    assert scene.declared["notes"]["left_out"] == [
        "1 markers are never seen and dropped: m3",
        "the first 5 frames are left out: no marker on the body is seen in them",
    ]


def test_unlabelled_markers_alone_can_be_kept_by_name() -> None:
    labels, tracks = MOTION.tracks("grip{}", "Unlabeled {}")
    with pytest.raises(SceneInvalid, match="no marker is left on the body"):
        imported(named(tracks, labels))
    scene, _ = imported(named(tracks, labels), markers=("Unlabeled*",))
    assert scene.points.shape[1] == 16


def test_noise_comes_from_frames_at_rest_where_there_are_some() -> None:
    rng = np.random.default_rng(5)
    rest = np.repeat(MOTION.points[:1], 60, axis=0)
    moving = np.concatenate([rest, MOTION.points]) + 4e-4 * rng.standard_normal((180, 16, 3))
    sigma, how = noise(moving, np.ones((180, 16), dtype=bool))
    assert sigma == pytest.approx(4e-4, rel=0.1)
    assert how.startswith("25 frames at rest, ")
    _, how = noise(MOTION.points, np.ones((120, 16), dtype=bool))
    assert how == "upper estimate from third differences"


@pytest.mark.parametrize(
    ("metres", "unit"),
    [("0.2", "mm"), ("1", "m"), ("1", "cm"), ("1", "mm"), ("3", "m"), ("3", "mm")],
)
def test_units_of_objects_of_other_sizes(metres: str, unit: str) -> None:
    """A cloth of half a metre, one that is three times as large, and one of ten centimetres in millimetres."""
    size = float(metres)
    labels, tracks = MOTION.tracks("grip{}", "m{}")
    scaled = tracks * size * files.PER_METRE[unit]
    assert guessed(named(scaled, labels))["unit"][0] == unit


def test_every_marker_is_shown_with_what_it_would_be_taken_for() -> None:
    """In the file's order but for the body's own, a rigid body without markers by its pose, too many not at all."""
    labels, tracks = MOTION.tracks("grip{}", "m{}")
    tracks = tracks.copy()
    tracks[:3, 4] = np.nan  # m1 is seen from the fourth frame on
    options = ImportOptions(controllers=("grip1", "m3"), markers=("m3", "m2", "m1"), up="z")
    shown = {
        name: (roles, place)
        for name, roles, _, place in look_at(named(tracks, labels), "a.csv", options)[1].markers
    }
    assert list(shown) == ["grip1", "grip2", "grip3", "grip4", "m3", "m2", "m1", *labels[7:]]
    assert [roles for roles, _ in shown.values()] == [
        ("gripper",), (), (), (), ("body", "gripper"), ("body",), ("body",), *[()] * 13,
    ]  # fmt: skip
    assert np.allclose(shown["m2"][1], tracks[3, 5], atol=1e-6) and np.allclose(
        shown["m1"][1], tracks[3, 4], atol=1e-6
    )
    pose = look_at(files.mcap_json(MOTION), "log.mcap")[1].markers[-1]
    assert pose[:3] == ("/gripper/pose", ("gripper",), True) and np.allclose(
        pose[3], MOTION.origin[0], atol=1e-6
    )
    many = np.repeat(tracks[5:9, 4:5], 2001, axis=1) + np.arange(2001)[:, None] * 1e-3
    names = [f"p{i}" for i in range(2001)]
    assert look_at(named(many, names), "a.csv", ImportOptions(controllers=("none",)))[1].markers == ()


def test_a_convention_that_the_data_speak_against_is_warned_of() -> None:
    title, found = look_at(files.motive(MOTION, up="z"), "take.csv")
    assert title == "OptiTrack Motive CSV"
    assert next(row[1] for row in found.guesses if row[0] == "up") == "y"
    assert found.lines[-1] == "up is y, Motive's convention; the body hangs from its gripper along z: --up z?"


def test_without_a_gripper_the_floor_tells_up() -> None:
    apart = MOTION.points - [0.0, 0.1, 0.0]
    found = guessed(named(apart[..., [0, 2, 1]], [f"b{i + 1}" for i in range(16)]), controllers=("none",))
    assert found["up"] == ("y", "guessed: no marker is below 0 along y, some are along z")


def test_the_rate_that_is_said_counts_and_frames_that_are_missing_stay_missing() -> None:
    labels, tracks = MOTION.tracks("grip{}", "m{}")
    kept = np.array([t for t in range(120) if t not in (50, 51)])
    data = named(tracks[kept], labels, MOTION.times[kept])
    scene, _ = imported(data, fps=50.0)
    assert scene.fps == 50.0
    assert np.allclose(scene.times, kept / 50.0)
    assert guessed(data, fps=50.0)["rate"] == ("50 Hz", "given; the file has 100 Hz")


def test_columns_without_a_time_ask_for_the_rate() -> None:
    labels, tracks = MOTION.tracks("grip{}", "m{}")
    data = b"\n".join(line.partition(b",")[2] for line in named(tracks, labels).splitlines())
    with pytest.raises(
        SceneInvalid, match=r"has 120 frames, and neither times nor a frame rate: say it \(--rate HZ\)"
    ):
        imported(data)
    assert np.allclose(imported(data, fps=100.0)[0].times, MOTION.times)


@pytest.mark.parametrize(
    ("kind", "body", "asked"),
    [
        (
            None,
            {},
            ["its kind (--kind, one of beam, block", "mass or density (--mass KG or --density KG_M3)"],
        ),
        ("sheet", {"mass_kg": 1.0}, ["the thickness of the sheet (--thickness M)"]),
        ("rope", {"density_kg_m3": 900.0}, ["the radius of the rope (--radius M)"]),
        (
            "beam",
            {"density_kg_m3": 900.0},
            ["the box of the beam, which 16 markers do not span (--box-m X,Y,Z,X,Y,Z"],
        ),
    ],
)
def test_what_no_recording_tells_is_asked_for_by_its_option(
    kind: Any, body: dict[str, float], asked: list[str]
) -> None:
    data = files.motive(MOTION)
    with pytest.raises(SceneInvalid) as caught:
        import_any(data, "a.csv", ImportOptions(kind=kind, body=body, assume=False))
    assert len(caught.value.faults) == 1
    assert all(words in str(caught.value) for words in asked)
    _, warnings = import_any(data, "a.csv", ImportOptions(kind=kind, body=body))
    assert any(warning.startswith("left open: ") for warning in warnings)


def test_markers_in_their_order_along_a_rope_give_it_its_rest_lengths() -> None:
    angle = 0.9 * np.sin(5 * MOTION.times[:, None] + 0.9 * np.arange(9))
    steps = 0.08 * np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=2)
    rope = MOTION.origin[:, None] + np.concatenate([np.zeros((120, 1, 3)), np.cumsum(steps, axis=1)], axis=1)
    tracks = np.concatenate([MOTION.gripper, rope], axis=1)
    labels = [*(f"grip{i}" for i in range(4)), *(f"r{i}" for i in range(10))]
    options = ImportOptions(kind="rope", body={"mass_kg": 0.1, "radius_m": 0.004}, assume=False)
    scene, _ = import_any(named(tracks, labels), "a.csv", options)
    assert np.allclose(scene.body.segment_rest_lengths_m, 0.08, atol=1e-6)
    mixed = tuple(f"r{i}" for i in (3, 0, 7, 1, 9, 2, 4, 5, 6, 8))
    scene, _ = import_any(named(tracks, labels), "a.csv", dataclasses.replace(options, markers=mixed))
    assert scene.body.segment_rest_lengths_m is None
    assert scene.declared["notes"]["guessed"][-1]["value"] == "unknown"
