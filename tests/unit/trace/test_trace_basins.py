"""Basins: damping is found from a stiffness where a linear score does not see it; near the noise nothing is tried."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sagging_bar import BUDGET, SIGMA, TRUE_PA, sagging

from physworld.calibrate.parameters import parameters_of
from physworld.effects.registry import effect
from physworld.estimation.refit import Refit, sensitivities
from physworld.estimation.simulations import Job
from physworld.estimation.whitening import whitener
from physworld.scene import Scene
from physworld.trace.basins import basins
from physworld.trace.candidates import candidates
from physworld.trace.recordings import JointSimulations, Recordings
from physworld.trace.unknowns import of_parameter
from physworld.twin.build import build_twin

STIFF_PA, RATE_PER_S, COMPLETE = 1.2e5, 8.0, 1.2


def drags() -> Scene:
    return sagging(effect("air_drag_linear", rate_per_s=RATE_PER_S))


@pytest.mark.parametrize("far", [True, False])
def test_damping_is_found_at_another_stiffness_where_the_misfit_is_far_from_the_noise(far: bool) -> None:
    scene = drags() if far else replace(drags(), noise_sigma_m=0.1)
    recordings = Recordings([scene], (), 12, 3)
    twin = build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=STIFF_PA)
    simulations = JointSimulations(recordings, twin, BUDGET, 1.25)
    frames = recordings.split.train[1]
    tracks, answers = simulations.first_look(Job(twin, frames))
    white = whitener(recordings.scene, recordings.split, scene.noise_sigma_m or 0.0, answers)
    known = parameters_of(twin, separate_bending=False, damping=False)
    stiffness = [of_parameter(p, twin, None) for p in known if p.name == "youngs_modulus_pa"]
    slope, _ = sensitivities(simulations, white, twin, tracks, stiffness, frames)
    fitted = Refit(stiffness, twin, np.array([stiffness[0].start]), tracks, white.residual(tracks), slope)
    assert (fitted.misfit > COMPLETE) == far
    before = simulations.count
    chosen, _ = candidates(twin, ("air_drag_linear", "gravity_tilt"))
    found = basins(simulations, white, fitted, chosen, frames, COMPLETE)
    if not far:
        assert found == [] and simulations.count == before
        return
    assert [basin.candidate.effect for basin in found] == ["air_drag_linear"]
    assert found[0].start.value("youngs_modulus_pa") == pytest.approx(TRUE_PA, rel=0.25)
    assert found[0].cost < 0.2 * float(np.sum(fitted.residual**2))
    assert found[0].start.jacobian.shape == (len(fitted.residual), 1)


def test_stiff_fibres_are_found_where_a_small_share_of_them_says_little() -> None:
    scene = drags()
    plain = build_twin(scene, BUDGET).with_parameters(youngs_modulus_pa=TRUE_PA)
    truth = plain.with_effect(effect("anisotropy", ratio=2.0))
    tracks = truth.observe(truth.simulate_nodes(*scene.control_track(), scene.times), scene.times)
    scene = replace(scene, points=tracks)
    recordings = Recordings([scene], (), 12, 3)
    simulations = JointSimulations(recordings, plain, BUDGET, 1.25)
    frames = recordings.split.train[1]
    tracks, answers = simulations.first_look(Job(plain, frames))
    white = whitener(recordings.scene, recordings.split, SIGMA, answers)
    known = parameters_of(plain, separate_bending=False, damping=False)
    stiffness = [of_parameter(p, plain, None) for p in known if p.name == "youngs_modulus_pa"]
    slope, _ = sensitivities(simulations, white, plain, tracks, stiffness, frames)
    fitted = Refit(stiffness, plain, np.array([stiffness[0].start]), tracks, white.residual(tracks), slope)
    chosen, _ = candidates(plain, ("anisotropy", "gravity_tilt"))
    found = basins(simulations, white, fitted, chosen, frames, COMPLETE)
    assert [basin.candidate.effect for basin in found] == ["anisotropy"]
    assert found[0].candidate.fixed["azimuth_rad"] == found[0].candidate.fixed["elevation_rad"] == 0.0
    assert found[0].strengths[0] * 0.05 == pytest.approx(2.0, rel=0.3)
