"""Which ropes carry twist, what they keep of it, and that all others are the same to the bit."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from made_scene import made_scene
from scipy.spatial.transform import Rotation

from physworld.calibrate.parameters import parameters_of
from physworld.effects.registry import effect
from physworld.engine.thin.twist import BoundTwist, Twist
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import SceneUnsupported
from physworld.scene import UNDEFORMED_AT_REST, Body, Scene
from physworld.twin.batch import Episode, simulate_batch
from physworld.twin.build import build_twin
from physworld.twin.gradient import TwinRun, parameter
from physworld.twin.twin import Twin

LENGTH, ARM = 0.4, 0.02
CROSS = np.array([[0, ARM, 0], [0, -ARM, 0], [0, 0, ARM], [0, 0, -ARM]])
LINE = np.array([[-0.01, 0, 0], [0.0, 0, 0], [0.01, 0, 0]])
FRAMES = 16


def rope(first: np.ndarray = CROSS, last: np.ndarray = CROSS, turns: float = 1.5, **body: object) -> Scene:
    """A straight rope whose last hand turns about it; hands are points (k, 3) about the ends."""
    s = np.linspace(0, LENGTH, 9)
    points = np.stack([s, 0 * s, 0 * s], axis=1)
    scene = made_scene(points, "rope", np.zeros((len(first) + len(last), 3)), FRAMES,
                       initial_state=UNDEFORMED_AT_REST, body=Body(length_m=LENGTH, radius_m=0.004),
                       gravity_m_s2=np.zeros(3), noise_sigma_m=2e-4, declared={"body": body})  # fmt: skip
    angle = 2 * np.pi * turns * np.linspace(0, 1, FRAMES)
    spin = Rotation.from_rotvec(angle[:, None] * np.array([1.0, 0, 0])).as_matrix()
    far = np.array([LENGTH, 0.0, 0.0])
    hands = [np.repeat(first[None], FRAMES, axis=0), np.einsum("tij,kj->tki", spin, last) + far]
    return replace(scene, controllers=np.concatenate(hands, axis=1))


def terms(twin: Twin, scene: Scene) -> tuple[object, ...]:
    return twin.integration(*scene.control_track(), scene.times).problem.terms


def test_a_rope_between_two_hands_is_twisted_by_their_turn() -> None:
    scene = rope()
    twin = build_twin(scene)
    assert twin.turning == (0, 1)
    assert "twist is carried between grips 0, 1" in twin.body.notes
    run = twin.integration(*scene.control_track(), scene.times)
    solver = TotalLagrangian(run.problem)
    solver.run(twin.body.start, run.velocity, run.held, run.knots)
    (bound,) = solver.terms
    assert isinstance(bound, BoundTwist)
    assert bound.angles_rad[0] == pytest.approx(3 * np.pi, rel=5e-3)  # at the last substep's start
    held = twin.lattice.cells[:, 0]
    whole = [np.isin(twin.lattice.cell_nodes, nodes).all(axis=1) for nodes in twin.held_nodes]
    free = (held[whole[1]].min() - held[whole[0]].max() - 1) * twin.lattice.spacing[0]
    expected = twin.law.torsion_ratio * twin.law.bending_n_m2 * bound.angles_rad[0] / free
    assert bound.moments_n_m[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("last", "why"),
    [
        (LINE, "3 control points lie on a line"),
        (CROSS[:2], "2 control points fix no turn"),
        (np.array([[0.0, 0.0, 0.0]]), "1 control points fix no turn"),
        (0.05 * CROSS, "10 sigma of noise"),
    ],
)
def test_a_hand_that_shows_no_turn_prescribes_none_and_says_so(last: np.ndarray, why: str) -> None:
    twin = build_twin(rope(last=last))
    assert any(note.startswith("grip 1 prescribes no twist") and why in note for note in twin.body.notes)
    assert len(twin.turning) < 2


def test_a_rope_with_a_free_end_or_a_hand_without_turn_is_the_same_to_the_bit() -> None:
    scene = rope(last=LINE)
    twin = build_twin(scene)
    assert not any(isinstance(term, Twist) for term in terms(twin, scene))
    track = scene.control_track()
    first = twin.simulate_nodes(*track, scene.times)
    other = twin.with_parameters(torsion_ratio=0.0).simulate_nodes(*track, scene.times)
    assert np.array_equal(first, other)
    one_hand = replace(scene, controllers=scene.controllers[:, :4])
    assert terms(build_twin(one_hand), one_hand) == ()


def test_what_a_twin_knows_of_twist_survives_storage_and_older_twins_carry_none() -> None:
    scene = rope(torsion_ratio=0.4)
    twin = build_twin(scene)
    assert twin.parameters["torsion_ratio"] == 0.4
    arrays = twin.with_parameters(torsion_ratio=0.5).to_arrays()
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    buffer.seek(0)
    back = Twin.from_arrays(dict(np.load(buffer)))
    assert back.law.torsion_ratio == 0.5
    assert back.turning == (0, 1)
    assert isinstance(terms(back, scene)[0], Twist)
    facts = json.loads(str(arrays["facts"]))
    del facts["turning"], facts["law_parameters"]["torsion_ratio"]
    older = Twin.from_arrays({**arrays, "facts": np.array(json.dumps(facts))})
    assert terms(older, scene) == ()


def test_torsion_is_freed_only_where_it_counts() -> None:
    names = [[p.name for p in parameters_of(build_twin(s), False)] for s in (rope(), rope(last=LINE))]
    assert "torsion_ratio" in names[0]
    assert "torsion_ratio" not in names[1]


@pytest.mark.parametrize("value", [-1.0, "stiff", True])
def test_a_torsion_that_is_no_ratio_is_refused(value: object) -> None:
    with pytest.raises(SceneUnsupported, match="torsion_ratio"):
        build_twin(rope(torsion_ratio=value))


def test_a_gradient_by_the_torsion_is_that_of_whole_runs() -> None:
    scene = rope(turns=1.9)
    twin = buckling(scene)
    track = scene.control_track()
    step = 0.9 * TwinRun(twin, *track, scene.times).time_step_s
    run = TwinRun(twin, *track, scene.times, time_step_s=step)
    weights = np.random.default_rng(0).normal(size=run.tracks.shape)
    _, found = run.gradient(weights, {"torsion": parameter(twin, "torsion_ratio")})
    h, value = 1e-3, twin.law.torsion_ratio
    ends = [
        TwinRun(
            twin.with_parameters(torsion_ratio=value + s * h), *track, scene.times, time_step_s=step
        ).tracks
        for s in (1, -1)
    ]
    expected = np.sum(weights * (ends[0] - ends[1])) / (2 * h)
    assert found["torsion"] == pytest.approx(expected, rel=1e-3)


def test_twisted_ropes_side_by_side_are_those_alone() -> None:
    scenes = [rope(turns=turns) for turns in (1.9, -1.2)]
    twin = buckling(scenes[0])
    track = [scene.control_track() for scene in scenes]
    step = 0.5 * TwinRun(twin, *track[0], scenes[0].times).time_step_s
    outcomes = simulate_batch(twin, [Episode(*t, scenes[0].times) for t in track], time_step_s=step)
    for outcome, (times, controls) in zip(outcomes, track, strict=True):
        alone = TwinRun(twin, times, controls, scenes[0].times, time_step_s=step)
        assert np.array_equal(outcome.trusted(), alone.nodes)
    assert np.abs(outcomes[0].trusted() - outcomes[1].trusted()).max() > 1e-4


def test_a_grip_that_gives_still_twists() -> None:
    scene = rope(turns=1.9)
    twin = buckling(scene)
    assert any(isinstance(term, Twist) for term in terms(twin, scene))
    soft = twin.with_effect(effect("grip_slip", compliance_m_n=1e-3))
    bent = [
        t.simulate_nodes(*scene.control_track(), scene.times)
        for t in (soft, soft.with_parameters(torsion_ratio=0.0))
    ]
    assert np.isfinite(bent[0]).all()
    assert np.abs(bent[0] - bent[1]).max() > 1e-4


def buckling(scene: Scene) -> Twin:
    """A rope that sags a little, so that twist bends it at once."""
    twin = build_twin(scene).with_parameters(bending_n_m2=2e-3)
    return replace(twin, gravity_m_s2=np.array([0.0, 0.0, -9.81]))
