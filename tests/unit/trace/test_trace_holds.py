"""Holds: a body whose grip holds harder than its box is fitted to the noise from other softnesses and stiffnesses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import box_body, made_scene

from physworld.calibrate.parameters import parameters_of
from physworld.engine.terms.soft_grips import AS_HELD
from physworld.estimation.refit import Refit, sensitivities
from physworld.estimation.simulations import Job
from physworld.estimation.whitening import whitener
from physworld.scene import UNDEFORMED_AT_REST, Grip
from physworld.trace.confirm import held_otherwise
from physworld.trace.recordings import JointSimulations, Recordings
from physworld.trace.unknowns import SOFTNESS, grip_softness, of_parameter
from physworld.twin.build import build_twin
from physworld.twin.grips import softly_held

pytestmark = pytest.mark.slow

BUDGET, TRUE_PA, HARD, SIGMA = 200, 4e4, 0.3 * AS_HELD, 5e-4


def test_a_refit_is_found_from_another_softness_of_the_grips() -> None:
    low, high = np.array([0.0, -0.03, -0.03]), np.array([0.12, 0.03, 0.03])
    grip = np.array([[0.0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)])
    box = Grip((0, 1, 2, 3), np.array([0.0, -0.015, -0.015]), np.array([0.03, 0.015, 0.015]))
    points = [[x, y, z] for x in (0.06, 0.12) for y in (-0.03, 0.03) for z in (-0.03, 0.03)]
    scene = made_scene(
        points, "block", grip, 15, body=box_body(low, high, density_kg_m3=500.0),
        initial_state=UNDEFORMED_AT_REST, grips=(box,),
    )  # fmt: skip
    twin = softly_held(build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=TRUE_PA))
    truth = replace(twin, grip_softness=HARD)
    tracks = truth.observe(truth.simulate_nodes(*scene.control_track(), scene.times), scene.times)
    noise = np.random.default_rng(0).normal(scale=SIGMA, size=tracks.shape)
    scene = replace(scene, points=tracks + noise, noise_sigma_m=SIGMA)
    recordings = Recordings([scene], (), 12, 3)
    simulations = JointSimulations(recordings, twin, BUDGET, 1.25)
    frames = recordings.split.train[1]
    wrong = twin.with_parameters(youngs_modulus_pa=2.0 * TRUE_PA)
    start, answers = simulations.first_look(Job(wrong, frames))
    white = whitener(recordings.scene, recordings.split, SIGMA, answers)
    known = parameters_of(wrong, separate_bending=False, damping=False)
    modulus = next(of_parameter(p, wrong, None) for p in known if p.name == "youngs_modulus_pa")
    softness = grip_softness(wrong)
    assert softness is not None
    for unknowns in ([modulus, softness], [modulus]):
        slope, _ = sensitivities(simulations, white, wrong, start, unknowns, frames)
        place = np.array([u.start for u in unknowns])
        fitted = Refit(unknowns, wrong, place, start, white.residual(start), slope)
        found = held_otherwise(fitted, simulations, white, frames, 4)
        if SOFTNESS not in [u.name for u in unknowns]:
            assert found is fitted
            continue
        assert found.misfit < 1.1 < fitted.misfit
        assert found.value("youngs_modulus_pa") == pytest.approx(TRUE_PA, rel=0.4)  # the two trade
        assert 0.1 * AS_HELD <= found.value(SOFTNESS) <= 1.5 * AS_HELD
