"""Internal friction is searched as far as the time step can follow it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.calibrate.parameters import SLOWEST, affordable, parameters_of
from physworld.engine.total.formulation import TotalLagrangian
from physworld.scene import UNDEFORMED_AT_REST, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

LOW, HIGH = np.array([0.0, -0.015, -0.015]), np.array([0.12, 0.015, 0.015])


@pytest.fixture(scope="module")
def bar() -> Scene:
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    return made_scene(
        [[x, 0.0, 0.015] for x in np.linspace(0.03, 0.12, 5)],
        "beam",
        grip,
        14,
        body=box_body(LOW, HIGH, density_kg_m3=300.0),
        initial_state=UNDEFORMED_AT_REST,
    )


def step_s(scene: Scene, twin: Twin) -> float:
    problem = twin.integration(*scene.control_track(), scene.times).problem
    return TotalLagrangian(problem, friction="explicit").time_step_s


def test_the_bound_is_where_the_step_is_so_many_times_smaller(bar: Scene) -> None:
    twin = build_twin(bar, 60).with_parameters(youngs_modulus_pa=1e5)
    searched = {p.name: p for p in parameters_of(twin, separate_bending=False)}
    wide = replace(searched["viscosity_pa_s"], high=1e4)
    found = affordable(bar, twin, wide)
    assert found.high < wide.high
    slowed = step_s(bar, twin) / step_s(bar, found.apply(twin, found.high))
    assert slowed == pytest.approx(SLOWEST, rel=0.1)
    assert found.low < found.starts[0] < found.high


def test_what_can_be_waited_for_keeps_its_bound(bar: Scene) -> None:
    twin = build_twin(bar, 60).with_parameters(youngs_modulus_pa=1e7)
    searched = {p.name: p for p in parameters_of(twin, separate_bending=False)}
    assert affordable(bar, twin, searched["viscosity_pa_s"]) is searched["viscosity_pa_s"]
    assert affordable(bar, twin, searched["air_drag_per_s"]) is searched["air_drag_per_s"]
