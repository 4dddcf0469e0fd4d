"""Recordings with a secret: hands start from rest; a rope of PyElastica and a cloth of MuJoCo hang in them and fall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.peers.finite_elements import Acting
from benchmarks.peers.flex_blocks import Block
from benchmarks.trace.hidden_bodies import OBJECTS, Motion


def test_a_hand_starts_from_rest_and_may_be_late() -> None:
    motion = Motion(3, 0.05, 0.2)
    turn, shift = motion.place(0.0, 0.0)
    assert np.array_equal(turn, np.eye(3)) and np.array_equal(shift, np.zeros(3))
    assert np.linalg.norm(motion.place(0.0, 1e-3)[1]) < 1e-4
    late, own = motion.place(0.04, 0.5), motion.place(0.0, 0.46)
    assert np.allclose(late[0], own[0]) and np.allclose(late[1], own[1])


def test_a_rope_follows_its_hand_and_a_tether_pulls_it() -> None:
    pytest.importorskip("elastica", reason="PyElastica comes with the extra bench")
    rope = OBJECTS["rope"]
    recorder = rope.recorder(1, np.random.default_rng(0))
    times = np.linspace(0.0, 0.1, 4)
    free = recorder.tracks(Acting(), 0.0, times)
    hand = recorder.hands[0]
    held = np.all((free[0] >= hand.box[0]) & (free[0] <= hand.box[1]), axis=1)
    turn, shift = hand.motion.place(0.0, times[-1])
    assert held.any()
    assert np.allclose(
        free[-1, held], (free[0, held] - hand.centre) @ turn.T + hand.centre + shift, atol=1e-6
    )
    assert (free[-1, :, 2] < free[0, :, 2] - 0.01).sum() > 20  # askew, it falls
    end = free[0, np.argmin(free[0, :, 2])]
    tie = Acting(tether_n_m=5.0, anchor=end + np.array([0.0, 0.2, 0.0]), attach=end, tether_radius_m=0.03)
    pulled = recorder.tracks(tie, 0.0, times)
    assert pulled[-1, np.argmin(free[0, :, 2]), 1] - free[-1, np.argmin(free[0, :, 2]), 1] > 0.01
    inside = recorder.inside(np.random.default_rng(0)) - hand.centre
    along = inside @ (np.array(rope.way) / np.linalg.norm(rope.way))
    across = np.linalg.norm(inside, axis=1) ** 2 - along**2
    assert (
        along.min() >= 0.0 and along.max() <= rope.length_m and across.max() <= rope.radius_m**2 * (1 + 1e-9)
    )


def test_a_cloth_follows_its_hands_and_drag_slows_it() -> None:
    cloth = replace(OBJECTS["cloth"], cells=(6, 6))
    recorder = cloth.recorder(1, np.random.default_rng(0))
    times = np.arange(3) / 30.0
    free = recorder.tracks(Acting(), 0.0, times)
    for hand in recorder.hands:
        held = np.all((free[0] >= hand.box[0]) & (free[0] <= hand.box[1]), axis=1)
        _, shift = hand.motion.place(0.0, times[-1])
        assert held.any() and np.allclose(free[-1, held] - free[0, held], shift, atol=1e-6)

    def went(tracks: np.ndarray) -> float:
        return float(np.linalg.norm(tracks[1] - tracks[0], axis=1).mean())

    assert went(free) > 3e-4
    assert went(recorder.tracks(Acting(linear_drag_per_s=3000.0), 0.0, times)) < 0.8 * went(free)
    low = np.array([0.0, 0.0, 0.35])
    tie = Acting(tether_n_m=50.0, anchor=low + np.array([0.0, 0.2, 0.0]), attach=low, tether_radius_m=0.05)
    assert recorder.tracks(tie, 0.0, times)[-1, :, 1].max() > free[-1, :, 1].max() + 1e-3
    inside = recorder.inside(np.random.default_rng(0))
    assert np.allclose(np.ptp(inside, axis=0), cloth.size_m, rtol=0.01)


def test_a_block_follows_its_hand_and_stays_on_its_table() -> None:
    brick = replace(OBJECTS["brick"], cells=(4, 3, 3))
    block = Block(brick.size_m, brick.cells, brick.young_pa, 0.35, brick.density_kg_m3, brick.friction, 10)
    assert block.masses().sum() == pytest.approx(brick.density_kg_m3 * np.prod(brick.size_m))
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.3, 0.8, 0.45]])
    placed = block.between(block.vertices()[None], corners)[0]
    assert np.allclose(placed, block.vertices().min(axis=0) + corners * brick.size_m, atol=1e-9)
    recorder = brick.recorder(1, np.random.default_rng(0))
    times = np.arange(4) / 30.0
    free = recorder.tracks(Acting(), 0.0, times)
    hand = recorder.hands[0]
    held = np.all((free[0] >= hand.box[0] - 1e-9) & (free[0] <= hand.box[1] + 1e-9), axis=1)
    _, shift = hand.motion.place(0.0, times[-1])
    assert held.any() and np.allclose(free[-1, held] - free[0, held], shift, atol=1e-6)
    behind = free[0, :, 0] > 0.0
    assert 0.0 < np.linalg.norm((free[-1] - free[0])[behind].mean(axis=0)) < np.linalg.norm(shift)
    assert free[..., 2].min() > -2e-4  # the table gives way by less
    tilted = recorder.tracks(Acting(gravity_m_s2=np.array([1.0, 0.0, -9.7])), 0.0, times)
    sheared_m = brick.density_kg_m3 * 1.0 * brick.size_m[2] ** 2 / (3 * brick.young_pa / 2.7)
    assert (tilted - free)[-1, behind, 0].mean() == pytest.approx(
        sheared_m, rel=0.4
    )  # a foot that does not slide
