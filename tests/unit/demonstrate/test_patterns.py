"""What each pattern does to the grips, which of them a scene allows, and the weights of the mix."""

from __future__ import annotations

import pickle
from collections import Counter
from dataclasses import asdict, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from physworld.demonstrate import DemonstrationConfig, plan_episode
from physworld.demonstrate.limits import limits_of
from physworld.demonstrate.motion import LINEAR, broken_limit, random_motion
from physworld.demonstrate.paths import PathStyle
from physworld.demonstrate.patterns import axis_of, check_weights, patterns_for, weighted
from physworld.errors import SceneUnsupported
from physworld.geometry.rigid import rigid_motion
from physworld.scene import DeclaredCollider
from physworld.twin.build import build_twin

TIMES = np.arange(0.0, 3.0, 1.0 / 120.0)
SEEDS = range(4)
Z = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def limits(block, block_twin):
    return limits_of(block, block_twin)


def drawn(block, limits, pattern, seed, **options):
    return random_motion(
        block.controllers[0], limits, TIMES, np.random.default_rng(seed), pattern, **options
    ).points


def centres(points, limits):
    return np.stack([points[:, body].mean(axis=1) for body in limits.bodies], axis=1)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_lift_goes_up_more_than_sideways(block, limits, seed):
    moves = centres(drawn(block, limits, "lift", seed), limits)
    moves = moves - moves[0]
    assert moves[..., 2].max() > 0.3 * 0.9 * limits.reach_max_m[2] * 0.5
    assert moves[..., 2].max() > np.abs(moves[..., :2]).max()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_stretch_lengthens_the_line_between_the_grips_within_its_strain(block, limits, seed):
    moved = centres(drawn(block, limits, "stretch", seed), limits)
    distance = np.linalg.norm(moved[:, 1] - moved[:, 0], axis=1)
    most = (1.0 + limits.stretch) * limits.spread_max_m[0, 1]
    assert distance.max() > distance[0] + 0.2 * (most - distance[0])
    assert distance.max() <= most + 1e-9
    across = np.cross(moved[:, 1] - moved[:, 0], axis_of(limits, block.controllers[0], 1))
    assert np.linalg.norm(across, axis=1).max() < 0.5 * (distance.max() - distance.min() + 1e-3)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_twist_turns_one_grip_about_the_line_to_the_other_and_moves_no_centre(block, limits, seed):
    points = drawn(block, limits, "twist", seed)
    moved = centres(points, limits)
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-12)
    turned = []
    for grip, body in enumerate(limits.grips):
        rotations, _ = rigid_motion(points[0, body], points[:, body])
        vectors = Rotation.from_matrix(rotations).as_rotvec()
        axis = axis_of(limits, block.controllers[0], grip)
        np.testing.assert_allclose(vectors, np.outer(vectors @ axis, axis), atol=1e-6)
        turned.append(float(np.abs(vectors @ axis).max()))
    assert min(turned) < 1e-9 and max(turned) > 0.1


@pytest.mark.parametrize("seed", SEEDS)
def test_a_push_of_a_grip_goes_towards_the_middle_of_the_object(block, limits, seed):
    moved = centres(drawn(block, limits, "push", seed), limits)
    reach = np.linalg.norm(moved - moved[0], axis=-1)
    mover = int(reach.max(axis=0).argmax())
    towards = limits.object_centre_m - moved[0, mover]
    towards[2] = 0.0
    along = (moved[:, mover] - moved[0, mover]) @ towards / np.linalg.norm(towards)
    assert along.max() > 0.005
    assert reach[:, 1 - mover].max() < 1e-12


def pusher_scene(block):
    """The held block with a ball on three more controllers in front of its long side."""
    middle = np.array([0.1, -0.03, 0.025])
    hand = middle + np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.0, 0.01]])
    path = np.repeat(hand[None], len(block.times), axis=0)
    path[..., 1] += (0.02 * np.sin(block.times))[:, None]
    ball = DeclaredCollider("ball", "sphere", radius_m=0.02, position_m=middle, controllers=(6, 7, 8))
    return replace(block, controllers=np.concatenate([block.controllers, path], axis=1), colliders=(ball,))


