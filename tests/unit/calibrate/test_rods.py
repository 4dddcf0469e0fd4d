"""Calibration of a rope that our own engine recorded: found within its intervals, journalled, cancelled, cut short."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from made_scene import made_scene, recorded_by

from physworld.calibrate.global_stage import CalibrationConfig, FitResult, prior_twin
from physworld.calibrate.rod_parameters import LOSSES, lossless, rod_parameters
from physworld.calibrate.rods import calibrate_rod
from physworld.errors import Cancelled
from physworld.estimation.journal import Journal
from physworld.scene import Body, Scene
from physworld.twin.rods import first_mode
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

LENGTH, FRAMES = 0.5, 40
BENDING, CURVATURE = 4e-4, 2.5
CONFIG = CalibrationConfig(max_simulations=150)


@cache
def recorded() -> Scene:
    """A rope of known stiffness and curvature that a hand with a pose swings; eight frames in ten train."""
    s = np.linspace(0.0, LENGTH, 9)
    points = np.stack([0.02 * np.sin(6.0 * s), 0.0 * s, -s], axis=1)
    hand = np.array([[0.02, 0.0, 0.0], [-0.02, 0.0, 0.0], [0.0, 0.02, 0.01]])
    body = Body(segment_rest_lengths_m=np.full(8, LENGTH / 8), radius_m=0.004, density_kg_m3=1000.0)
    scene = made_scene(points, "rope", hand, FRAMES, body=body)
    sway = 0.06 * np.sin(2.0 * np.pi * 1.3 * scene.times)[:, None, None] * np.array([1.0, 0.5, 0.0])
    scene = replace(scene, controllers=scene.controllers + sway, train=(0, 32), test=(32, FRAMES))
    return recorded_by(truth(scene), scene, 2e-4)


def truth(scene: Scene) -> Twin:
    """The twin that records it."""
    twin = prior_twin(scene, CONFIG)
    assert twin.natural is not None
    natural = twin.natural.copy()
    natural[first_mode(twin), 0] = CURVATURE
    return replace(twin, natural=natural).with_parameters(
        bending_n_m2=BENDING, relaxation_s=0.02, air_drag_per_s=0.15
    )


def fit(
    config: CalibrationConfig = CONFIG, journal: Journal | None = None, stopped: Sequence[str] = ()
) -> FitResult:
    """A calibration that is cancelled as soon as there is something in ``stopped``."""
    scene = recorded()
    return calibrate_rod(
        [scene], [prior_twin(scene, config)], config, None, lambda: bool(stopped), journal or Journal()
    )


@cache
def found() -> FitResult:
    """Of the whole search."""
    return fit()


def test_stiffness_and_curvature_are_found_within_their_intervals() -> None:
    result = found()
    for name, value in (("bending_n_m2", BENDING), ("curvature_0_0", CURVATURE)):
        estimate = result.parameters[name]
        assert estimate.ci95 is not None
        low, high = estimate.ci95
        assert low < value < high, name
    assert result.parameters["bending_n_m2"].value == pytest.approx(BENDING, rel=0.1)
    scene = recorded()
    off = np.linalg.norm(result.tracks - scene.points, axis=2)[scene.test[0] :]
    assert off.mean() < 3e-3  # of a rope that swings by 12 cm


def test_a_search_that_goes_on_from_its_journal_ends_alike() -> None:
    kept: list[str] = []
    with pytest.raises(Cancelled, match="calibration cancelled after"):
        fit(journal=Journal(save=kept.append), stopped=kept)
    assert kept
    again = fit(journal=Journal(stored=kept[-1]))
    assert np.array_equal(again.tracks, found().tracks)
    assert again.simulations == found().simulations


def test_a_budget_that_ends_is_said() -> None:
    result = fit(replace(CONFIG, max_simulations=3))
    assert result.cut_short
    assert result.simulations <= 3 + 5  # what measures the state beside the search
    assert all("cut short by its budget of 3" in note for note in result.open.values())
    assert result.parameters["bending_n_m2"].ci95 is None


def test_a_rope_without_damping_frees_none() -> None:
    scene = recorded()
    result = fit(replace(CONFIG, max_simulations=30, damping="none"))
    names = {u.name for u in result.searched}
    losses = {"relaxation_s", "air_drag_per_s", "drag_normal_per_m", "friction_per_m", "creep_ratio"}
    assert not names & losses
    assert names < {u.name for u in rod_parameters(scene, prior_twin(scene, CONFIG))}
    twin = prior_twin(scene, replace(CONFIG, damping="none"))
    for name in losses & set(twin.parameters):
        assert result.twin.parameters[name] == twin.parameters[name]


def test_every_number_of_a_rod_is_read_where_it_was_written() -> None:
    scene = recorded()
    twin = prior_twin(scene, CONFIG)
    unknowns = rod_parameters(scene, twin)
    for number, unknown in enumerate(unknowns):
        twin = unknown.at(twin, unknown.start + 0.1 * (1 + number % 3) * unknown.step)
    for number, unknown in enumerate(unknowns):
        assert unknown.read is not None
        there = unknown.searched(float(unknown.read(twin)))
        assert there == pytest.approx(unknown.start + 0.1 * (1 + number % 3) * unknown.step), unknown.name
        if unknown.name not in ("stretching_n", "torsion_ratio"):  # of these a twin's own law is the prior
            assert unknown.prior == rod_parameters(scene, twin)[number].prior


def test_a_rod_without_losses_rings_on() -> None:
    scene = recorded()
    lossy = truth(scene)
    still = lossless(lossy)
    assert {name for name in LOSSES if still.parameters[name] != lossy.parameters[name]} == {
        "relaxation_s",
        "air_drag_per_s",
    }
    paths = [
        twin.observe(twin.simulate_nodes(*scene.control_track(), scene.times), scene.times)
        for twin in (lossy, still)
    ]
    speeds = [float(np.linalg.norm(np.diff(path, axis=0)[-12:], axis=2).mean()) for path in paths]
    assert speeds[1] > 1.02 * speeds[0]
