"""Gradients through grips that hold softly: fields, scalars and paths against central differences.

A block held by a quarter of its section is shaken for 400 substeps. Solids strain in single precision, which limits the
differences; directions are those of the gradient itself or one-signed, so nothing cancels.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.effects.registry import effect
from physworld.engine.gradients.soft_grips_derivatives import same_soft_grips
from physworld.engine.problem import HeldNodes
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import NotDifferentiable
from physworld.scene import Grip
from physworld.twin.build import build_twin
from physworld.twin.gradient import Neighbours, TwinRun, parameter, strength
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

SUBSTEPS, FRAMES = 400, 6
TOLERANCE = 1e-2
LOW, HIGH = np.array([0.0, -0.03, -0.03]), np.array([0.12, 0.03, 0.03])
SCALARS = ("youngs_modulus_pa", "poissons_ratio", "density_kg_m3", "viscosity_pa_s")
STRENGTHS = (
    ("actuation_lag", "lag_s", 5e-3),
    ("tether", "stiffness_n_m", 1.0),
    ("rest_shape", "strain_x", 0.02),
)


@cache
def held_twin() -> tuple[Twin, np.ndarray, np.ndarray]:
    """A block with friction, drag and soft grips on a quarter of its section, with its control track."""
    grip = np.array([[0.0, y, z] for y in (-0.02, 0.0) for z in (-0.02, 0.0)])
    points = [[0.12, y, z] for y in (-0.03, 0.03) for z in (-0.03, 0.03)]
    scene = made_scene(
        points, "block", grip, FRAMES, body=box_body(LOW, HIGH, density_kg_m3=500.0),
        grips=(Grip((0, 1, 2, 3), LOW, np.array([0.03, 0.0, 0.0])),),
    )  # fmt: skip
    shake = 0.01 * np.sin(20.0 * scene.times)[:, None, None] * np.array([0.3, 0.5, 1.0])
    twin = build_twin(scene, 256).with_parameters(youngs_modulus_pa=3e4, viscosity_pa_s=3.0)
    return replace(twin, grip_softness=0.16, air_drag_per_s=2.0), scene.times, grip + shake


@cache
def run_of(*effects: tuple[str, str, float]) -> TwinRun:
    twin, times, controls = with_effects(*effects)
    run = TwinRun(twin, times, controls, times, time_step_s=step())
    assert run.recorded.substeps.sum() == SUBSTEPS and same_soft_grips([run.recorded.problem])
    return run


def with_effects(*effects: tuple[str, str, float]) -> tuple[Twin, np.ndarray, np.ndarray]:
    twin, times, controls = held_twin()
    for name, which, value in effects:
        twin = twin.with_effect(effect(name, **{which: value}))
    return twin, times, controls


def step() -> float:
    times = held_twin()[1]
    return float(times[-1] - times[0]) / SUBSTEPS * (1 + 1e-9)


def weights_of(run: TwinRun) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.linspace(0.0, 1.0, FRAMES)[:, None, None] * (1.0 + rng.normal(size=run.tracks.shape))


def loss(twin: Twin, properties: np.ndarray | None = None) -> float:
    _, times, controls = held_twin()
    setting = twin.integration(times, controls, times, properties=properties)
    nodes = TotalLagrangian(setting.problem, step()).run(
        twin.body.start, setting.velocity, setting.held, setting.knots
    )
    return float(
        np.sum(weights_of(run_of()) * twin.observe(setting.at_frames(twin.body.start, nodes), times))
    )


@pytest.mark.parametrize("column", (0, 1))
def test_fields_through_soft_grips(column: int) -> None:
    twin = held_twin()[0]
    run = run_of()
    gradient, _ = run.gradient(weights_of(run))
    found = (gradient.log_stiffness, gradient.log_density)[column]
    for along in (found / np.abs(found).max(), np.ones(len(found))):
        change = np.zeros((len(found), 2))
        change[:, column] = 3e-3 * along
        expected = (loss(twin, change) - loss(twin, -change)) / 6e-3
        assert abs(expected) > 0.05 * np.linalg.norm(found) * np.linalg.norm(along)
        assert found @ along == pytest.approx(expected, rel=TOLERANCE)


@pytest.mark.parametrize("name", SCALARS)
def test_parameters_through_soft_grips(name: str) -> None:
    twin = held_twin()[0]
    run = run_of()
    _, found = run.gradient(weights_of(run), {name: parameter(twin, name)})
    value = twin.parameters[name]
    ends = [loss(twin.with_parameters(**{name: s * value})) for s in (1.01, 0.99)]
    assert found[name] == pytest.approx((ends[0] - ends[1]) / (0.02 * value), rel=TOLERANCE)


def test_the_softness_itself() -> None:
    twin = held_twin()[0]
    near = [replace(twin, grip_softness=s) for s in (0.162, 0.158)]
    run = run_of()
    _, found = run.gradient(weights_of(run), {"s": Neighbours(near[0], near[1], 0.004)})
    expected = (loss(near[0]) - loss(near[1])) / 0.004
    assert abs(expected) > 1e-3
    assert found["s"] == pytest.approx(expected, rel=TOLERANCE)


@pytest.mark.parametrize(("name", "which", "value"), STRENGTHS)
def test_strengths_of_effects_beside_soft_grips(name: str, which: str, value: float) -> None:
    twin = with_effects((name, which, value))[0]
    run = run_of((name, which, value))
    _, found = run.gradient(weights_of(run), {"s": strength(twin, name, which)})
    ends = [loss(with_effects((name, which, s * value))[0]) for s in (1.1, 0.9)]
    assert found["s"] == pytest.approx((ends[0] - ends[1]) / (0.2 * value), rel=TOLERANCE)


def test_gravity_drag_start_and_paths_through_soft_grips() -> None:
    run = run_of().recorded
    weights = np.linspace(0.0, 1.0, FRAMES)[:, None, None] * (
        1.0 + np.random.default_rng(4).normal(size=run.nodes.shape)
    )
    g = run.gradient(weights)
    grips = same_soft_grips([run.problem])[0]
    assert g.soft_grips is not None
    positions = g.soft_grips.positions / np.abs(g.soft_grips.positions).max()
    velocities = g.soft_grips.velocities / np.abs(g.soft_grips.velocities).max()

    def total(velocity: np.ndarray = run.velocity, **changes: object) -> float:
        problem = replace(run.problem, **changes)  # type: ignore[arg-type]
        nodes = TotalLagrangian(problem, step()).run(run.nodes[0], velocity, run.held, run.times)
        return float(np.sum(weights * nodes))

    def moved(s: float) -> dict[str, object]:
        held = grips.held
        path = HeldNodes(held.nodes, held.positions + s * positions, held.velocities + 10 * s * velocities)
        return {"terms": (*run.problem.terms[:-1], replace(grips, held=path))}

    kick, pull = g.v / np.abs(g.v).max(), g.gravity / np.abs(g.gravity).max()
    cases = {
        "gravity": (g.gravity @ pull, 0.3, lambda s: {"gravity_m_s2": run.problem.gravity_m_s2 + s * pull}),
        "drag": (g.drag, 0.3, lambda s: {"drag_per_s": run.problem.drag_per_s + s}),
        "v": (np.sum(g.v * kick), 3e-3, lambda s: {"velocity": run.velocity + s * kick}),
        "paths": (
            np.sum(g.soft_grips.positions * positions) + 10 * np.sum(g.soft_grips.velocities * velocities),
            1e-4, moved,
        ),
    }  # fmt: skip
    for name, (found, h, change) in cases.items():
        expected = (total(**change(h)) - total(**change(-h))) / (2 * h)
        assert found == pytest.approx(expected, rel=TOLERANCE), name


def test_running_every_frame_twice_takes_soft_grips_back_the_same() -> None:
    twin, times, controls = held_twin()
    run = run_of()
    again = TwinRun(twin, times, controls, times, time_step_s=step(), memory_mb=0.0)
    assert again.recorded.twice and not run.recorded.twice
    one, two = (r.gradient(weights_of(run))[0] for r in (run, again))
    assert two.soft_grips is not None and one.soft_grips is not None
    assert np.allclose(two.soft_grips.positions, one.soft_grips.positions, rtol=1e-9, atol=1e-15)
    assert np.allclose(two.log_stiffness, one.log_stiffness, rtol=1e-9, atol=1e-15)


def test_grips_that_hold_other_material_on_either_side_are_refused() -> None:
    twin = held_twin()[0]
    low, high = twin.grip_regions[0]
    wider = replace(twin, grip_regions=(np.array([low, high + np.array([0.02, 0.0, 0.0])]),))
    run = run_of()
    with pytest.raises(NotDifferentiable, match="which nodes"):
        run.gradient(weights_of(run), {"s": Neighbours(wider, wider, 0.02)})
    _, times, controls = held_twin()
    firm = TwinRun(replace(twin, grip_softness=0.0), times, controls, times[:2], time_step_s=step())
    with pytest.raises(NotDifferentiable, match="hold softly"):
        firm.gradient(np.ones_like(firm.tracks), {"s": Neighbours(twin, twin, 1.0)})
