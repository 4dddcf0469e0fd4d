"""What the twin of an episode is made of: features, baselines, friction, and strengths within their intervals."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from physworld.demonstrate import DemonstrationConfig, StrengthRange, make_episode, plan_episode
from physworld.demonstrate.perturbation import check_field
from physworld.demonstrate.properties import draw_properties, draw_strength, property_field, ranges_of
from physworld.demonstrate.side_by_side import make_episodes
from physworld.effects.registry import effect
from physworld.errors import BatchRefused, SceneUnsupported, UnstableSimulation
from physworld.scene import Ground
from physworld.twin.build import build_twin

DRAG = StrengthRange("air_drag_linear", "rate_per_s", 2.0, 1.0, 3.5)


def drawn(scene, twin, seed=0, **settings):
    return draw_properties(scene, twin, DemonstrationConfig(**settings), np.random.default_rng(seed))


def test_each_perturbation_is_what_it_is_called(block, block_twin):
    fields = {
        kind: drawn(block, block_twin, perturbation=kind).fields for kind in ("p3", "uniform", "random")
    }
    assert not np.ptp(fields["uniform"], axis=0).any() and fields["uniform"].any()
    rough = {kind: drawn(block, block_twin, perturbation=kind).roughness[0] for kind in fields}
    # neighbours of independent draws differ by √2 σ, those of a field over parts by a fraction of σ
    assert rough["random"] == pytest.approx(np.sqrt(2.0), rel=0.15)
    assert rough["p3"] < 0.7
    assert not drawn(block, block_twin, perturbation="none").fields.any()


def test_only_the_properties_that_are_named_are_perturbed(block, block_twin):
    stiffness = drawn(block, block_twin, properties=("stiffness",)).fields
    assert stiffness[:, 0].any() and not stiffness[:, 1].any()
    density = drawn(block, block_twin, properties=("density",)).fields
    assert density[:, 1].any() and not density[:, 0].any()
    assert not drawn(block, block_twin, properties=()).fields.any()


def test_friction_is_a_field_over_the_ground(held_block):
    scene = held_block(ground=True)
    twin = build_twin(scene, particle_budget=200)
    seen = [drawn(scene, twin, seed, properties=("friction",)) for seed in range(200)]
    fields = np.stack([one.fields[:, 2] for one in seen])
    assert fields.std() == pytest.approx(0.2, rel=0.15)
    assert np.abs(fields).max() <= 0.6 and np.ptp(fields, axis=1).min() > 0.0
    assert all(one.roughness[2] < 0.7 for one in seen)  # neighbours differ by a fraction of σ
    assert not any(one.fields[:, :2].any() or one.parameters for one in seen)
    said = seen[0].attributes()
    assert said["log_friction_mean"] == pytest.approx(fields[0].mean())
    with pytest.raises(UnstableSimulation, match="the bound is"):
        check_field(fields[0] + 0.6, 0.2, np.zeros((0, 2), dtype=int), None)


def test_the_other_baselines_of_friction_are_what_they_are_called(held_block):
    scene = held_block(ground=True)
    twin = build_twin(scene, particle_budget=200)
    uniform = drawn(scene, twin, properties=("friction",), perturbation="uniform")
    assert np.ptp(uniform.fields[:, 2]) == 0.0 and uniform.fields[0, 2] != 0.0
    assert drawn(scene, twin, perturbation="p3").fields.shape[1] == 2  # not among the defaults


def test_friction_is_one_factor_where_the_contact_knows_one(held_block):
    scene = held_block(ground=True)
    twin = replace(build_twin(scene, particle_budget=200), formulation="updated_lagrangian")
    seen = [drawn(scene, twin, seed, properties=("friction",)) for seed in range(200)]
    factors = np.log([one.parameters["ground_friction"] / twin.ground_friction for one in seen])
    assert factors.std() == pytest.approx(0.2, rel=0.2)
    assert seen[0].twin(twin).ground_friction == seen[0].parameters["ground_friction"]
    assert not any(one.fields.any() for one in seen)


def test_a_field_of_friction_acts_on_what_slides(held_block):
    """A block that is dragged over the ground: rough places lag behind what the same block does on an even ground."""
    scene = held_block(ground=True)
    scene = replace(scene, ground=Ground(0.001))
    twin = build_twin(scene, particle_budget=200)
    config = DemonstrationConfig(frames=12, properties=("friction",), property_sigma=0.5, replay_share=0.0)
    seeds = [
        seed for seed in range(40) if np.ptp(plan_episode(scene, twin, config, seed).drawn.fields[:, 2]) > 1.0
    ]
    arrays, attributes = make_episode(scene, twin, config, seeds[0])
    assert arrays["properties"].shape == (len(twin.particles_rest), 3)
    even, _ = make_episode(scene, twin, replace(config, perturbation="none"), seeds[0])
    np.testing.assert_array_equal(arrays["controllers"], even["controllers"])
    assert np.abs(arrays["particles"] - even["particles"]).max() > 1e-5
    json.dumps(attributes)


def test_without_a_ground_there_is_no_friction_to_perturb(block, block_twin):
    assert drawn(block, block_twin, properties=("friction",)).parameters == {}


def test_supplied_features_are_asked_for_and_found(block, block_twin):
    with pytest.raises(SceneUnsupported, match="has no part_features"):
        drawn(block, block_twin, features="supplied")
    volume = block_twin.particles_start
    halves = (volume[:, :1] > 0.1).astype(float)
    scene = replace(block, rest_volume_points=volume, part_features=halves)
    config = DemonstrationConfig(length_scale=0.2)
    field = draw_properties(scene, block_twin, config, np.random.default_rng(0)).fields[:, 0]
    assert np.ptp(field[volume[:, 0] > 0.1]) < 1e-9 < np.ptp(field)
    geometric = property_field(scene, block_twin, replace(config, features="geometric"))
    assert geometric is property_field(block, block_twin, config)  # the same law, made once


def test_a_length_in_space_makes_the_field_vary_faster(block, block_twin):
    smooth = drawn(block, block_twin, 3).roughness[0]
    assert drawn(block, block_twin, 3, space_scale=0.15).roughness[0] > 1.5 * smooth


def test_strengths_stay_within_their_intervals_and_vary():
    generator = np.random.default_rng(0)
    values = np.array([draw_strength(DRAG, generator) for _ in range(4000)])
    assert values.min() >= 1.0 and values.max() <= 3.5
    # σ is 2.5/3.92 = 0.64; the lower end cuts at 1.57 σ, the upper one at 2.35 σ
    assert values.mean() == pytest.approx(2.0, abs=0.1)
    assert values.std() == pytest.approx(0.57, rel=0.1)
    assert draw_strength(replace(DRAG, low=2.0, high=2.0), generator) == 2.0
    with pytest.raises(ValueError, match=r"interval 2\.5 to 3\.5"):
        replace(DRAG, low=2.5)


def test_an_effect_is_simulated_with_the_strength_that_is_recorded(block, block_twin):
    heavy = block_twin.with_effect(effect("air_drag_linear", rate_per_s=2.0))
    config = DemonstrationConfig(frames=8, perturbation="none", replay_share=0.0, strengths=(DRAG,))
    arrays, attributes = make_episode(block, heavy, config, 5)
    strength = attributes["effect_strengths"]["air_drag_linear.rate_per_s"]
    assert 1.0 <= strength <= 3.5 and strength != 2.0
    assert json.loads(json.dumps(attributes)) == attributes
    plan = plan_episode(block, heavy, config, 5)
    own = block_twin.with_effect(effect("air_drag_linear", rate_per_s=strength))
    for twin, same in ((own, True), (block_twin, False)):
        particles = twin.simulate(plan.control_times, plan.control_points, plan.times, from_rest=True)
        assert bool(np.abs(particles - arrays["particles"]).max() < 1e-7) == same


def test_strengths_that_the_twin_lacks_are_left_out(block_twin):
    heavy = block_twin.with_effect(effect("air_drag_linear", rate_per_s=2.0))
    other = replace(DRAG, effect="wind", name="speed_x_m_s")
    assert ranges_of(heavy, (DRAG, other)) == [DRAG]
    assert ranges_of(block_twin, (DRAG,)) == []
    below = replace(DRAG, low=-4.0)  # drag does not push
    assert ranges_of(heavy, (below,))[0].low >= 0.0


def test_episodes_with_their_own_effects_are_not_made_side_by_side(block, block_twin):
    with pytest.raises(BatchRefused, match="1 strengths"):
        make_episodes(block, block_twin, DemonstrationConfig(strengths=(DRAG,)), [0])
