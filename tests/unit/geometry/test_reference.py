"""Which body a scene becomes, how large it is, and by which numbers a scene without one is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene
from scipy.spatial.transform import Rotation

from physworld.errors import SceneUnsupported
from physworld.geometry.reference import ReferenceBody, reference_body
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld.twin.build import build_twin

BUDGET = 400
SIZE = np.array([0.3, 0.1, 0.05])
SKIN_OF_RANDOM_POINTS = 0.12  # the alpha shape of 4000 points strewn in a ball misses about a tenth of it
RNG = np.random.default_rng(3)
CLOUD = RNG.uniform(0.0, 1.0, size=(1500, 3)) * SIZE
GRID = np.stack(np.meshgrid(*[np.linspace(0, 0.3, 4)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
FLAT = np.concatenate([GRID, np.zeros((16, 1))], axis=1)
FINE = np.stack(np.meshgrid(*[np.linspace(0, 0.3, 8)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)


def line(count: int, end: float = 1.0) -> np.ndarray:
    return np.linspace([0.1, 0.0, 0.0], [end, 0.0, 0.0], count)


def bowl(plane: np.ndarray) -> np.ndarray:
    return np.concatenate([plane, 5 * np.sum((plane - 0.15) ** 2, axis=1, keepdims=True)], axis=1)


def measure(body: ReferenceBody) -> float:
    return float(body.lattice.particle_measures.sum())


def placed(body: ReferenceBody) -> np.ndarray:
    """Tracked points at the start, from the nodes alone."""
    return body.lattice.interpolation(body.points) @ body.start


def unseen(scene: Scene, frame: slice, point: slice) -> Scene:
    """The scene with some sightings gone; a reader leaves zeros there."""
    visible, points = scene.visible.copy(), scene.points.copy()
    visible[frame, point] = False
    points[frame, point] = 0.0
    return replace(scene, visible=visible, points=points)


def test_a_declared_box_keeps_its_volume_and_its_points() -> None:
    body = reference_body(made_scene([[0.2, 0.05, 0.05]], "beam", body=box_body([0, 0, 0], SIZE)), BUDGET)
    assert measure(body) == pytest.approx(np.prod(SIZE), rel=1e-9)
    assert body.lattice.fill.size == pytest.approx(BUDGET, rel=0.5)
    np.testing.assert_allclose(placed(body), [[0.2, 0.05, 0.05]], atol=1e-12)
    np.testing.assert_array_equal(body.rest, body.start)


def test_cells_end_a_clamp_s_reach_before_a_declared_grip_ends_and_the_volume_stays() -> None:
    grip = Grip((0,), np.array([-0.01, 0.0, 0.0]), np.array([0.037, 0.1, 0.05]))
    scene = made_scene([[0.2, 0.05, 0.05]], "beam", body=box_body([0, 0, 0], SIZE), grips=(grip,))
    body = reference_body(scene, BUDGET)
    offset = (0.037 - body.lattice.origin[0]) / body.lattice.spacing[0] - 0.5 / np.sqrt(3.0)
    assert abs(offset - round(offset)) < 1e-9
    assert measure(body) == pytest.approx(np.prod(SIZE), rel=1e-9)


def test_a_block_s_cloud_is_a_box() -> None:
    body = reference_body(made_scene(CLOUD[:5], "block", rest_volume_points=CLOUD), BUDGET)
    assert measure(body) == pytest.approx(np.prod(np.ptp(CLOUD, axis=0)), rel=1e-9)
    assert body.notes == ()


def test_a_cloud_in_a_ball_gives_the_volume_of_a_ball() -> None:
    ball = RNG.normal(size=(4000, 3))
    ball *= 0.1 * RNG.uniform(size=(4000, 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1, keepdims=True)
    body = reference_body(made_scene(ball[:5], "blob", rest_volume_points=ball), BUDGET)
    assert measure(body) == pytest.approx(4 / 3 * np.pi * 0.1**3, rel=SKIN_OF_RANDOM_POINTS)
    assert "bounding box" in body.notes[0]


def test_a_point_that_was_never_seen_does_not_stretch_the_body() -> None:
    far = CLOUD[:200] + np.array([5.0, 0.0, 0.0])
    blind = reference_body(unseen(made_scene(far, "block"), np.s_[:], np.s_[7:9]), BUDGET)
    assert np.ptp(blind.start, axis=0).max() < 0.6


def test_a_point_seen_later_takes_its_first_sight() -> None:
    scene = made_scene(CLOUD[:5], "beam", body=box_body([0, 0, 0], SIZE))
    body = reference_body(unseen(scene, np.s_[:2], np.s_[1]), BUDGET)
    np.testing.assert_allclose(body.points, CLOUD[:5])


def test_a_flat_sheet_keeps_its_area_wherever_it_lies() -> None:
    turns = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.3, 0.8, -0.4], [0.0, 0.0, 0.6]])
    for turn in turns:
        points = turn.apply(FLAT) + np.array([1.0, 2.0, 3.0])
        scene = made_scene(points, "sheet", initial_state=UNDEFORMED_AT_REST, body=Body(thickness_m=2e-3))
        body = reference_body(scene, BUDGET)
        assert measure(body) == pytest.approx(0.09, rel=1e-6)
        assert body.thickness_m == 2e-3 and body.notes == ()
        np.testing.assert_allclose(placed(body), points, atol=1e-9)


def test_a_sheet_whose_grid_is_declared_may_start_in_any_shape() -> None:
    curved = np.stack([0.1 * np.sin(GRID[:, 0] / 0.1), GRID[:, 1], 0.1 * np.cos(GRID[:, 0] / 0.1)], axis=1)
    body = reference_body(made_scene(curved, "sheet", body=Body(grid_shape=(4, 4), side_m=0.3)), BUDGET)
    assert body.lattice.dim == 2 and measure(body) == pytest.approx(0.09)
    np.testing.assert_allclose(placed(body), curved, atol=5e-3)
    assert "1 mm assumed" in body.notes[0]


def test_a_sheet_that_is_not_flat_is_a_solid_if_its_points_bound_one_and_says_so() -> None:
    body = reference_body(made_scene(bowl(FINE), "sheet"), BUDGET)
    assert body.lattice.dim == 3
    assert "not flat at the start (0.0595 m rms off its plane, 0.3 m wide)" in body.notes[0]


@pytest.mark.parametrize(("hand", "begin"), [(-0.04, -0.04), (-0.5, -0.2), (None, -0.1)])
def test_a_straight_rope_that_is_declared_longer_reaches_back_to_its_hand(
    hand: float | None, begin: float
) -> None:
    points = line(7)
    length = float(np.ptp(points, axis=0).max())
    direction = (points[-1] - points[0]) / length
    hands = [] if hand is None else [points[0] + hand * direction]
    longer = Body(length_m=length + 0.2)
    scene = made_scene(points, "rope", hands, initial_state=UNDEFORMED_AT_REST, body=longer)
    body = reference_body(scene, BUDGET)
    assert measure(body) == pytest.approx(length + 0.2)
    np.testing.assert_allclose(np.sort(body.points[:, 0])[0], -begin, atol=1e-9)
    np.testing.assert_allclose(body.lattice.interpolation(body.points) @ body.start, points, atol=1e-9)
    assert any("past its first" in note for note in body.notes)


def test_a_straight_rope_whose_points_lie_on_its_axis_has_the_usual_radius() -> None:
    twin = build_twin(made_scene(line(7), "rope", initial_state=UNDEFORMED_AT_REST))
    assert twin.body.thickness_m == 0.004 and twin.density > 0
    assert any("radius not declared" in note for note in twin.body.notes)


def test_a_straight_rope_has_the_length_of_its_points() -> None:
    body = reference_body(made_scene(line(7), "rope", initial_state=UNDEFORMED_AT_REST), BUDGET)
    assert body.lattice.dim == 1 and measure(body) == pytest.approx(0.9, rel=1e-9)
    np.testing.assert_allclose(placed(body) + body.offsets, line(7), atol=1e-9)


def test_a_slack_rope_has_its_declared_lengths_not_the_distance_of_its_markers() -> None:
    bent = line(5) + np.array([0.0, 0.0, 1.0]) * np.array([0.0, 0.05, 0.08, 0.05, 0.0])[:, None]
    lengths = 1.1 * np.linalg.norm(np.diff(bent, axis=0), axis=1)
    body = reference_body(made_scene(bent, "rope", body=Body(segment_rest_lengths_m=lengths)), BUDGET)
    assert measure(body) == pytest.approx(lengths.sum(), rel=1e-9)
    np.testing.assert_allclose(body.points[:, 0], np.concatenate([[0.0], np.cumsum(lengths)]))


def test_without_lengths_a_rope_is_ordered_from_its_controllers_and_reaches_to_them() -> None:
    body = reference_body(made_scene(line(6)[::-1], "rope"), BUDGET)
    np.testing.assert_allclose(body.points[:, 0], line(6)[::-1, 0], atol=1e-12)
    assert measure(body) == pytest.approx(1.0)


REFUSED = {
    "no points": (made_scene(np.empty((0, 3)), "beam"), "0 points"),
    "one frame": (made_scene(FLAT, "sheet", frames=1), "1 frames"),
    "three points without a box": (made_scene(CLOUD[:3], "blob"), "3 points do not bound.*box_min_m"),
    "one point without a box": (made_scene(CLOUD[:1], "block"), "1 points do not bound"),
    "a box without volume": (
        made_scene(CLOUD, "beam", body=box_body([0, 0, 0], [1, 1, 0])),
        r"\[1. 1. 0.\].*no volume",
    ),
    "surface points in a plane": (made_scene(CLOUD * [1, 1, 0], "blob"), "1500 points lie in a plane.*no volume"),
    "volume points in a plane": (
        made_scene(CLOUD[:5], "blob", rest_volume_points=CLOUD * [1, 1, 0]),
        "1500 points lie in a plane.*no volume",
    ),
    "a branched rope": (made_scene(line(5), "branched_rope"), "5 points has no form but discrete_rod"),
    "wrong number of lengths": (
        made_scene(line(5), "rope", body=Body(segment_rest_lengths_m=np.full(7, 0.1))),
        "7 segment rest lengths for 5 tracked points",
    ),
    "a rope of one point": (made_scene(line(1), "rope"), "1 of 1 points.*too few to place a rope"),
    "a rope in one place": (made_scene(np.zeros((5, 3)), "rope"), "span 0.0 m"),
    "an undeformed rope in one place": (
        made_scene(np.ones((5, 3)), "rope", initial_state=UNDEFORMED_AT_REST),
        "span 0.0 m",
    ),
    "a rope that nothing orders": (made_scene(line(5), "rope", controllers=()), "nothing orders the 5 points"),
    "a rope not seen at the start": (
        unseen(made_scene(line(5), "rope"), np.s_[:1], np.s_[:]),
        "0 of 5 points are visible in the first frame",
    ),
    "a sheet of one point": (made_scene(FLAT[:1], "sheet"), "1 points of a sheet span.*no area"),
    "a sheet on a line": (made_scene(FLAT[:4], "sheet"), "4 points of a sheet span.*no area"),
    "a sheet that is not flat": (
        made_scene(bowl(GRID), "sheet"),
        "0.0707 m rms off its plane, 0.3 m wide.*16 points do not bound",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_scene_without_a_body_is_refused_by_its_numbers(name: str) -> None:
    scene, words = REFUSED[name]
    with pytest.raises(SceneUnsupported, match=words):
        reference_body(scene, BUDGET)


def test_points_of_a_sheet_on_a_slanted_line_span_no_area() -> None:
    diagonal = np.linspace([0.0, 0.0, 0.0], [0.3, 0.3, 0.0], 5)
    with pytest.raises(SceneUnsupported, match="no area"):
        reference_body(made_scene(diagonal, "sheet"), BUDGET)
