"""Global to local: a field that holds becomes the twin's own, one that does not is thrown away; kills cost little."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from test_local_stage import QUICK, SIZE, along, recorded

from physworld.calibrate import CalibrationConfig, FitResult, Journal, calibrate, calibrate_in_stages
from physworld.calibrate.local_stage import fit_fields
from physworld.errors import Cancelled, SceneUnsupported
from physworld.evaluate.numerics import refined
from physworld.scene import Scene
from physworld.trace import trace
from physworld.twin.properties import carried, together
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

CONFIG = CalibrationConfig(particle_budget=100, max_simulations=60, damping="none")


def held_out_error(scene: Scene, tracks: np.ndarray) -> float:
    frames = slice(*scene.test)
    return float(np.sqrt(np.mean((tracks[frames] - scene.points[frames]) ** 2)))


@pytest.fixture(scope="module")
def graded() -> tuple[Scene, FitResult, list[str]]:
    """A bar whose stiffness falls along it, its fit in two stages, and the journals as they were saved."""
    scene, _ = recorded(-0.6)
    saved: list[str] = []
    journal = Journal("bar", None, saved.append)
    return scene, calibrate_in_stages(scene, CONFIG, "global+local", QUICK, journal=journal), saved


def test_a_field_that_holds_is_the_twins_and_predicts_better(
    graded: tuple[Scene, FitResult, list[str]],
) -> None:
    scene, fitted, _ = graded
    assert fitted.local is not None and fitted.local.kept and fitted.homogeneous is not None
    assert fitted.twin.properties is not None
    free = along(fitted.twin) > 2.0 * 0.032 / SIZE[0] - 1.0  # nothing is known of what the grip holds
    assert np.polyfit(along(fitted.twin)[free], fitted.twin.properties[free, 0], 1)[0] < -0.3
    assert held_out_error(scene, fitted.tracks) < 0.5 * held_out_error(scene, fitted.homogeneous)
    nodes = fitted.twin.simulate_nodes(*scene.control_track(), scene.times)
    np.testing.assert_array_equal(fitted.twin.observe(nodes, scene.times), fitted.tracks)


def test_a_field_is_stored_with_the_twin_and_carried_to_a_finer_lattice(
    graded: tuple[Scene, FitResult, list[str]],
) -> None:
    scene, fitted, _ = graded
    twin, control = fitted.twin, scene.control_track()
    again = Twin.from_arrays(twin.to_arrays()).simulate(*control, scene.times)
    np.testing.assert_array_equal(again, twin.simulate(*control, scene.times))
    finer = refined(scene, twin, 100)
    assert finer.properties is not None and twin.properties is not None
    assert len(finer.properties) > len(twin.properties)
    for power in (1, 2):
        fits = [np.polyfit(along(one), one.properties[:, 0], power) for one in (twin, finer)]
        np.testing.assert_allclose(*(np.polyval(fit, [-0.5, 0.0, 0.5]) for fit in fits), atol=0.05)


def test_what_a_run_is_given_comes_on_top(graded: tuple[Scene, FitResult, list[str]]) -> None:
    scene, fitted, _ = graded
    given = np.random.default_rng(0).normal(scale=0.2, size=(len(fitted.twin.particles_rest), 2))
    plain = replace(fitted.twin, properties=None)
    control = scene.control_track()
    both = fitted.twin.simulate(*control, scene.times, properties=given)
    assert fitted.twin.properties is not None
    summed = plain.simulate(*control, scene.times, properties=fitted.twin.properties + given)
    np.testing.assert_array_equal(both, summed)


def test_a_kill_in_the_local_stage_ends_where_the_uninterrupted_one_does(
    graded: tuple[Scene, FitResult, list[str]],
) -> None:
    scene, whole, saved = graded
    names = [entry["name"] for entry in json.loads(saved[-1])["entries"]]
    cut = next(k for k, name in enumerate(names) if name.startswith("field at")) + 1
    resumed = calibrate_in_stages(
        scene, CONFIG, "global+local", QUICK, journal=Journal("bar", saved[cut - 1])
    )
    assert resumed.local is not None and whole.local is not None
    assert resumed.local.validation == whole.local.validation
    assert (resumed.local.runs, resumed.local.simulations) == (whole.local.runs, whole.local.simulations)
    np.testing.assert_array_equal(resumed.tracks, whole.tracks)


def test_it_goes_on_from_a_finished_global_stage_and_can_be_cancelled(
    graded: tuple[Scene, FitResult, list[str]],
) -> None:
    scene, _, saved = graded
    stored: list[str] = []
    alone = calibrate(scene, CONFIG, journal=Journal("bar", None, stored.append))
    seen: list[tuple[int, int, str]] = []

    def stop() -> bool:
        return len(seen) > 3

    with pytest.raises(Cancelled, match="local stage"):
        calibrate_in_stages(
            scene, CONFIG, "global+local", QUICK, lambda *told: seen.append(told), stop, Journal("bar", stored[-1])
        )  # fmt: skip
    local = [told for told in seen if "field" in told[2]]
    assert local and all(alone.simulations < done <= total for done, total, _ in local)
    assert (
        json.loads(saved[-1])["entries"][: len(json.loads(stored[-1])["entries"])]
        == (json.loads(stored[-1])["entries"])
    )


def test_a_homogeneous_body_gets_no_field() -> None:
    scene, _ = recorded(0.0)
    fitted = calibrate_in_stages(scene, CONFIG, "global+local", QUICK)
    alone = calibrate_in_stages(scene, CONFIG)
    assert fitted.local is not None and not fitted.local.kept and "thrown away" in fitted.local.reason
    assert fitted.twin.properties is None and fitted.homogeneous is None
    np.testing.assert_array_equal(fitted.tracks, alone.tracks)
    assert alone.local is None


def test_what_cannot_be_is_refused(graded: tuple[Scene, FitResult, list[str]]) -> None:
    scene, fitted, _ = graded
    flowing = replace(CONFIG, plasticity="von_mises")
    with pytest.raises(SceneUnsupported, match="updated lagrangian"):
        calibrate_in_stages(scene, flowing, "global+local")
    with pytest.raises(ValueError, match="no stages 'both'"):
        calibrate_in_stages(scene, CONFIG, "both")  # type: ignore[arg-type]
    with pytest.raises(SceneUnsupported, match="homogeneous"):
        trace(scene, calibrated_twin=fitted.twin)


def test_progress_counts_up_to_about_what_is_announced() -> None:
    scene, twin = recorded(-0.6)
    told: list[tuple[int, int, str]] = []
    found = fit_fields(scene, twin, QUICK, lambda *seen: told.append(seen))
    counts = [done for done, _, _ in told]
    assert counts == sorted(counts) and counts[-1] <= told[-1][1]
    assert found.runs + found.simulations == counts[-1]


def test_fields_add_up_and_are_carried() -> None:
    field = np.arange(6.0).reshape(3, 2)
    assert together(None, None) is None and together(field, None) is field
    np.testing.assert_array_equal(together(field, np.ones((3, 3))), np.c_[field + 1, np.ones(3)])
    with pytest.raises(ValueError, match="3 and 4 particles"):
        together(field, np.zeros((4, 2)))
    places = np.random.default_rng(0).uniform(size=(200, 3))
    linear = places @ np.array([[1.0], [2.0], [0.5]])
    found = carried(linear, places, places[:5])
    np.testing.assert_allclose(found, linear[:5], atol=1e-6)
    centre = carried(linear, places, np.full((1, 3), 0.5))
    assert centre is not None and centre[0, 0] == pytest.approx(1.75, abs=0.15)
