"""A body that blows up at its stable time step, which is the undeformed one's, is run again at half of it."""

from __future__ import annotations

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.engine.total import stability
from physworld.engine.total.formulation import TotalLagrangian, run_again_if_blown_up
from physworld.engine.total.stability import SAFETY, stable_time_step
from physworld.errors import BlewUp, SimulationError
from physworld.scene import UNDEFORMED_AT_REST
from physworld.twin.build import build_twin
from physworld.twin.integration import Integration

LOW, HIGH = np.array([0.0, -0.015, -0.015]), np.array([0.12, 0.015, 0.015])


@pytest.fixture
def swing(monkeypatch: pytest.MonkeyPatch) -> tuple[Integration, np.ndarray]:
    """A bar under gravity whose own time step is half as long again as what is stable."""
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    scene = made_scene(
        [[0.06, 0.0, 0.015], [0.12, 0.0, 0.015]],
        "beam",
        grip,
        6,
        body=box_body(LOW, HIGH, density_kg_m3=300.0),
        initial_state=UNDEFORMED_AT_REST,
    )
    twin = build_twin(scene, 60).with_parameters(youngs_modulus_pa=4e4)

    def too_long(frequency: float, rate: float, safety: float = SAFETY) -> float:
        return stable_time_step(frequency, rate, 1.5 if safety == SAFETY else safety)

    monkeypatch.setattr(stability, "stable_time_step", too_long)
    return twin.integration(*scene.control_track(), scene.times), twin.body.start


def test_it_is_run_again_at_half_the_step(swing: tuple[Integration, np.ndarray]) -> None:
    run, start = swing
    solver = TotalLagrangian(run.problem)
    with pytest.raises(BlewUp, match="nodes not finite"):
        solver.run(start, run.velocity, run.held, run.knots)
    half = TotalLagrangian(run.problem, 0.5 * solver.time_step_s)
    expected = half.run(start, run.velocity, run.held, run.knots)
    found = run_again_if_blown_up(solver, start, run.velocity, run.held, run.knots)
    assert np.array_equal(found, expected)
    assert np.isfinite(expected).all()


def test_what_blows_up_at_half_the_step_too_says_so(swing: tuple[Integration, np.ndarray]) -> None:
    run, start = swing
    fling = np.zeros_like(run.velocity)
    fling[-1] = 1e6
    with pytest.raises(SimulationError):
        run_again_if_blown_up(TotalLagrangian(run.problem), start, fling, run.held, run.knots)
