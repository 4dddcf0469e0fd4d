"""Grips that let go and take hold again: free fall, a cantilever, a hand that closes elsewhere, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import GRAVITY, made_scene
from tiny_scene import tiny_scene
from two_handed_bar import BAR, TIMES, hand, opened
from two_handed_bar import two_handed_bar as bar

from physworld.effects.registry import effect
from physworld.errors import BatchRefused, EffectRefused, NotDifferentiable, SceneUnsupported
from physworld.scene import Body, Grip
from physworld.twin.batch import Episode, simulate_batch
from physworld.twin.build import build_twin
from physworld.twin.gradient import TwinRun
from physworld.twin.live import LiveTwin
from physworld.twin.openings import Opening, holding
from physworld.twin.twin import Twin

OPEN, SHUT = 0.2, 0.3


def run(twin: Twin, controls: np.ndarray | None = None) -> np.ndarray:
    still = np.repeat(twin.controllers_start[None], len(TIMES), axis=0)
    return twin.simulate_nodes(TIMES, still if controls is None else controls, TIMES)


def centre(twin: Twin, nodes: np.ndarray) -> np.ndarray:
    """Centre of mass (T, 3) [m]."""
    mass = twin.lattice.lumped(twin.particle_mass)
    middle: np.ndarray = np.einsum("n,tni->ti", mass, nodes) / mass.sum()
    return middle


def test_a_body_that_both_hands_let_go_of_falls_freely_with_the_speed_that_they_gave_it() -> None:
    scene = bar()
    scene = replace(scene, grips=tuple(opened(grip, (OPEN, np.inf)) for grip in scene.grips))
    twin = build_twin(scene, 200).with_parameters(**BAR)
    speed = np.array([0.1, 0.0, 0.2])
    controls = twin.controllers_start + speed * TIMES[:, None, None]
    beside = np.array([0.0, OPEN - 1e-4, OPEN])
    _, earlier, later = centre(twin, twin.simulate_nodes(TIMES, controls, beside))
    falling = centre(twin, run(twin, controls))[TIMES >= OPEN + 0.02]
    acceleration = np.diff(falling, 2, axis=0) * 60.0**2
    assert np.abs(acceleration - GRAVITY).max() < 1e-6
    along = (later - earlier)[0] / 1e-4
    assert along > 0.2 * speed[0]
    assert np.abs(np.diff(falling[:, 0]) * 60.0 - along).max() < 0.05 * along


def test_an_end_that_is_let_go_of_swings_as_a_cantilever_and_is_held_where_it_is_found() -> None:
    scene = bar()
    let_go = replace(scene, grips=(scene.grips[0], opened(scene.grips[1], (OPEN, SHUT))))
    twin = build_twin(let_go, 200).with_parameters(**BAR)
    held = build_twin(scene, 200).with_parameters(**BAR)
    cantilever = replace(
        held,
        controller_groups=held.controller_groups[:1],
        held_nodes=held.held_nodes[:1],
        grip_regions=held.grip_regions[:1],
    )
    nodes, both = run(twin), run(held)
    before = TIMES < OPEN + 1e-9
    assert np.abs(nodes[before] - both[before]).max() < 1e-9
    # the same bar without a second hand, begun from where and how fast it was let go
    at = int(np.argmax(TIMES >= OPEN - 1e-9))
    while_open = (TIMES >= OPEN - 1e-9) & (TIMES <= SHUT + 1e-9)
    beside = np.array([0.0, OPEN - 1e-4, OPEN + 1e-4])
    _, earlier, later = held.simulate_nodes(TIMES, np.repeat(scene.controllers[:1], 31, axis=0), beside)
    body = replace(cantilever.body, start=nodes[at], start_velocity=(later - earlier) / 2e-4)
    free = replace(cantilever, body=body).simulate_nodes(
        TIMES[while_open] - OPEN,
        np.repeat(scene.controllers[:1], while_open.sum(), axis=0),
        TIMES[while_open] - OPEN,
    )
    free, freed = cantilever.particles_at(free), twin.particles_at(nodes[while_open])
    moved = np.abs(freed - freed[0]).max()
    assert moved > 0.01
    assert np.abs(free - freed).max() < 0.01 * moved
    end = twin.held_nodes[1]
    after = nodes[TIMES >= SHUT - 1e-9][:, end]
    assert np.abs(after - after[0]).max() < 1e-9
    assert np.abs(after[0] - nodes[0, end]).max() > 0.01


def test_what_is_taken_hold_of_again_moves_rigidly_with_the_hand() -> None:
    scene = bar()
    twin = build_twin(replace(scene, grips=(scene.grips[0], opened(scene.grips[1], (OPEN, SHUT)))), 200)
    controls = np.repeat(twin.controllers_start[None], len(TIMES), axis=0)
    controls[:, 4:] += np.array([0.0, 0.05, 0.0]) * np.clip(TIMES - SHUT, 0.0, None)[:, None, None]
    end = run(twin.with_parameters(**BAR), controls)[:, twin.held_nodes[1]]
    shut = int(np.argmax(TIMES >= SHUT - 1e-9))
    shift = controls[shut:, 4] - controls[shut, 4]
    assert np.abs(end[shut:] - end[shut] - shift[:, None]).max() < 1e-9


def test_a_hand_with_a_reach_closes_on_what_lies_within_it_and_on_nothing_elsewhere() -> None:
    scene = bar()
    near = opened(replace(scene.grips[1], region_min_m=None, region_max_m=None), (0.0, SHUT), radius_m=0.03)
    for middle, found in ((0.1, True), (0.5, False)):
        there = np.concatenate([hand(0.0), hand(middle)])
        moved = replace(
            scene, controllers=np.repeat(there[None], len(TIMES), axis=0), grips=(scene.grips[0], near)
        )
        twin = build_twin(moved, 200).with_parameters(**BAR)
        assert len(twin.held_nodes[1]) == 0
        nodes = run(twin)
        still = np.abs(np.diff(nodes[TIMES >= SHUT - 1e-9], axis=0)).max(axis=(0, 2)) < 1e-9
        still[twin.held_nodes[0]] = False
        assert still.any() == found
        if found:
            assert np.abs(nodes[-1, still, 0] - 0.1).max() < 0.06


def test_a_measured_rope_is_let_go_of_and_caught() -> None:
    points = np.stack([0.06 * np.arange(11), 0.01 * np.sin(np.arange(11)), np.full(11, 0.5)], axis=1)
    body = Body(segment_rest_lengths_m=np.full(10, 0.06), radius_m=0.005)
    grips = (Grip((0,)), Grip((1,), open_s=((OPEN, SHUT),)))
    scene = made_scene(points, "rope", points[[0, -1]], len(TIMES), grips=grips, body=body, times=TIMES)
    twin = build_twin(scene, 60)
    assert twin.formulation == "discrete_rod"
    nodes, end = run(twin), twin.held_nodes[1]
    caught = int(np.argmax(TIMES >= SHUT - 1e-9))
    assert np.abs(nodes[TIMES <= OPEN, end[0]] - nodes[0, end[0]]).max() < 1e-9
    assert np.abs(nodes[caught:, end] - nodes[caught, end]).max() < 1e-9
    fell = nodes[caught, end[0], 2] - nodes[0, end[0], 2]
    assert -0.5 * 9.81 * 0.1**2 * 1.6 < fell < -0.5 * 9.81 * 0.1**2 * 0.6


def test_which_grips_hold_is_known_at_every_tick_and_survives_storage() -> None:
    scene = bar()
    twin = build_twin(replace(scene, grips=(scene.grips[0], opened(scene.grips[1], (OPEN, SHUT)))), 100)
    assert twin.openings == (None, Opening(((OPEN, SHUT),)))
    table = holding(twin, TIMES)
    assert table[:, 0].all() and (table[:, 1] == ~((TIMES >= OPEN) & (TIMES < SHUT))).all()
    again = Twin.from_arrays(twin.to_arrays())
    assert again.openings == twin.openings
    assert np.array_equal(run(again), run(twin))


def test_what_cannot_follow_a_hand_that_opens_says_so() -> None:
    scene = bar()
    scene = replace(scene, grips=(scene.grips[0], opened(scene.grips[1], (OPEN, SHUT))))
    twin = build_twin(scene, 100).with_parameters(**BAR)
    still = np.repeat(twin.controllers_start[None], len(TIMES), axis=0)
    with pytest.raises(NotDifferentiable, match="let go"):
        TwinRun(twin, TIMES, still, TIMES)
    with pytest.raises(BatchRefused, match="let go in 2 of 2"):
        simulate_batch(twin, [Episode(TIMES, still, TIMES)] * 2)
    with pytest.raises(SceneUnsupported, match="open and close"):
        LiveTwin(twin, 1 / 60)
    with pytest.raises(EffectRefused, match="let go"):
        twin.with_effect(effect("grip_slip", compliance_m_n=1e-3))
    with pytest.raises(SceneUnsupported, match="1 of 2 grips let go"):
        build_twin(scene, 100, formulation="updated_lagrangian")


def test_a_twin_whose_grips_always_hold_is_what_it_was() -> None:
    assert build_twin(tiny_scene(), 60).openings == ()
    assert "openings" not in str(build_twin(tiny_scene(), 60).to_arrays()["facts"])


def test_a_rope_whose_grip_has_a_reach_starts_as_fast_as_any_other() -> None:
    points = np.stack([0.06 * np.arange(11), 0.01 * np.sin(np.arange(11)), np.full(11, 0.5)], axis=1)
    body = Body(segment_rest_lengths_m=np.full(10, 0.06), radius_m=0.005)
    risen = []
    for reach in (None, 0.04):
        grips = (Grip((0,)), Grip((1,), open_s=((OPEN, SHUT),), radius_m=reach))
        scene = made_scene(points, "rope", points[[0, -1]], len(TIMES), grips=grips, body=body, times=TIMES)
        twin = build_twin(scene, 60)
        speed = np.zeros_like(twin.body.start)
        speed[5] = [0.0, 0.0, 1.0]
        nodes = run(replace(twin, body=replace(twin.body, start_velocity=speed)))
        risen.append(nodes[1, 5, 2] - nodes[0, 5, 2])
    assert risen[0] > 1e-3 and abs(risen[1] - risen[0]) < 0.1 * risen[0]


def test_a_tick_in_which_a_grip_is_open_for_a_part_is_none_that_it_holds() -> None:
    ticks = np.arange(120) / 30.0
    assert np.flatnonzero(~Opening(((3.7, 3.8),)).closed(ticks)).tolist() == [111, 112, 113]
    assert np.flatnonzero(~Opening(((0.21, 0.22),)).closed(ticks)).tolist() == [6]
    assert np.flatnonzero(~Opening(((0.0, np.inf),)).closed(ticks)).tolist() == list(range(119))


def test_a_grip_that_lets_go_after_the_last_frame_never_does() -> None:
    scene = bar()
    late = replace(scene, grips=(scene.grips[0], opened(scene.grips[1], (50.0, 60.0))))
    assert build_twin(late, 100).openings == ()
