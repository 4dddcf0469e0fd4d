"""Calibration of recordings that a twin made of itself: what was planted is found, what was not is not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene, recorded_by

from physworld.calibrate import CalibrationConfig, Journal, calibrate
from physworld.calibrate.search import Search
from physworld.errors import CalibrationError, Cancelled, SceneUnsupported
from physworld.estimation.simulations import Drive, Job, in_turn
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

FRAMES, FPS = 40, 30.0
SIGMA_M = 2e-4
YOUNGS_MODULUS_PA = 3.1e4
DRAG_PER_S = 1.3
LOW, HIGH = np.array([0.0, -0.015, -0.015]), np.array([0.12, 0.015, 0.015])
CONFIG = CalibrationConfig(particle_budget=100)


def shaken_bar() -> Scene:
    """A bar clamped over its first 2 cm, whose clamp is shaken up and down for half of the recording."""
    times = np.arange(FRAMES) / FPS
    shake = 0.01 * np.sin(2 * np.pi * 2.0 * times) * (times < 0.5)
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    scene = made_scene(
        [[x, 0.0, 0.015] for x in np.linspace(0.03, 0.12, 7)],
        "beam",
        grip,
        FRAMES,
        body=box_body(LOW, HIGH, density_kg_m3=300.0),
        grips=(Grip((0, 1, 2, 3), LOW, np.array([0.02, 0.015, 0.015])),),
        initial_state=UNDEFORMED_AT_REST,
    )
    return replace(scene, controllers=scene.controllers + shake[:, None, None] * np.array([0.0, 0.0, 1.0]))


def truth(scene: Scene, **parameters: float) -> Twin:
    planted = {"youngs_modulus_pa": YOUNGS_MODULUS_PA, **parameters}
    return build_twin(scene, CONFIG.particle_budget).with_parameters(**planted)


@pytest.fixture(scope="module")
def undamped() -> Scene:
    return recorded_by(
        truth(shaken_bar()), shaken_bar(), SIGMA_M, seed=2
    )  # a 95 % interval misses one draw in 20


@pytest.fixture(scope="module")
def damped() -> Scene:
    return recorded_by(truth(shaken_bar(), air_drag_per_s=DRAG_PER_S), shaken_bar(), SIGMA_M, seed=1)


def test_planted_stiffness_is_found_within_a_percent_and_its_interval(undamped: Scene) -> None:
    told: list[tuple[int, int, str]] = []
    found = calibrate(undamped, CONFIG, progress=lambda done, most, text: told.append((done, most, text)))
    estimate = found.parameters["youngs_modulus_pa"]
    assert estimate.value == pytest.approx(YOUNGS_MODULUS_PA, rel=0.01)
    assert estimate.identified and estimate.unit == "Pa" and estimate.ci95 is not None
    low, high = estimate.ci95
    assert low < YOUNGS_MODULUS_PA < high < 1.05 * low
    # damping that the bar does not have is told apart from damping that it has
    assert {"air_drag_per_s", "viscosity_pa_s", "poissons_ratio", "relaxing_share"} == set(found.rejected)
    assert found.twin.air_drag_per_s == 0.0 and found.parameters["air_drag_per_s"].value == 0.0
    assert "not needed" in found.parameters["air_drag_per_s"].note
    # held-out frames, open loop
    first = undamped.test[0]
    error = found.tracks[first:] - undamped.points[first:]
    assert np.sqrt(np.mean(error**2)) < 1.5 * SIGMA_M
    assert found.tracks.shape == undamped.points.shape
    assert found.particles.shape == (FRAMES, len(found.twin.particles_rest), 3)
    assert len(told) <= found.simulations <= CONFIG.max_simulations
    assert all(most == CONFIG.max_simulations and "youngs_modulus_pa" in text for _, most, text in told)
    assert np.all(np.diff(found.loss_history) <= 0)


def test_planted_drag_is_found_beside_the_stiffness(damped: Scene) -> None:
    found = calibrate(damped, CONFIG)
    drag, stiffness = found.parameters["air_drag_per_s"], found.parameters["youngs_modulus_pa"]
    assert stiffness.value == pytest.approx(YOUNGS_MODULUS_PA, rel=0.01)
    assert drag.identified and drag.ci95 is not None
    assert drag.value == pytest.approx(DRAG_PER_S, rel=0.1)
    assert found.twin.air_drag_per_s == drag.value
    assert "viscosity_pa_s" in found.rejected


def test_without_damping_only_the_declared_physics_is_fitted(damped: Scene) -> None:
    found = calibrate(damped, replace(CONFIG, damping="none"))
    assert set(found.rejected) == {"poissons_ratio"} and "air_drag_per_s" not in found.parameters
    assert found.twin.air_drag_per_s == 0.0


def test_density_is_a_declared_scale_not_a_finding(undamped: Scene) -> None:
    found = calibrate(undamped, replace(CONFIG, damping="none"))
    density = found.parameters["density"]
    assert density.value == 300.0 and not density.identified and "as declared" in density.note
    heavy = replace(undamped, body=box_body(LOW, HIGH, density_kg_m3=600.0))
    twice = calibrate(heavy, replace(CONFIG, damping="none")).parameters["youngs_modulus_pa"].value
    assert twice == pytest.approx(2 * found.parameters["youngs_modulus_pa"].value, rel=2e-3)


def test_only_training_frames_are_looked_at(undamped: Scene) -> None:
    spoiled = undamped.points.copy()
    spoiled[undamped.test[0] :] += 1.0
    config = replace(CONFIG, max_simulations=25, damping="none")
    first, second = (calibrate(s, config) for s in (undamped, replace(undamped, points=spoiled)))
    assert first.parameters == second.parameters
    np.testing.assert_array_equal(first.tracks, second.tracks)


@pytest.mark.parametrize("budget", [3, 12, 24, 31])
def test_a_budget_that_ends_early_is_kept_and_never_adds_damping(undamped: Scene, budget: int) -> None:
    found = calibrate(undamped, replace(CONFIG, max_simulations=budget))
    assert found.simulations <= budget
    assert found.twin.air_drag_per_s == 0.0 and found.twin.parameters["viscosity_pa_s"] == 0.0
    assert np.isfinite(found.tracks).all()


@pytest.mark.parametrize("budget", [3, 12, 24, 31])
def test_a_search_that_spent_its_budget_gives_no_interval_and_did_not_converge(
    undamped: Scene, budget: int
) -> None:
    found = calibrate(undamped, replace(CONFIG, max_simulations=budget))
    estimate = found.parameters["youngs_modulus_pa"]
    assert found.cut_short and set(found.open) == {p.name for p in found.searched}
    assert estimate.ci95 is None and not estimate.identified
    assert f"cut short by its budget of {budget} simulations" in estimate.note


def test_a_search_that_ended_by_itself_is_the_same_whatever_budget_was_left(undamped: Scene) -> None:
    config = replace(CONFIG, damping="none")
    first, second = (calibrate(undamped, replace(config, max_simulations=most)) for most in (200, 400))
    assert not first.cut_short and first.open == {}
    assert first.parameters == second.parameters and first.parameters["youngs_modulus_pa"].ci95 is not None


def test_a_search_that_is_resumed_still_knows_that_its_budget_was_spent(undamped: Scene) -> None:
    saved: list[str] = []
    config = replace(CONFIG, max_simulations=24)
    first = calibrate(undamped, config, journal=Journal("bar", None, saved.append))
    again = calibrate(undamped, config, journal=Journal("bar", saved[-1]))
    assert first.cut_short and again.cut_short and again.parameters == first.parameters


def test_one_scored_frame_gives_no_interval(undamped: Scene) -> None:
    short = replace(undamped, train=(0, 2), test=(2, FRAMES))
    estimate = calibrate(short, replace(CONFIG, max_simulations=20, damping="none")).parameters[
        "youngs_modulus_pa"
    ]
    assert estimate.ci95 is None and not estimate.identified


def test_a_cancelled_calibration_stops_in_the_middle_of_a_run(undamped: Scene) -> None:
    asked = iter([False] * 5 + [True])
    with pytest.raises(Cancelled, match="after 0 runs"):  # at its sixth frame
        calibrate(undamped, CONFIG, cancelled=lambda: next(asked))


def test_a_body_that_can_be_simulated_for_a_while_only_is_refused(undamped: Scene) -> None:
    """Every start is usable on the first frames, and none is on all of them."""

    def failing_late(
        jobs: Sequence[Job], drive: Drive, poll: Callable[[], None]
    ) -> Iterator[np.ndarray | None]:
        for job, tracks in zip(jobs, in_turn(jobs, drive, poll), strict=True):
            yield None if job.frames == undamped.train[1] else tracks

    with pytest.raises(
        CalibrationError, match=r"starts gave a usable simulation to frame \d+, .* to frame 27"
    ):
        calibrate(undamped, CONFIG, runner=failing_late)


def test_training_frames_without_a_sighting_are_refused(undamped: Scene) -> None:
    visible = undamped.visible.copy()
    visible[1 : undamped.train[1]] = False
    with pytest.raises(CalibrationError, match=r"no visible point in the training frames \(0, 28\)"):
        calibrate(replace(undamped, visible=visible), CONFIG)


def test_hidden_points_do_not_count(undamped: Scene) -> None:
    visible, points = undamped.visible.copy(), undamped.points.copy()
    visible[5:15, 2] = False
    points[5:15, 2] = 7.0
    found = calibrate(replace(undamped, visible=visible, points=points), CONFIG)
    assert found.parameters["youngs_modulus_pa"].value == pytest.approx(YOUNGS_MODULUS_PA, rel=0.01)


def test_a_scene_without_a_body_is_refused_before_any_run() -> None:
    with pytest.raises(SceneUnsupported, match="3 points"):
        calibrate(made_scene(np.eye(3), "blob"), CONFIG)


def test_the_noise_of_frame_0_is_taken_out_of_a_sheet_s_points() -> None:
    """A hanging sheet's points lie where frame 0 saw them, noise included, in its plane and across it."""
    side, sigma = 0.2, 1e-3
    x, z = np.meshgrid(np.linspace(0, side, 7), np.linspace(0, side, 7), indexing="ij")
    flat = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    corners = np.array([[0.0, 0.0, side], [side, 0.0, side]])
    times = np.arange(24) / FPS
    sway = 0.02 * np.sin(2 * np.pi * 1.0 * times)[:, None, None] * np.array([0.0, 1.0, 0.0])
    scene = made_scene(
        flat,
        "sheet",
        corners,
        24,
        body=Body(thickness_m=0.004, density_kg_m3=300.0),
        initial_state=UNDEFORMED_AT_REST,
    )
    scene = replace(scene, controllers=scene.controllers + sway)
    twin = build_twin(scene).with_parameters(membrane_n_m=400.0, bending_n_m=2e-3)
    recorded = recorded_by(twin, scene, sigma, seed=3)
    search = Search(recorded, build_twin(recorded), 60, None, None)
    search.twin = search.twin.with_parameters(membrane_n_m=400.0, bending_n_m=2e-3)
    before = np.sqrt(np.mean(search.residual([], np.zeros(0)) ** 2))
    assert search.shift_points([], np.zeros(0))
    after = np.sqrt(np.mean(search.residual([], np.zeros(0)) ** 2))
    assert before == pytest.approx(np.sqrt(2) * sigma, rel=0.15) and after < 1.1 * sigma
