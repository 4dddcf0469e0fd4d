"""Gradients by scalars of a twin against central differences: parameters of the law, and every effect's strengths."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "effects"))
from effect_twins import SCENES, TWINS

from physworld.calibrate.parameters import flow_law
from physworld.effects.registry import EFFECTS, effect
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import NotDifferentiable
from physworld.twin.build import build_twin
from physworld.twin.gradient import TwinRun, parameter, strength
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

FRAMES = 3
NOT_SMOOTH = {
    ("clamp_offset", "reach_m"),
    ("plasticity", "inverse_yield_per_pa"),
    ("plasticity", "yield_radius_m"),
}
BIG = {
    "air_drag_quadratic",
    "air_drag_linear",
    "wind",
    "viscosity_kelvin_voigt",
}  # small here: a large difference
CHEAP = {name: replace(twin, ground_height_m=None) for name, twin in TWINS.items()}
NO_GRADIENT = {"air_on_sheet"}  # its inertia takes from every other force, which reverse mode does not follow
STRENGTHS = [
    (shape, name, strength_.name)
    for shape, twin in CHEAP.items()
    for name, kind in EFFECTS.items()
    if kind.refuses(twin) is None and name not in NO_GRADIENT
    for strength_ in kind.strengths(twin)
    if strength_.gate and (name, strength_.name) not in NOT_SMOOTH
]


def run_of(twin: Twin, shape: str, step: float | None = None) -> TwinRun:
    scene = SCENES[shape]()
    return TwinRun(twin, *scene.control_track(), scene.times[:FRAMES], time_step_s=step)


def loss(twin: Twin, shape: str, weights: np.ndarray, step: float) -> float:
    scene = SCENES[shape]()
    setting = twin.integration(*scene.control_track(), scene.times[:FRAMES])
    solver = TotalLagrangian(setting.problem, step)
    nodes = setting.at_frames(
        twin.body.start, solver.run(twin.body.start, setting.velocity, setting.held, setting.knots)
    )
    return float(np.sum(weights * twin.observe(nodes, scene.times[:FRAMES])))


def weights_of(run: TwinRun) -> np.ndarray:
    return np.random.default_rng(3).normal(size=run.tracks.shape)


def test_an_effect_without_a_gradient_is_refused() -> None:
    twin = CHEAP["sheet"].with_effect(effect("air_on_sheet", added_kg_m2=0.01))
    with pytest.raises(NotDifferentiable, match="SheetAir, has no derivative"):
        run_of(twin, "sheet")


@pytest.mark.parametrize(("shape", "name", "which"), STRENGTHS)
def test_strength_of_an_effect(shape: str, name: str, which: str) -> None:
    plain = CHEAP[shape]
    probe = {s.name: s for s in EFFECTS[name].strengths(plain)}[which].probe
    # a solid's strains are single precision: a difference over a large step is the better reference
    value, h = (10 * probe, 5 * probe) if shape == "solid" and name in BIG else (2 * probe, 0.2 * probe)
    h = h if shape == "solid" else 0.05 * probe
    twin = plain.with_effect(effect(name, **{which: value}))
    step = 0.8 * run_of(twin, shape).time_step_s
    run = run_of(twin, shape, step)
    weights = weights_of(run)
    _, found = run.gradient(weights, {"s": strength(twin, name, which)})
    ends = [
        loss(plain.with_effect(effect(name, **{which: v})), shape, weights, step)
        for v in (value + h, value - h)
    ]
    assert found["s"] == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=1e-2)


@pytest.mark.parametrize(
    ("shape", "name"),
    [("solid", "youngs_modulus_pa"), ("solid", "poissons_ratio"), ("solid", "density_kg_m3"),
     ("sheet", "membrane_n_m"), ("sheet", "bending_n_m"), ("sheet", "poissons_ratio"), ("sheet", "relaxation_s"),
     ("rope", "stretching_n"), ("rope", "bending_n_m2"), ("rope", "relaxation_s"), ("rope", "density_kg_m")],
)  # fmt: skip
def test_parameter_of_a_law(shape: str, name: str) -> None:
    start = {"relaxation_s": 1e-3}.get(name)
    twin = CHEAP[shape] if start is None else CHEAP[shape].with_parameters(**{name: start})
    step = 0.8 * run_of(twin, shape).time_step_s
    run = run_of(twin, shape, step)
    weights, value = weights_of(run), twin.parameters[name]
    _, found = run.gradient(weights, {name: parameter(twin, name)})
    h = 0.01 * value
    ends = [loss(twin.with_parameters(**{name: v}), shape, weights, step) for v in (value + h, value - h)]
    assert found[name] == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=1e-2)


def test_an_effect_that_is_not_there_yet() -> None:
    twin = CHEAP["rope"]
    absent = twin.with_effect(effect("air_drag_quadratic"))
    step = 0.8 * run_of(twin, "rope").time_step_s
    run = run_of(twin, "rope", step)
    weights = weights_of(run)
    _, found = run.gradient(weights, {"k": strength(absent, "air_drag_quadratic", "coefficient_per_m")})
    near = twin.with_effect(effect("air_drag_quadratic", coefficient_per_m=0.02))
    ends = [loss(t, "rope", weights, step) for t in (near, twin)]
    assert found["k"] == pytest.approx((ends[0] - ends[1]) / 0.02, rel=1e-2)


def test_memory_that_the_run_does_not_have_is_refused() -> None:
    twin = CHEAP["rope"].with_effect(effect("viscoelastic_maxwell"))
    run = run_of(CHEAP["rope"], "rope")
    with pytest.raises(NotDifferentiable, match="small strength"):
        run.gradient(weights_of(run), {"g": strength(twin, "viscoelastic_maxwell", "share")})


@pytest.mark.parametrize("flow", ["von_mises", None])
def test_a_body_that_flows_has_no_gradient(flow: str | None) -> None:
    law = None if flow is None else flow_law(flow)
    twin = build_twin(SCENES["solid"](), 100, plasticity=law, formulation="updated_lagrangian")
    with pytest.raises(NotDifferentiable, match="updated Lagrangian form"):
        run_of(twin, "solid")


def test_friction_of_the_ground() -> None:
    plain = TWINS["solid"]
    twin = plain.with_effect(effect("ground_friction", change=0.1))
    step = 0.8 * run_of(twin, "solid").time_step_s
    run = run_of(twin, "solid", step)
    weights, h = weights_of(run), 2e-3
    _, found = run.gradient(weights, {"mu": strength(twin, "ground_friction", "change")})
    ends = [
        loss(plain.with_effect(effect("ground_friction", change=v)), "solid", weights, step)
        for v in (0.1 + h, 0.1 - h)
    ]
    assert ends[0] != ends[1]
    assert found["mu"] == pytest.approx((ends[0] - ends[1]) / (2 * h), rel=3e-2)


def test_growing_stiffness_and_a_friction_that_is_not_there_yet() -> None:
    twin = CHEAP["rope"].with_effect(effect("time_varying_stiffness", log_rate_per_s=0.3))
    step = 0.5 * run_of(twin, "rope").time_step_s
    run = run_of(twin, "rope", step)
    weights, h = weights_of(run), 1e-9  # the fastest modes feel that
    _, found = run.gradient(weights, {"tau": parameter(twin, "relaxation_s")})
    ends = [loss(twin.with_parameters(relaxation_s=v), "rope", weights, step) for v in (h, 0.0)]
    assert found["tau"] == pytest.approx((ends[0] - ends[1]) / h, rel=1e-2)
