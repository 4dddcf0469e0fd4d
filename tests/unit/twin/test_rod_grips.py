"""Grips of measured ropes, and twins of discrete rods as archives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_scene import made_scene
from scipy.spatial.transform import Rotation

from physworld.errors import SceneUnsupported
from physworld.scene import Body, Grip, Scene
from physworld.twin.build import build_twin
from physworld.twin.rods import gripped_of_chain, held_edges, is_pose, sections_of, shapes
from physworld.twin.twin import Twin

LENGTH = 0.6
POINTS = np.stack([0.06 * np.arange(11), 0.01 * np.sin(np.arange(11)), np.zeros(11)], axis=1)
POSE = np.array([[0.0, 0.02, 0.0], [0.0, -0.02, 0.0], [0.01, 0.0, 0.02]])


def rope(controllers: Any, *grips: Grip, frames: int = 12, **facts: Any) -> Scene:
    """A rope along x, held where its controllers are."""
    facts.setdefault("body", Body(segment_rest_lengths_m=np.full(10, LENGTH / 10), radius_m=0.005))
    return made_scene(POINTS, "rope", controllers, frames, grips=grips, **facts)


def held(twin: Twin, grip: int = 0) -> np.ndarray:
    """Distances from the first node of what a grip holds [m]."""
    found: np.ndarray = twin.lattice.distances[twin.held_nodes[grip]]  # type: ignore[attr-defined]
    return found


def test_one_controller_holds_the_node_that_is_nearest() -> None:
    assert held(build_twin(rope([[0.0, 0.0, 0.0]]))) == pytest.approx([0.0])
    assert held(build_twin(rope([POINTS[3]]))) == pytest.approx([0.18])


def test_two_controllers_of_a_grip_hold_what_lies_between_them() -> None:
    twin = build_twin(rope([POINTS[0], POINTS[2]], Grip((0, 1))))
    assert held(twin).min() == 0.0
    assert held(twin).max() == pytest.approx(0.12)
    assert len(held(twin)) == 7


def test_two_grips_hold_both_ends() -> None:
    twin = build_twin(rope([POINTS[0], POINTS[10]], Grip((0,)), Grip((1,))))
    assert held(twin, 0) == pytest.approx([0.0])
    assert held(twin, 1) == pytest.approx([LENGTH])


def test_a_pose_holds_an_edge_at_least() -> None:
    assert is_pose(POSE)
    assert not is_pose(POSE[:2])
    assert not is_pose(np.outer(np.arange(4.0), [1.0, 2.0, 0.5]))
    twin = build_twin(rope(POSE, Grip((0, 1, 2))))
    assert held(twin) == pytest.approx([0.0, LENGTH / 30])
    end = build_twin(rope(POSE + POINTS[10], Grip((0, 1, 2))))
    assert len(held(end)) == 2
    assert held_edges(end.lattice, end.held_nodes).max() == 0  # type: ignore[arg-type]


def test_a_declared_radius_or_box_counts() -> None:
    twin = build_twin(rope([[0.0, 0.0, 0.0]], Grip((0,), radius_m=0.05)))
    assert held(twin) == pytest.approx([0.0, 0.02, 0.04])
    low, high = np.array([-0.01, -0.1, -0.1]), np.array([0.07, 0.1, 0.1])
    twin = build_twin(rope([[0.0, 0.0, 0.0]], Grip((0,), region_min_m=low, region_max_m=high)))
    assert held(twin) == pytest.approx([0.0, 0.02, 0.04, 0.06])


def test_a_declared_region_without_material_is_refused_with_numbers() -> None:
    twin = build_twin(rope([[0.0, 0.0, 0.0]]))
    far = Grip((0,), radius_m=0.01)
    with pytest.raises(SceneUnsupported, match="1 controllers holds no node"):
        gripped_of_chain(twin.lattice, twin.body.start, np.full((1, 3), 3.0), far)  # type: ignore[arg-type]


def test_roll_of_a_pose_turns_the_edges_that_it_holds() -> None:
    turned = np.linspace(0.0, 7.0, 12)  # more than one turn
    spin = Rotation.from_rotvec(
        turned[:, None] * (POINTS[1] - POINTS[0]) / np.linalg.norm(POINTS[1] - POINTS[0])
    )
    hands = np.einsum("tij,kj->tki", spin.as_matrix(), POSE)
    twin = build_twin(replace(rope(POSE, Grip((0, 1, 2))), controllers=hands))
    run = twin.integration(*rope_track(twin, hands))
    sections = run.problem.sections
    assert sections is not None
    assert sections.turns[-1] == pytest.approx(7.0, abs=0.05)  # the edge lies along the spline, not the chord


def rope_track(twin: Twin, hands: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Control times, control points and frames of a recording of twelve frames."""
    times = np.arange(12) / 30.0
    return times, hands, times


def test_shapes_of_a_curvature_are_grips_branches_and_fields() -> None:
    twin = build_twin(rope(POSE, Grip((0, 1, 2))))
    found = shapes(twin)
    assert found.shape == (len(twin.body.start), len(twin.natural))  # type: ignore[arg-type]
    lattice: Any = twin.lattice
    # the angle of the joint beside the grip, and of no other
    assert np.flatnonzero(found[:, 0]).tolist() == [2]
    assert found[2, 0] * lattice.joint_lengths[2] == pytest.approx(1.0)
    assert found[1:, 1] == pytest.approx(found[1, 1])
    assert np.abs(found[:, 1:]).max() == pytest.approx(1.0)


def test_a_twin_of_a_rope_survives_an_archive() -> None:
    twin = build_twin(rope(POSE, Grip((0, 1, 2))))
    natural = np.random.default_rng(2).normal(size=twin.natural.shape)  # type: ignore[union-attr]
    twin = replace(twin, natural=natural).with_parameters(
        bending_n_m2=3e-3, friction_per_m=0.7, creep_ratio=0.2
    )
    again = Twin.from_arrays(twin.to_arrays())
    assert again.parameters == twin.parameters
    hands = np.repeat(POSE[None], 12, axis=0)
    track = rope_track(twin, hands)
    assert np.array_equal(twin.simulate_nodes(*track), again.simulate_nodes(*track))


def test_an_effect_that_is_idle_runs_as_none() -> None:
    twin = build_twin(rope(POSE, Grip((0, 1, 2))))
    hands = np.repeat(POSE[None], 12, axis=0)
    track = rope_track(twin, hands)
    run = twin.integration(*track)
    assert (
        sections_of(twin, run.held, run.knots, np.repeat(POSE[None], len(run.knots), axis=0)).settles is False
    )
    from physworld.effects.registry import effect

    plain = twin.simulate_nodes(*track)
    breeze = twin.with_effect(effect("wind", rate_per_s=1e-12)).simulate_nodes(*track)
    assert breeze == pytest.approx(plain, abs=1e-9)


def test_a_grip_that_gives_lets_go_of_its_nodes() -> None:
    from physworld.effects.registry import effect

    twin = build_twin(rope(POSE, Grip((0, 1, 2))))
    track = rope_track(twin, np.repeat(POSE[None], 12, axis=0))
    gives = twin.with_effect(effect("grip_slip", compliance_m_n=1e-4))
    assert np.isfinite(gives.simulate_nodes(*track)).all()
