"""Sheets: a search that left a plate's bending is brought back to it, and a body without such numbers is left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import made_scene

from physworld.calibrate.parameters import BENDING_RATIO, TWIST_RATIO, parameters_of
from physworld.estimation.refit import Refit, sensitivities
from physworld.estimation.simulations import Job
from physworld.estimation.whitening import whitener
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld.trace.confirm import as_a_plate
from physworld.trace.recordings import JointSimulations, Recordings
from physworld.trace.unknowns import clamp_reach, of_parameter
from physworld.twin.build import build_twin

SIDE, THICKNESS, HELD, FRAMES = 0.2, 0.016, 0.04, 20
BUDGET, TRUE_PA, SIGMA = 500, 2e5, 5e-4


@pytest.fixture(scope="module")
def mat() -> Scene:
    """A slab as thick as its cells, held by one edge's corner region and swung."""
    places = np.linspace(0.0, SIDE, 5)
    points = [[x, 0.0, z] for x in places for z in places]
    handles = [[x, 0.0, z] for x in (0.0, SIDE) for z in (SIDE - HELD, SIDE)]
    half = np.array([0.0, 0.5 * THICKNESS, 0.0])
    grip = Grip((0, 1, 2, 3), np.array([0.0, 0.0, SIDE - HELD]) - half, np.array([SIDE, 0.0, SIDE]) + half)
    body = Body(size_m=np.array([SIDE, THICKNESS, SIDE]), density_kg_m3=330.0)
    scene = made_scene(
        points, "sheet", handles, FRAMES, initial_state=UNDEFORMED_AT_REST, body=body, grips=(grip,)
    )
    t = scene.times[:, None, None]
    return replace(scene, controllers=scene.controllers + 0.02 * np.sin(6.0 * t) * np.array([0.0, 1.0, 0.3]))


def test_a_plate_is_found_again_from_where_other_numbers_made_up_for_it(mat: Scene) -> None:
    twin = build_twin(mat, BUDGET)
    membrane = TRUE_PA * THICKNESS / (1.0 - twin.parameters["poissons_ratio"] ** 2)
    plate = twin.with_parameters(membrane_n_m=membrane, bending_n_m=membrane * THICKNESS**2 / 12.0)
    tracks = plate.observe(plate.simulate_nodes(*mat.control_track(), mat.times), mat.times)
    noise = np.random.default_rng(0).normal(scale=SIGMA, size=tracks.shape)
    scene = replace(mat, points=tracks + noise, noise_sigma_m=SIGMA)
    recordings = Recordings([scene], (), 12, 3)
    wrong = plate.with_parameters(
        membrane_n_m=0.7 * membrane, bending_n_m=0.9 * membrane * THICKNESS**2 / 12.0, bending_twist_ratio=1.8
    )
    simulations = JointSimulations(recordings, wrong, BUDGET, 1.4)
    frames = recordings.split.train[1]
    start, answers = simulations.first_look(Job(wrong, frames))
    white = whitener(recordings.scene, recordings.split, SIGMA, answers)
    known = parameters_of(wrong, separate_bending=False, damping=False)
    named = {p.name: of_parameter(p, wrong, None) for p in known}
    unknowns = [named["youngs_modulus_pa"], named[TWIST_RATIO], named[BENDING_RATIO]]
    slope, _ = sensitivities(simulations, white, wrong, start, unknowns, frames)
    place = np.array([u.start for u in unknowns])
    fitted = Refit(unknowns, wrong, place, start, white.residual(start), slope)
    found = as_a_plate(fitted, simulations, white, frames, 4)
    assert found is not None
    assert [u.name for u in found.unknowns] == ["youngs_modulus_pa"]
    assert found.misfit < 1.1 < fitted.misfit
    assert found.value("youngs_modulus_pa") == pytest.approx(TRUE_PA, rel=0.03)
    law = found.twin.parameters
    assert law["bending_twist_ratio"] == pytest.approx(1.0)
    assert law["bending_n_m"] == pytest.approx(law["membrane_n_m"] * THICKNESS**2 / 12.0)
    assert as_a_plate(found, simulations, white, frames, 4) is None  # it has no such numbers left


def test_a_clamp_reaches_as_far_as_a_body_is_thick(mat: Scene) -> None:
    for budget, most in ((50_000, THICKNESS), (BUDGET, SIDE / 12)):
        reach = clamp_reach(build_twin(mat, budget))
        assert reach is not None
        assert reach.high == pytest.approx(most, rel=0.05)
        assert reach.low == pytest.approx(-most, rel=0.05)


def test_the_cells_of_a_sheet_go_by_the_budget(mat: Scene) -> None:
    cells = [SIDE / float(build_twin(mat, budget).lattice.spacing.max()) for budget in (10, 500, 2000, 4500)]
    assert cells == pytest.approx([12, 12, 24, 36], rel=0.1)
