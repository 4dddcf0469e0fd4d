"""Which twins touch themselves, what they keep of it, and that all others are the same to the bit."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from made_scene import GRAVITY, box_body, made_scene, recorded_by

from physworld.calibrate import CalibrationConfig, calibrate
from physworld.engine.thin.self_contact import SelfContact
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import NotDifferentiable, SceneUnsupported
from physworld.evaluate.numerics import free_swing
from physworld.scene import Body, Ground, Scene
from physworld.twin.batch import Episode, simulate_batch
from physworld.twin.build import PRIOR_FRICTION, build_twin
from physworld.twin.gradient import TwinRun
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

LENGTH, RADIUS, FRAMES = 0.6, 0.006, 13


def hairpin(**body: object) -> Scene:
    """A rope that starts as a long bow over itself and falls; one hand holds its low end."""
    s = np.linspace(0, LENGTH, 25)
    bend, leg = 0.03, 0.2
    angle = np.clip((s - leg) / bend, 0, np.pi)
    x = np.minimum(s, leg) + bend * np.sin(angle) - np.maximum(s - leg - np.pi * bend, 0)
    z = RADIUS + bend * (1 - np.cos(angle))
    points = np.stack([x, 0 * s, z], axis=1)
    return made_scene(
        points, "rope", points[:2], FRAMES, body=Body(
            radius_m=RADIUS, segment_rest_lengths_m=tuple(np.diff(s)), density_kg_m3=600.0
        ), ground=Ground(0.0, 0.4), gravity_m_s2=GRAVITY, declared={"body": body},
    )  # fmt: skip


def nearest(twin: Twin, nodes: np.ndarray) -> float:
    """Least distance in the run of two places of a rope that are far along it [m]."""
    along = np.linspace(0, LENGTH, 301)
    far = np.abs(along[:, None] - along) > 4 * twin.lattice.spacing[0]
    row = twin.lattice.interpolation(along[:, None])
    return min(float(np.linalg.norm((c := row @ x)[:, None] - c, axis=-1)[far].min()) for x in nodes)


def test_a_rope_touches_itself_where_its_scene_says_so() -> None:
    plain, scene = hairpin(), hairpin(self_contact=True, self_friction=0.25)
    without, twin = build_twin(plain), build_twin(scene)
    assert without.self_friction is None
    assert "self_friction" not in without.parameters
    assert twin.self_friction == twin.parameters["self_friction"] == 0.25
    assert any("it touches itself 0.012 m apart, with friction 0.25 (declared)" in n for n in twin.body.notes)
    run = twin.integration(*scene.control_track(), scene.times)
    assert [type(t).__name__ for t in run.problem.terms] == ["GroundContact", "SelfContact"]
    paths = [t.simulate_nodes(*scene.control_track(), scene.times) for t in (without, twin)]
    assert nearest(without, paths[0]) < RADIUS
    assert nearest(twin, paths[1]) > 0.98 * 2 * RADIUS
    for other in ({}, {"self_contact": False, "self_friction": 0.3}):
        untouched = build_twin(hairpin(**other))
        assert np.array_equal(untouched.simulate_nodes(*scene.control_track(), scene.times), paths[0])


def test_what_a_twin_keeps_of_it() -> None:
    scene = hairpin(self_contact=True)
    twin = build_twin(scene)
    assert twin.self_friction == PRIOR_FRICTION
    changed = twin.with_parameters(self_friction=0.1)
    with pytest.raises(KeyError, match="self_friction"):
        build_twin(hairpin()).with_parameters(self_friction=0.1)
    buffer = io.BytesIO()
    np.savez(buffer, **changed.to_arrays())
    buffer.seek(0)
    back = Twin.from_arrays(dict(np.load(buffer)))
    assert back.self_friction == 0.1
    (contact,) = [t for t in back.integration(*scene.control_track(), scene.times).problem.terms
                  if isinstance(t, SelfContact)]  # fmt: skip
    assert (contact.friction, contact.thickness_m) == (0.1, 2 * RADIUS)
    assert np.array_equal(contact.held, np.unique(np.concatenate(back.held_nodes)))
    swing = free_swing(scene, changed)
    assert np.isfinite(swing.equivalent_drag_per_s)


def test_episodes_side_by_side_differ_in_their_friction() -> None:
    scene = hairpin(self_contact=True)
    twin = build_twin(scene)
    times, points = scene.control_track()
    frictions = (0.0, 0.8)
    episodes = [Episode(times, points, scene.times, parameters={"self_friction": mu}) for mu in frictions]
    together = [outcome.trusted() for outcome in simulate_batch(twin, episodes)]
    for mu, nodes in zip(frictions, together, strict=True):
        run = twin.with_parameters(self_friction=mu).integration(times, points, scene.times)
        alone = TotalLagrangian(run.problem).run(twin.body.start, run.velocity, run.held, run.knots)
        assert np.array_equal(run.at_frames(twin.body.start, alone), nodes)
    assert np.abs(together[0] - together[1]).max() > 1e-4


def test_it_is_calibrated_by_simulations_and_has_no_gradient() -> None:
    scene = hairpin(self_contact=True)
    truth = build_twin(scene)
    truth = truth.with_parameters(bending_n_m2=3 * truth.law.bending_n_m2)
    seen = replace(recorded_by(truth, scene, 1e-4), declared=scene.declared)
    fitted = calibrate(seen, CalibrationConfig(max_simulations=12))
    assert fitted.twin.self_friction == PRIOR_FRICTION
    assert fitted.parameters["self_friction"].value == PRIOR_FRICTION
    with pytest.raises(NotDifferentiable, match="SelfContact, has no derivative"):
        TwinRun(fitted.twin, *scene.control_track(), scene.times)


@pytest.mark.parametrize(
    ("body", "radius", "why"),
    [
        ({"self_contact": True, "self_friction": -0.1}, RADIUS, r"body.self_friction is -0\.1"),
        ({"self_contact": True, "self_friction": "rough"}, RADIUS, "body.self_friction is 'rough'"),
        ({"self_contact": True}, 5e-5, r"layers 0\.0001 m thick on cells of .* m: at least"),
    ],
)
def test_what_makes_no_sense_is_refused(body: dict, radius: float, why: str) -> None:
    scene = hairpin(**body)
    with pytest.raises(SceneUnsupported, match=why):
        build_twin(replace(scene, body=replace(scene.body, radius_m=radius)))


def test_a_solid_that_cannot_touch_itself_says_so() -> None:
    corners = np.stack(np.meshgrid(*[[0.0, 0.1]] * 3), axis=-1).reshape(-1, 3)
    scene = made_scene(
        corners,
        "block",
        corners[:4],
        body=box_body((0, 0, 0), (0.1, 0.1, 0.1)),
        declared={"body": {"self_contact": True}},
    )
    said = "passes through itself"
    total = build_twin(scene, 200, formulation="total_lagrangian")
    assert total.self_friction is None
    assert any(said in note for note in total.body.notes)
    assert not any(said in note for note in build_twin(scene, 200).body.notes)
