"""Gradients by scalars of twins whose friction is taken in stages, against central differences of whole runs.

Friction of the law's and of an effect, memory beside it, a changed reference, a sheet's Poisson's ratio (whose friction
is launched beside the reverse pass), and grips that hold softly.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "effects"))
from effect_twins import SCENES, TWINS

from physworld.effects.registry import effect
from physworld.engine.total.formulation import TotalLagrangian
from physworld.twin.gradient import Neighbours, TwinRun, parameter, strength
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

FRAMES = 4
FREE = {name: replace(twin, ground_height_m=None) for name, twin in TWINS.items()}
RUBBED = {
    "solid": FREE["solid"]
    .with_effect(effect("viscosity_kelvin_voigt", viscosity_pa_s=500.0))
    .with_effect(effect("viscoelastic_maxwell", shear_modulus_pa=3e3)),
    "sheet": FREE["sheet"]
    .with_effect(effect("viscosity_kelvin_voigt", relaxation_s=0.1))
    .with_effect(effect("viscoelastic_maxwell", share=0.3)),
    "rope": FREE["rope"]
    .with_effect(effect("viscosity_kelvin_voigt", relaxation_s=0.1))
    .with_effect(effect("viscoelastic_maxwell", share=0.3)),
    "solid in drag": replace(FREE["solid"], air_drag_per_s=2e4),
    "solid on the ground": TWINS["solid"]
    .with_parameters(viscosity_pa_s=3000.0)
    .with_effect(effect("ground_friction", change=0.1)),
    "solid held softly": replace(
        FREE["solid"].with_effect(effect("viscosity_kelvin_voigt", viscosity_pa_s=500.0)), grip_softness=0.16
    ),
}
SCALARS = {
    "solid": ["youngs_modulus_pa", "poissons_ratio", "density_kg_m3", "viscosity_kelvin_voigt viscosity_pa_s",
              "viscoelastic_maxwell shear_modulus_pa", "viscoelastic_maxwell relaxation_s", "rest_shape strain_x"],
    "sheet": ["membrane_n_m", "bending_n_m", "poissons_ratio", "viscosity_kelvin_voigt relaxation_s",
              "viscoelastic_maxwell share", "viscoelastic_maxwell relaxation_s"],
    "rope": ["stretching_n", "bending_n_m2", "density_kg_m", "viscosity_kelvin_voigt relaxation_s",
             "viscoelastic_maxwell share", "viscoelastic_maxwell relaxation_s"],
    "solid in drag": ["youngs_modulus_pa", "density_kg_m3"],
    "solid on the ground": ["ground_friction change"],
    "solid held softly": ["youngs_modulus_pa", "density_kg_m3", "viscosity_kelvin_voigt viscosity_pa_s", "softness"],
}  # fmt: skip


def neighbours(twin: Twin, name: str, share: float | None = None) -> Neighbours:
    """Neighbours of a twin by a scalar: those of the gradient, or ``share`` of its value away."""
    if name == "softness":
        h = twin.grip_softness * (share or 0.02)
        near = [replace(twin, grip_softness=twin.grip_softness + s * h) for s in (1, -1)]
        return Neighbours(*near, 2 * h)
    kind, _, which = name.partition(" ")
    if share is None:
        return strength(twin, kind, which) if which else parameter(twin, name)
    if not which:
        h = share * twin.parameters[name]
        near = [twin.with_parameters(**{name: twin.parameters[name] + s * h}) for s in (1, -1)]
        return Neighbours(*near, 2 * h)
    known = {e.name: e for e in twin.effects}.get(kind)
    value = 0.0 if known is None else known.values[which]
    h = share * value if value else share
    near = [twin.with_effect(replace(known or effect(kind), **{which: value + s * h})) for s in (1, -1)]
    return Neighbours(*near, 2 * h)


@cache
def run_of(shape: str) -> TwinRun:
    scene, twin = SCENES[shape.split()[0]](), RUBBED[shape]
    step = 0.8 * TwinRun(twin, *scene.control_track(), scene.times[:2]).time_step_s
    run = TwinRun(twin, *scene.control_track(), scene.times[:FRAMES], time_step_s=step)
    assert np.all(run.recorded.stages >= 3)
    return run


def weights_of(run: TwinRun) -> np.ndarray:
    return 1.0 + np.random.default_rng(3).normal(size=run.tracks.shape)


@cache
def gradient_of(shape: str) -> dict[str, float]:
    run, twin = run_of(shape), RUBBED[shape]
    scalars = {name: neighbours(twin, name) for name in SCALARS[shape] if "rest_shape" not in name}
    if "rest_shape strain_x" in SCALARS[shape]:
        scalars["rest_shape strain_x"] = neighbours(twin, "rest_shape strain_x", 2e-3)
    return run.gradient(weights_of(run), scalars)[1]


def loss(twin: Twin, shape: str) -> float:
    scene = SCENES[shape.split()[0]]()
    run = run_of(shape)
    setting = twin.integration(*scene.control_track(), scene.times[:FRAMES])
    solver = TotalLagrangian(setting.problem, run.time_step_s)
    assert solver.relaxed
    nodes = solver.run(twin.body.start, setting.velocity, setting.held, setting.knots)
    return float(
        np.sum(weights_of(run) * twin.observe(setting.at_frames(twin.body.start, nodes), setting.knots))
    )


@pytest.mark.parametrize(("shape", "name"), [(shape, name) for shape in SCALARS for name in SCALARS[shape]])
def test_scalar_through_stages(shape: str, name: str) -> None:
    h = 2e-3 if "rest_shape" in name else 2e-2 if shape.startswith("solid") else 2e-3
    pair = neighbours(RUBBED[shape], name, h)
    expected = (loss(pair.high, shape) - loss(pair.low, shape)) / pair.width
    assert gradient_of(shape)[name] == pytest.approx(expected, rel=1e-2)


def test_internal_friction_that_is_not_there_yet_beside_stages_of_drag() -> None:
    run, twin, shape = run_of("solid in drag"), RUBBED["solid in drag"], "solid in drag"
    assert run.recorded.solver.friction is None
    _, found = run.gradient(weights_of(run), {"eta": parameter(twin, "viscosity_pa_s")})
    h = 0.5
    expected = (loss(twin.with_parameters(viscosity_pa_s=h), shape) - loss(twin, shape)) / h
    assert found["eta"] == pytest.approx(expected, rel=1e-2)
