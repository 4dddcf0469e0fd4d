"""The friction of the ground as a field: found where it shows, held at its prior and reported where it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import made_scene

from physworld.calibrate.local_search import FieldSearch, LocalConfig
from physworld.calibrate.local_stage import fit_fields
from physworld.errors import SceneUnsupported
from physworld.scene import UNDEFORMED_AT_REST, Body, Ground, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

LENGTH, RADIUS = 0.4, 0.004
NOISE_M, FRAMES = 5e-5, 30
SLOPE = -0.8
QUICK = LocalConfig(fields=("friction",), modes=3, strengths=(0.001,), iterations=8)


def dragged(slope: float, height_m: float = -RADIUS) -> tuple[Scene, Twin]:
    """A rope that lies along x and is jerked aside at one end; log friction falls by ``slope`` to either side."""
    s = np.linspace(0, LENGTH, 9)
    points = np.stack([s, 0 * s, 0 * s], axis=1)
    scene = made_scene(points, "rope", [[0.0, 0.0, 0.0]], FRAMES, initial_state=UNDEFORMED_AT_REST,
                       body=Body(length_m=LENGTH, radius_m=RADIUS), ground=Ground(height_m, 0.5),
                       noise_sigma_m=NOISE_M)  # fmt: skip
    way = np.stack([-0.05 * scene.times, 0.06 * np.sin(9.0 * scene.times), 0 * scene.times], axis=1)
    scene = replace(scene, controllers=scene.controllers + way[:, None])
    twin = build_twin(scene).with_parameters(bending_n_m2=1e-4, stretching_n=20.0)
    properties = np.zeros((twin.lattice.fill.size, 3))
    properties[:, 2] = slope * along(twin)
    nodes = twin.simulate_nodes(*scene.control_track(), scene.times, properties=properties)
    noise = np.random.default_rng(0).normal(scale=NOISE_M, size=scene.points.shape)
    return replace(scene, points=twin.track_nodes(nodes) + noise), twin


def along(twin: Twin) -> np.ndarray:
    return 2.0 * twin.particles_rest[:, 0] / LENGTH - 1.0


def test_a_field_of_friction_is_found() -> None:
    scene, twin = dragged(SLOPE)
    found = fit_fields(scene, twin, QUICK)
    assert found.fields == ("friction",)
    assert found.kept and not found.held
    free = np.abs(along(twin)) < 0.9
    assert np.polyfit(along(twin)[free], found.properties[free, 2], 1)[0] == pytest.approx(SLOPE, abs=0.3)
    assert not found.properties[:, :2].any()
    homogeneous = twin.track_nodes(twin.simulate_nodes(*scene.control_track(), scene.times))
    test = slice(*scene.test)
    errors = [np.abs(tracks[test] - scene.points[test]).mean() for tracks in (found.tracks, homogeneous)]
    assert errors[0] < 0.5 * errors[1]


def test_friction_of_a_ground_that_is_never_touched_is_held_at_its_prior() -> None:
    scene, twin = dragged(0.0, height_m=-5.0)
    found = fit_fields(scene, twin, QUICK)
    assert found.fields == () and not found.kept
    assert "not identified, held at its prior" in found.held["friction"]
    assert found.held["friction"] in found.reason
    assert not found.properties.any()


def test_without_a_ground_friction_is_no_field() -> None:
    scene, twin = dragged(0.0)
    bare = replace(twin, ground_height_m=None)
    search = FieldSearch(scene, bare, replace(QUICK, fields=("stiffness", "friction")), None)
    assert search.fields == ("stiffness",)
    with pytest.raises(ValueError, match="need a ground"):
        FieldSearch(scene, bare, QUICK, None)
    with pytest.raises(SceneUnsupported, match="needs a ground"):
        bare.simulate_nodes(
            *scene.control_track(), scene.times, properties=np.zeros((twin.lattice.fill.size, 3))
        )


def test_a_dropped_field_leaves_the_others_as_they_were() -> None:
    scene, twin = dragged(0.0)
    both = FieldSearch(scene, twin, replace(QUICK, fields=("stiffness", "friction")), None)
    alone = FieldSearch(scene, twin, replace(QUICK, fields=("stiffness",)), None)
    z = np.zeros(both.size)
    full = both._curvature(z, 10)
    both.drop("friction")
    assert both.fields == ("stiffness",) and both.size == alone.size
    assert both._curvature(z[: both.size], 10) == pytest.approx(
        alone._curvature(z[: both.size], 10), rel=1e-6
    )
    assert full.shape == (2 * alone.size, 2 * alone.size)
    assert both.properties(np.ones(both.size)).shape == (twin.lattice.fill.size, 2)
