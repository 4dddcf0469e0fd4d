"""A body that a hand lets go: it stirs as the hand opens, and swings freely some frames later."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sagging_bar import BUDGET, SIGMA, TRUE_PA, sagging

from physworld.calibrate import CalibrationConfig, calibrate
from physworld.calibrate.parameters import RELEASE_DELAY, release
from physworld.scene import AS_MEASURED, Scene
from physworld.twin.build import build_twin, taken_over

STILL, OPENING, FRAMES = 5, 2.5, 34
QUIET_M = 0.2 * SIGMA
CONFIG = CalibrationConfig(particle_budget=BUDGET, max_simulations=120, damping="none")


@pytest.fixture(scope="module")
def let_go() -> Scene:
    """Level for five frames, moved by 2 mm as the hand opens, and free two and a half frames after that began."""
    begun = sagging(frames=FRAMES)
    twin = replace(build_twin(begun, BUDGET), release_s=(STILL - 1 + OPENING) / begun.fps)
    truth = twin.with_parameters(youngs_modulus_pa=TRUE_PA)
    points = truth.observe(truth.simulate_nodes(*begun.control_track(), begun.times), begun.times)
    points[STILL : STILL + 2] += [0.0, 0.0, 2e-3]
    noise = np.random.default_rng(1).normal(scale=QUIET_M, size=points.shape)
    return replace(begun, points=points + noise, initial_state=AS_MEASURED, noise_sigma_m=QUIET_M)


def test_the_delay_is_found_and_the_stiffness_with_it(let_go: Scene) -> None:
    found = calibrate(let_go, CONFIG).parameters
    assert build_twin(let_go, BUDGET).release_s == pytest.approx((STILL - 1) / let_go.fps)
    assert found[RELEASE_DELAY].value == pytest.approx(OPENING / let_go.fps, abs=0.3 / let_go.fps)
    assert found["youngs_modulus_pa"].value == pytest.approx(TRUE_PA, rel=0.02)


def test_the_delay_moves_the_release_and_stays_with_its_recording(let_go: Scene) -> None:
    twin = build_twin(let_go, BUDGET)
    later = twin.with_parameters(release_delay_s=0.02)
    assert later.release_s == pytest.approx(twin.release_s + 0.02)
    assert later.with_parameters(release_delay_s=0.0).release_s == pytest.approx(twin.release_s)
    assert taken_over(later, twin).release_s == pytest.approx(twin.release_s)


def test_a_body_that_nobody_held_has_no_delay(let_go: Scene) -> None:
    free = replace(build_twin(let_go, BUDGET), release_s=0.0)
    assert release(free, let_go.times) == []
    assert RELEASE_DELAY not in free.parameters


def test_an_early_release_stays_one_and_free_bodies_stay_free(let_go: Scene) -> None:
    twin = build_twin(let_go, BUDGET)
    (delay,) = release(twin, let_go.times)
    assert delay.apply(replace(twin, release_s=0.0), 0.02).release_s == 0.0
    early = delay.apply(replace(twin, release_s=0.01), -1.0)
    assert early.release_s == pytest.approx(1e-6)
    assert delay.apply(early, 0.0).release_s == pytest.approx(0.01)