def test_a_pusher_runs_into_the_object_and_the_grips_stay(block):
    scene = pusher_scene(block)
    twin = build_twin(scene, particle_budget=200)
    limits = limits_of(scene, twin)
    assert [body.tolist() for body in limits.pushers] == [[6, 7, 8]]
    motion = random_motion(scene.controllers[0], limits, TIMES, np.random.default_rng(0), "push")
    assert np.abs(motion.points[:, :6] - motion.points[0, :6]).max() < 1e-12
    assert motion.points[:, 6, 1].max() > -0.03 + 0.01
    plan = plan_episode(
        scene, twin, DemonstrationConfig(frames=20, patterns={"push": 1.0}, replay_share=0.0), 3
    )
    assert plan.motion == "push"
    still = replace(plan, control_points=np.repeat(plan.control_points[:1], len(plan.control_points), axis=0))
    pushed, alone = (
        twin.simulate(p.control_times, p.control_points, p.times, from_rest=True) for p in (plan, still)
    )
    assert np.abs(pushed - alone).max() > 1e-3  # the ball met the block


def test_a_scene_of_one_pusher_and_no_grip_can_be_demonstrated(block):
    scene = replace(
        pusher_scene(block),
        controllers=pusher_scene(block).controllers[:, 6:],
        grips=(),
        colliders=(replace(pusher_scene(block).colliders[0], controllers=(0, 1, 2)),),
    )
    twin = build_twin(scene, particle_budget=200)
    motions = {plan_episode(scene, twin, DemonstrationConfig(frames=5), seed).motion for seed in range(25)}
    assert "push" in motions
    assert motions <= {"push", "replay", "replay_warped", "replay_mirrored"}


def test_single_control_points_cannot_twist_and_one_grip_has_nothing_to_move_against(block, block_twin):
    points = block.controllers[:, [0, 3]]
    scene = replace(block, controllers=points)
    two = limits_of(scene, replace(block_twin, controller_groups=(np.array([0]), np.array([1]))))
    assert patterns_for(two, points[0]) == ("single", "lift", "push", "stretch", "together", "bimanual")
    one = limits_of(
        replace(block, controllers=block.controllers[:, 3:]),
        replace(block_twin, controller_groups=(np.array([0, 1, 2]),)),
    )
    assert patterns_for(one, block.controllers[0, 3:]) == ("single", "lift", "push", "stretch", "twist")


def test_the_mix_follows_its_weights(block, block_twin):
    config = DemonstrationConfig(frames=5, patterns={"lift": 3.0, "twist": 1.0}, replay_share=0.0)
    motions = Counter(plan_episode(block, block_twin, config, seed).motion for seed in range(80))
    assert set(motions) == {"lift", "twist"}
    assert 46 <= motions["lift"] <= 74  # 60 expected, standard deviation 3.9


def test_settings_survive_the_way_to_another_process():
    config = DemonstrationConfig(patterns={"lift": 1.0})
    assert pickle.loads(pickle.dumps(config)) == config
    assert asdict(config)["patterns"] == {"lift": 1.0}


def test_weights_that_are_no_mix_are_refused(limits, block):
    with pytest.raises(ValueError, match=r"unknown patterns \['wiggle'\]"):
        check_weights({"wiggle": 1.0})
    with pytest.raises(ValueError, match="one of them positive"):
        check_weights({"lift": 0.0})
    with pytest.raises(ValueError, match="not negative"):
        DemonstrationConfig(patterns={"lift": -1.0})
    with pytest.raises(SceneUnsupported, match="leaves no pattern; this scene allows single"):
        weighted(patterns_for(limits, block.controllers[0]), {"hold_one": 1.0})


@pytest.mark.parametrize("seed", SEEDS)
def test_the_baseline_is_straight_at_constant_speed(block, limits, seed):
    points = drawn(block, limits, None, seed, style=PathStyle(uniform=True))
    moved = centres(points, limits)
    mover = int(np.ptp(moved, axis=0).max(axis=1).argmax())
    velocity = np.diff(moved[:, mover], axis=0) * 120.0
    turns = np.linalg.norm(np.diff(velocity, axis=0), axis=1)
    speed = np.linalg.norm(velocity, axis=1)
    # the velocity changes only where one line ends and the next begins: at most two samples an end
    assert (turns > 1e-9).sum() <= 2 * 20
    assert (turns < 1e-9).mean() > 0.8
    assert speed.min() > 0.0
    assert broken_limit(points, limits, TIMES) is None


def test_the_baseline_is_a_setting_of_the_demonstration(block, block_twin):
    config = DemonstrationConfig(frames=5, motion="linear", replay_share=0.0)
    assert {plan_episode(block, block_twin, config, seed).motion for seed in range(5)} == {LINEAR}
