"""Demonstrations in which a hand lets go: it comes back to the material, gently, and says when it held what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from two_handed_bar import BAR, opened, two_handed_bar

from physworld.demonstrate import DemonstrationConfig, make_episode, plan_episode
from physworld.demonstrate.regrasp import SHORTEST_TICKS, able
from physworld.demonstrate.side_by_side import make_episodes
from physworld.errors import BatchRefused
from physworld.geometry.rigid import rigid_motion
from physworld.scene import Grip, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

EVERY = DemonstrationConfig(frames=40, regrasp_share=1.0, replay_share=0.0, perturbation="none")


@pytest.fixture(scope="module")
def known() -> tuple[Scene, Twin]:
    scene = two_handed_bar()
    return scene, build_twin(scene, 100).with_parameters(**BAR)


@pytest.fixture(scope="module")
def episode(known: tuple[Scene, Twin]) -> dict[str, np.ndarray]:
    return make_episode(*known, EVERY, 3)[0]


def gripped(twin: Twin, grip: int) -> np.ndarray:
    """Particles in the hands' box at that end."""
    x = twin.particles_start[:, 0]
    return np.flatnonzero(x < 0.02 if grip == 0 else x > 0.18)


def test_the_hand_is_where_its_material_is_whenever_it_holds_it(
    known: tuple[Scene, Twin], episode: dict[str, np.ndarray]
) -> None:
    _, twin = known
    holding = episode["holding"].astype(bool)
    grip = int(np.argmin(holding.all(axis=0)))
    assert (~holding[:, grip]).sum() >= SHORTEST_TICKS and holding[:, 1 - grip].all()
    inside, group = gripped(twin, grip), twin.controller_groups[grip]
    turns, shifts = rigid_motion(twin.particles_start[inside], episode["particles"][:, inside])
    there = np.einsum("tij,kj->tki", turns, twin.controllers_start[group]) + shifts[:, None]
    gap = np.abs(there - episode["controllers"][:, group]).max(axis=(1, 2))
    assert gap[holding[:, grip]].max() < 2e-3
    open_now = ~holding[:, grip]
    strayed = np.linalg.norm(there[open_now] - there[np.argmax(open_now)], axis=2).max()
    assert strayed > 0.02


def test_controllers_are_continuous_and_the_hand_gives_up_the_speed_of_the_material(
    episode: dict[str, np.ndarray],
) -> None:
    steps = np.linalg.norm(np.diff(episode["controllers"], axis=0), axis=2).max(axis=1)
    usual = np.linalg.norm(np.diff(episode["particles"], axis=0), axis=2).max()
    assert steps.max() < 1.2 * usual
    closes = int(np.flatnonzero(np.diff(episode["holding"].min(axis=1).astype(int)) == 1)[0]) + 1
    assert np.abs(steps[closes] - steps[closes - 1]) < 0.5 * steps[closes - 1]


def test_the_same_seed_without_regrasps_moves_as_it_did_before(known: tuple[Scene, Twin]) -> None:
    scene, twin = known
    quiet = replace(EVERY, regrasp_share=None)
    one, other = plan_episode(scene, twin, quiet, 3), plan_episode(scene, twin, EVERY, 3)
    assert one.regrasp is None and not one.opens and other.regrasp is not None
    assert np.array_equal(one.control_points, other.control_points)
    assert "holding" not in make_episode(scene, twin, quiet, 3)[0]


def test_a_recording_whose_grip_lets_go_is_replayed_with_it(known: tuple[Scene, Twin]) -> None:
    scene, _ = known
    scene = replace(scene, grips=(scene.grips[0], opened(scene.grips[1], (0.1, 0.2))))
    twin = build_twin(scene, 100).with_parameters(**BAR)
    plan = plan_episode(scene, twin, replace(EVERY, replay_share=1.0, regrasp_share=None), 0)
    assert (plan.motion, plan.openings) == ("replay", twin.openings)
    arrays, _ = make_episode(scene, twin, replace(EVERY, replay_share=1.0, regrasp_share=None), 0)
    assert 0.05 < 1.0 - arrays["holding"][:, 1].mean() < 0.5


def test_one_hand_alone_never_lets_go_and_several_at_once_are_not_simulated_side_by_side(
    known: tuple[Scene, Twin],
) -> None:
    scene, twin = known
    alone = build_twin(replace(scene, grips=scene.grips[:1]), 100)
    assert able(alone) == () and able(twin) == (0, 1)
    assert plan_episode(replace(scene, grips=scene.grips[:1]), alone, EVERY, 0).regrasp is None
    with pytest.raises(BatchRefused, match="one by one"):
        make_episodes(scene, twin, EVERY, [0, 1])
    with pytest.raises(ValueError, match=r"regrasp share 1\.5"):
        DemonstrationConfig(regrasp_share=1.5)


def test_a_hand_that_is_open_at_the_start_holds_nothing_in_any_demonstration(
    known: tuple[Scene, Twin],
) -> None:
    scene, _ = known
    third = Grip((8, 9, 10, 11), open_s=((0.0, 0.3),))
    hand = scene.controllers[:, :4] + np.array([0.1, 0.0, 0.1])
    scene = replace(
        scene, controllers=np.concatenate([scene.controllers, hand], axis=1), grips=(*scene.grips, third)
    )
    twin = build_twin(scene, 100).with_parameters(**BAR)
    assert [len(nodes) > 0 for nodes in twin.held_nodes] == [True, True, False] and able(twin) == (0, 1)
    for config in (EVERY, replace(EVERY, regrasp_share=0.0), replace(EVERY, replay_share=1.0)):
        plan = plan_episode(scene, twin, config, 0)
        assert not plan.motion.startswith("replay")
        holding = make_episode(scene, twin, config, 0)[0]["holding"]
        assert not holding[:, 2].any() and holding[:, :2].any(axis=1).all()


def test_what_is_recorded_of_an_episode_is_of_the_hands_path_as_it_was(known: tuple[Scene, Twin]) -> None:
    arrays, attributes = make_episode(*known, EVERY, 3)
    reach = np.abs(arrays["controllers"] - arrays["controllers"][0]).max()
    assert attributes["control_reach_m"] == pytest.approx(reach, rel=1e-5)
    assert attributes["regrasp"]["open_s"] < attributes["regrasp"]["close_s"]
