"""Episodes with a real twin: shapes, clock, determinism, held-out frames, rejection."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from physworld.demonstrate import (
    DemonstrationConfig,
    derived_seed,
    make_episode,
    plan_episode,
    run_episode,
)
from physworld.demonstrate.episode import check_episode, episode_frames
from physworld.errors import (
    EpisodeRejected,
    ParticlesLeftTheGrid,
    SceneUnsupported,
    SimulationError,
    UnstableSimulation,
)

pytestmark = pytest.mark.slow

CONFIG = DemonstrationConfig(frames=12)


def plan_of(scene, twin, motion, config=CONFIG):
    """The first seed whose plan is such a motion."""
    for seed in range(300):
        plan = plan_episode(scene, twin, config, seed)
        if plan.motion == motion:
            return plan
    raise AssertionError(f"no {motion} among 300 seeds")


def test_an_episode_has_the_stored_arrays(block, block_twin):
    plan = plan_episode(block, block_twin, CONFIG, 1)
    seen = []
    arrays = run_episode(block_twin, plan, lambda done, total: seen.append((done, total)))
    particles = len(block_twin.particles_rest)
    assert {name: (a.shape, a.dtype.str) for name, a in arrays.items()} == {
        "times": ((12,), "<f8"),
        "particles": ((12, particles, 3), "<f4"),
        "controllers": ((12, 6, 3), "<f4"),
        "properties": ((particles, 2), "<f4"),
    }
    np.testing.assert_allclose(np.diff(arrays["times"]), 1.0 / 30.0)
    np.testing.assert_allclose(arrays["particles"][0], block_twin.particles_start, atol=1e-6)
    np.testing.assert_allclose(arrays["controllers"][0], block.controllers[0], atol=1e-6)
    assert seen[-1][0] == seen[-1][1]


def test_the_seed_decides_everything(block, block_twin):
    first, again = (run_episode(block_twin, plan_episode(block, block_twin, CONFIG, 7)) for _ in range(2))
    for name, values in first.items():
        np.testing.assert_array_equal(values, again[name])
    other = plan_episode(block, block_twin, CONFIG, 8)
    assert np.abs(other.properties - first["properties"]).max() > 0.01


def test_a_share_of_the_plans_replays_the_recording_and_all_patterns_occur(block, block_twin):
    motions = Counter(plan_episode(block, block_twin, CONFIG, seed).motion for seed in range(120))
    replays = sum(count for name, count in motions.items() if name.startswith("replay"))
    assert 10 <= replays <= 40  # 24 expected, standard deviation 4.4
    assert set(motions) >= {"single", "together", "bimanual", "replay", "replay_warped", "replay_mirrored"}


def test_no_plan_sees_the_held_out_frames(block, block_twin):
    changed = block.controllers.copy()
    changed[block.test[0] :] += 0.5
    blind = replace(block, controllers=changed)
    for motion in ("replay", "replay_warped", "replay_mirrored", "bimanual"):
        plan = plan_of(block, block_twin, motion, DemonstrationConfig())
        other = plan_episode(blind, block_twin, DemonstrationConfig(), plan.seed)
        np.testing.assert_array_equal(other.control_points, plan.control_points)


def test_a_plain_replay_follows_the_recording_until_training_ends(block, block_twin):
    plan = plan_of(block, block_twin, "replay", DemonstrationConfig())
    assert not plan.from_rest
    assert len(plan.times) == block.train[1]
    np.testing.assert_allclose(plan.controllers, block.controllers[: block.train[1]], atol=1e-12)


def test_training_frames_shorter_than_a_tick_are_not_replayed(block, block_twin):
    short = replace(block, train=(0, 1))
    config = replace(CONFIG, replay_share=1.0)
    plans = [plan_episode(short, block_twin, config, seed) for seed in range(8)]
    assert not any(plan.motion.startswith("replay") for plan in plans)
    assert all(len(plan.times) == CONFIG.frames for plan in plans)


def test_the_motion_is_the_same_at_ticks_and_between_them(block, block_twin):
    plan = plan_of(block, block_twin, "bimanual")
    np.testing.assert_array_equal(plan.control_times[::4], plan.times)
    np.testing.assert_array_equal(plan.control_points[::4], plan.controllers)


def test_length_follows_the_recording_up_to_a_cap(block):
    assert episode_frames(block, DemonstrationConfig()) == 60
    assert episode_frames(block, DemonstrationConfig(max_frames=20)) == 20
    assert episode_frames(block, CONFIG) == 12


def test_without_perturbation_the_twins_own_properties_are_used(block, block_twin):
    plan = plan_episode(block, block_twin, DemonstrationConfig(frames=5, property_sigma=0.0), 3)
    assert not plan.properties.any()


def test_supplied_part_features_shape_the_property_field(block, block_twin):
    volume = block_twin.particles_start
    halves = (volume[:, :1] > 0.1).astype(float)
    scene = replace(block, rest_volume_points=volume, part_features=halves)
    config = DemonstrationConfig(frames=5, length_scale=0.2)
    field = plan_episode(scene, block_twin, config, 0).properties[:, 0]
    assert np.ptp(field[volume[:, 0] > 0.1]) < 1e-9
    assert np.ptp(field) > 0.01


def test_attributes_are_json(block, block_twin):
    _, attributes = make_episode(block, block_twin, CONFIG, 2)
    assert json.loads(json.dumps(attributes)) == attributes
    assert attributes["rejected"] == []
    assert attributes["seed"] == 2


def test_an_episode_that_cannot_be_simulated_is_replaced_and_the_reasons_are_kept(block, block_twin):
    # the softer the block, the more of its motions invert a cell: somewhere here some do, some do not
    config = DemonstrationConfig(frames=40, attempts=6)
    for modulus_pa in (480.0, 460.0, 440.0, 420.0, 400.0, 380.0):
        soft = block_twin.with_parameters(youngs_modulus_pa=modulus_pa)
        for seed in range(4):
            try:
                arrays, attributes = make_episode(block, soft, config, seed)
            except SimulationError:
                continue
            if attributes["rejected"]:
                first = attributes["rejected"][0]
                assert first["kind"] and attributes["tries"] == len(attributes["rejected"]) + 1
                assert first["seed"] == seed and any(c.isdigit() for c in first["reason"])
                assert attributes["seed"] == derived_seed(seed, len(attributes["rejected"]))
                assert np.isfinite(arrays["particles"]).all()
                return
    pytest.fail("no soft block rejected one motion and took another")


def test_after_the_last_attempt_the_reason_is_raised(block, block_twin):
    jelly = block_twin.with_parameters(youngs_modulus_pa=100.0)
    with pytest.raises(EpisodeRejected, match=r"all 2 tries were rejected \(\d x .*frame \d"):
        make_episode(block, jelly, DemonstrationConfig(frames=40, attempts=2), 0)


def test_material_that_leaves_the_workspace_is_refused_with_its_numbers(block, block_twin):
    plan = plan_episode(block, block_twin, CONFIG, 1)
    particles = np.repeat(block_twin.particles_start[None], 12, axis=0)
    check_episode(particles, plan)
    particles[5, 3] += [0.0, 0.0, -9.0]
    with pytest.raises(ParticlesLeftTheGrid, match=r"1 of .* leave the workspace at frame 5 of 12"):
        check_episode(particles, plan)
    particles[2, 0, 0] = np.nan
    with pytest.raises(UnstableSimulation, match=r"1 of .* not finite at frame 2 of 12"):
        check_episode(particles, plan)


def test_a_scene_without_controllers_is_refused(block, block_twin):
    with pytest.raises(SceneUnsupported, match="no controllers"):
        plan_episode(block, replace(block_twin, controller_groups=(), held_nodes=()), CONFIG, 0)


def test_derived_seeds_differ_and_fit_json_numbers():
    seeds = {derived_seed(s, i) for s in range(30) for i in range(30)}
    assert len(seeds) == 900
    assert max(seeds) < 2**53


def test_unusable_settings_are_refused():
    with pytest.raises(ValueError, match="1 frames"):
        DemonstrationConfig(frames=1)
    with pytest.raises(ValueError, match=r"replay share 1\.5"):
        DemonstrationConfig(replay_share=1.5)
