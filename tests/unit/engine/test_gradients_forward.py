"""Forward sensitivities against central differences of whole runs, and against the reverse pass."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "effects"))
from effect_twins import SCENES, TWINS

from physworld.effects.registry import effect
from physworld.engine.gradients.gradient import Direction
from physworld.engine.gradients.gradient_forward import sensitivities
from physworld.engine.gradients.gradient_twin import TwinRun, parameter, strength
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import NotDifferentiable
from physworld.twin.twin import Twin

FRAMES = 4
FREE = {name: replace(twin, ground_height_m=None) for name, twin in TWINS.items()}
CASES = {
    "solid": (FREE["solid"], ["youngs_modulus_pa", "density_kg_m3"], 1e-2),
    "solid with friction": (
        FREE["solid"].with_parameters(viscosity_pa_s=5.0), ["youngs_modulus_pa", "poissons_ratio"], 1e-2,
    ),
    "sheet with friction": (
        FREE["sheet"].with_parameters(relaxation_s=1e-3), ["membrane_n_m", "bending_n_m", "relaxation_s"], 1e-4,
    ),
    "rope with memory": (
        FREE["rope"].with_effect(effect("viscoelastic_maxwell", share=0.3)),
        ["bending_n_m2", "density_kg_m", "viscoelastic_maxwell share"], 1e-3,
    ),
    "rope that stiffens": (
        FREE["rope"].with_effect(effect("time_varying_stiffness", log_rate_per_s=0.3)),
        ["stretching_n", "time_varying_stiffness log_rate_per_s"], 1e-3,
    ),
}  # fmt: skip


def directions_of(twin: Twin, shape: str, names: list[str]) -> dict[str, Direction]:
    scene = SCENES[shape]()

    def setting(changed: Twin) -> object:
        return changed.integration(*scene.control_track(), scene.times[:FRAMES])

    found = {}
    for name in names:
        pair = strength(twin, *name.split()) if " " in name else parameter(twin, name)
        found[name] = Direction(setting(pair.high), setting(pair.low), pair.width)
    return found


@pytest.mark.parametrize("case", CASES)
def test_sensitivities_are_the_differences_of_runs(case: str) -> None:
    twin, names, tolerance = CASES[case]
    shape = case.split()[0]
    scene = SCENES[shape]()
    base = twin.integration(*scene.control_track(), scene.times[:FRAMES])
    step = 0.8 * TotalLagrangian(base.problem).time_step_s
    directions = directions_of(twin, shape, names)
    nodes, found = sensitivities(base, twin.body.start, base.knots, directions, step)
    start = twin.body.start
    assert np.array_equal(
        nodes, TotalLagrangian(base.problem, step).run(start, base.velocity, base.held, base.knots)
    )
    for name, d in directions.items():
        high, low = (
            TotalLagrangian(s.problem, step).run(start, s.velocity, s.held, base.knots)
            for s in (d.high, d.low)
        )
        expected = (high - low) / d.width
        assert np.linalg.norm(found[name] - expected) < tolerance * np.linalg.norm(expected), name


def test_forward_and_reverse_agree() -> None:
    twin, names, _ = CASES["sheet with friction"]
    scene = SCENES["sheet"]()
    run = TwinRun(twin, *scene.control_track(), scene.times[:FRAMES])
    weights = np.random.default_rng(3).normal(size=run.nodes.shape)
    base = twin.integration(*scene.control_track(), scene.times[:FRAMES])
    _, forward = sensitivities(
        base, twin.body.start, base.knots, directions_of(twin, "sheet", names), run.time_step_s
    )
    reverse = run.recorded.gradient(weights)
    for name, column in (("membrane_n_m", 0), ("bending_n_m", 1), ("relaxation_s", 2)):
        by_value = reverse.law[:, column].sum() / twin.parameters[name]
        assert by_value == pytest.approx(np.sum(weights * forward[name]), rel=1e-5), name


def test_an_effect_that_the_run_does_not_have_is_refused() -> None:
    twin = FREE["rope"]
    with_it = twin.with_effect(effect("tether", stiffness_n_m=1.0))
    scene = SCENES["rope"]()
    base = twin.integration(*scene.control_track(), scene.times[:FRAMES])
    with pytest.raises(NotDifferentiable, match="terms"):
        sensitivities(
            base, twin.body.start, base.knots, directions_of(with_it, "rope", ["tether stiffness_n_m"])
        )
