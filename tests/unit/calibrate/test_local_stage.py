"""The local stage: a field is found where there is one, thrown away where there is none, and stopped when asked."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_scene import box_body, made_scene
from test_shared_search import Together

from physworld.calibrate.local_search import FieldSearch, LocalConfig, field_modes
from physworld.calibrate.local_stage import fit_fields
from physworld.engine.gradients.soft_grips_derivatives import same_soft_grips
from physworld.engine.terms.soft_grips import AS_HELD
from physworld.errors import CalibrationError, Cancelled, UnstableSimulation
from physworld.scene import UNDEFORMED_AT_REST, Grip, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

SIZE = np.array([0.16, 0.02, 0.02])
MODULUS_PA, NOISE_M = 4e5, 2e-5
FRAMES = 24
QUICK = LocalConfig(modes=3, strengths=(0.001, 0.0001), iterations=8)


def recorded(slope: float, softness: float = 0.0) -> tuple[Scene, Twin]:
    """A shaken bar whose log stiffness falls by ``slope`` from the middle to the end, and its homogeneous twin."""
    points = np.linspace([0.05, 0.01, 0.02], [0.16, 0.01, 0.02], 6)
    plate = np.array([[0.0, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.02]])
    scene = made_scene(
        points, "beam", plate, FRAMES, body=box_body([0, 0, 0], SIZE, density_kg_m3=1000.0),
        grips=(Grip((0, 1, 2), np.zeros(3), np.array([0.032, 0.02, 0.02])),), initial_state=UNDEFORMED_AT_REST,
        noise_sigma_m=NOISE_M,
    )  # fmt: skip
    shake = 0.004 * np.sin(9.0 * scene.times)[:, None, None] * np.array([0.0, 0.5, 1.0])
    scene = replace(scene, controllers=scene.controllers + shake)
    twin = build_twin(scene, 100).with_parameters(youngs_modulus_pa=MODULUS_PA)
    twin = replace(twin, grip_softness=softness)
    properties = np.zeros((twin.lattice.fill.size, 2))
    properties[:, 0] = slope * along(twin)
    nodes = twin.simulate_nodes(*scene.control_track(), scene.times, properties=properties)
    noise = np.random.default_rng(0).normal(scale=NOISE_M, size=scene.points.shape)
    return replace(scene, points=twin.track_nodes(nodes) + noise), twin


def along(twin: Twin) -> np.ndarray:
    return 2.0 * twin.particles_rest[:, 0] / SIZE[0] - 1.0


@pytest.mark.parametrize("softness", [0.0, AS_HELD])
def test_a_field_is_found(softness: float) -> None:
    scene, twin = recorded(-0.6, softness)
    setting = twin.integration(*scene.control_track(), scene.times)
    assert bool(same_soft_grips([setting.problem])) == (softness > 0)
    found = fit_fields(scene, twin, QUICK)
    assert found.kept and found.strength in QUICK.strengths
    free = along(twin) > 2.0 * 0.032 / 0.16 - 1.0  # nothing is known of what the grip holds
    slope = np.polyfit(along(twin)[free], found.properties[free, 0], 1)[0]
    assert slope == pytest.approx(-0.6, abs=0.25)
    homogeneous = twin.track_nodes(twin.simulate_nodes(*scene.control_track(), scene.times))
    test = slice(*scene.test)
    errors = [np.abs(tracks[test] - scene.points[test]).mean() for tracks in (found.tracks, homogeneous)]
    assert errors[0] < 0.5 * errors[1]
    assert not found.properties[:, 1].any()


def test_noise_is_no_field() -> None:
    scene, twin = recorded(0.0)
    found = fit_fields(scene, twin, QUICK)
    assert not found.kept and found.strength is None
    assert not found.properties.any()
    assert "thrown away" in found.reason
    assert set(found.validation) == set(QUICK.strengths)


def test_modes_are_smooth_without_a_mean_and_of_the_priors_size() -> None:
    scene, twin = recorded(0.0)
    modes = field_modes(twin, scene, LocalConfig(modes=40))
    weight = twin.lattice.particle_measures / twin.lattice.particle_measures.sum()
    assert np.abs(weight @ modes).max() < 1e-10
    assert (
        0.2**2 < weight @ np.sum(modes**2, axis=1) < 0.5**2
    )  # the mean's share of the variance is taken out
    few = field_modes(twin, scene, LocalConfig(modes=2))
    assert few.shape[1] == 2
    near = np.abs(along(twin)[:, None] - along(twin)[None]) < 0.1
    assert np.abs(few[:, None] - few[None]).max(axis=2)[near].max() < 0.4


def test_it_can_be_cancelled() -> None:
    scene, twin = recorded(0.0)
    with pytest.raises(Cancelled, match="local stage"):
        fit_fields(scene, twin, QUICK, cancelled=lambda: True)


def test_what_cannot_be_is_refused() -> None:
    scene, twin = recorded(0.0)
    with pytest.raises(ValueError, match="viscosity"):
        fit_fields(scene, twin, replace(QUICK, fields=("viscosity",)))
    with pytest.raises(CalibrationError, match="validate"):
        fit_fields(replace(scene, train=(0, 2)), twin, QUICK)


@pytest.mark.parametrize(
    ("hidden", "word"), [(slice(11, 17), "12 to 16, which validate"), (slice(1, 12), "search")]
)
def test_frames_that_show_nothing_neither_search_nor_validate_a_field(hidden: slice, word: str) -> None:
    scene, twin = recorded(0.0)
    visible = scene.visible.copy()
    visible[hidden] = False
    with pytest.raises(CalibrationError, match=f"nothing is visible in frames .*{word}"):
        fit_fields(replace(scene, visible=visible), twin, QUICK)


def test_the_runs_of_a_hessian_are_shared_and_find_the_same() -> None:
    scene, twin = recorded(-0.6)
    together = Together()
    shared, alone = fit_fields(scene, twin, QUICK, runner=together), fit_fields(scene, twin, QUICK)
    np.testing.assert_array_equal(shared.properties, alone.properties)
    assert (shared.runs, shared.simulations, shared.validation) == (
        alone.runs,
        alone.simulations,
        alone.validation,
    )
    assert together.widths == [5, 5]  # a constant, three modes and none of them, twice


def test_a_field_whose_run_fails_after_the_training_frames_is_thrown_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene, twin = recorded(-0.6)
    simulate = Twin.simulate_nodes

    def fails(self: Twin, *given: Any, properties: np.ndarray | None = None, **more: Any) -> np.ndarray:
        if properties is not None and properties.any() and len(given[2]) == FRAMES:
            raise UnstableSimulation("frame 20")
        return simulate(self, *given, properties=properties, **more)

    monkeypatch.setattr(Twin, "simulate_nodes", fails)
    found = fit_fields(scene, twin, QUICK)
    assert not found.kept and found.strength is None and not found.properties.any()
    assert "thrown away" in found.reason and "frame 20" in found.reason


def test_a_line_search_that_goes_far_astray_simulates_nothing_there() -> None:
    scene, twin = recorded(0.0)
    search = FieldSearch(scene, twin, QUICK, cancelled=lambda: True)  # a run would end in Cancelled
    far = np.zeros(search.size)
    far[0] = 12.0  # a stiffness of 160 000 times
    assert np.isnan(search.errors(far, search.end)).all()
