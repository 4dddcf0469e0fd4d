"""What hangs taut between two grips is as stiff as it stretches; what one grip holds hardly does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import FPS, made_scene, recorded_by

from physworld.calibrate import CalibrationConfig, calibrate
from physworld.calibrate.descents import Descent, Optimum
from physworld.calibrate.global_stage import searched_parameters
from physworld.calibrate.parameters import BENDING, STRETCHING, Parameter, hangs_taut
from physworld.calibrate.search import Search
from physworld.calibrate.taut import taut_starts
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld.twin.build import build_twin

pytestmark = pytest.mark.slow

LENGTH, RADIUS, FRAMES = 0.4, 0.006, 40
BODY = Body(length_m=LENGTH, radius_m=RADIUS, density_kg_m3=900.0)


def _grip(first: int, low: float, high: float) -> Grip:
    box = np.array([[low, -RADIUS, -RADIUS], [high, RADIUS, RADIUS]])
    return Grip(tuple(range(first, first + 4)), *box)


def _hung(grips: int) -> Scene:
    """A level rope whose grips sway, each in its own way."""
    points = np.zeros((21, 3))
    points[:, 0] = np.linspace(0.0, LENGTH, 21)
    hands = np.array([[x, y, z] for x in (0.02, 0.38) for y in (-RADIUS, RADIUS) for z in (-RADIUS, RADIUS)])
    hands = hands[: 4 * grips]
    at = np.arange(FRAMES) / FPS
    ways = [
        np.stack([0.002 * np.sin(4 * at), 0.03 * np.sin(p * at) ** 2, 0.02 * np.sin(p * at)], 1)
        for p in (6.0, 8.0)
    ]
    moves = np.repeat(np.stack(ways[:grips], axis=1), 4, axis=1)
    held = (_grip(0, 0.0, 0.02), _grip(4, 0.38, LENGTH))[:grips]
    facts = {"body": BODY, "grips": held, "initial_state": UNDEFORMED_AT_REST}
    return replace(made_scene(points, "rope", hands, FRAMES, **facts), controllers=hands + moves)


def test_stretching_and_bending_of_a_taut_rope_are_found() -> None:
    scene = _hung(2)
    truth = build_twin(scene, refinement=1.4)
    true = {"stretching_n": 0.45 * truth.parameters["stretching_n"], "bending_n_m2": 1e-3}
    recorded = recorded_by(truth.with_parameters(**true), scene, 5e-4)
    found = calibrate(recorded, CalibrationConfig(max_simulations=150))
    for name, tolerance in (
        ("stretching_n", 0.12),
        ("bending_n_m2", 0.2),
    ):  # the clamps end at a cell's end in each
        assert found.parameters[name].value == pytest.approx(true[name], rel=tolerance)
    assert found.losses["rms_over_noise"] < 1.6  # √2, for frame 0 is as noisy


def test_stretching_is_sought_of_what_hangs_taut_alone() -> None:
    slack = _hung(2)
    nearer = np.where(np.arange(8)[None, :, None] < 4, 0.0, [-0.02, 0.0, 0.0])
    slack = replace(slack, controllers=slack.controllers + nearer * (np.arange(FRAMES) > 2)[:, None, None])
    for scene, taut in ((_hung(1), False), (_hung(2), True), (slack, False)):
        twin = build_twin(scene)
        assert hangs_taut(scene, twin) is taut
        found = searched_parameters(scene, twin, CalibrationConfig())
        assert ("stretching_n" in [p.name for p in found]) is taut


def _searched(scene: Scene) -> tuple[Search, list[Parameter]]:
    """A search, and what it scans."""
    twin = build_twin(scene)
    found = searched_parameters(scene, twin, CalibrationConfig())
    return Search(scene, twin, 400, None, None), [
        p for p in found if p.stage in ("stiffness", "flow", "taut")
    ]


@pytest.mark.parametrize("radius", [0.003, 0.01, 0.025])
def test_a_start_lies_within_an_octave_of_every_section(radius: float) -> None:
    """Between the starts of E A, from strands that slide on each other (a twelfth of a section) to a tube (twice)."""
    scene = _hung(2)
    search, parameters = _searched(replace(scene, body=replace(BODY, radius_m=radius)))
    names = [p.name for p in parameters]
    places = np.log2(taut_starts(search.twin, parameters))[:, [names.index(STRETCHING), names.index(BENDING)]]
    stretching = np.log2(parameters[names.index(STRETCHING)].starts)
    for e_a in np.linspace(stretching.min(), stretching.max(), 20):
        for share in np.log2([1 / 12, 0.3, 0.7, 1.0, 2.0]):
            section = e_a + share + np.log2(radius**2 / 4)
            assert np.abs(places - [e_a, section]).max(axis=1).min() <= 1.0
    bounds = np.array([p.bounds for p in parameters])
    tried = np.log(taut_starts(search.twin, parameters))
    assert np.all((tried > bounds[:, 0]) & (tried < bounds[:, 1]))


def test_what_is_followed_of_a_taut_rope_differs_in_stiffness(monkeypatch: pytest.MonkeyPatch) -> None:
    """A torsion that does not show made three starts of one, and the best other basin was never followed."""
    search, parameters = _searched(replace(_hung(2), noise_sigma_m=1e-4))  # so that it has a torsion
    assert "torsion_ratio" in [p.name for p in parameters]
    followed: list[Descent] = []

    def costs(name: str, searched: list[Parameter], starts: list[np.ndarray], end: int) -> list[float | None]:
        return [float(np.sum((theta[:2] - 1.0) ** 2)) for theta in starts]

    def solve_each(asked: list[Descent]) -> list[Optimum]:
        followed.extend(asked)
        return [Optimum(one.theta, float(np.sum((one.theta[:2] - 1.0) ** 2))) for one in asked]

    monkeypatch.setattr(search, "costs", costs)
    monkeypatch.setattr(search, "solve_each", solve_each)
    search.scan(parameters)
    first = followed[:3]
    assert len({tuple(one.theta[:2]) for one in first}) == 3
