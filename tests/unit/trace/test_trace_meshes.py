"""A sheet as the mesh of triangles that recorded it: what such a twin lacks, where it goes, and a trace of one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import recorded_by

from benchmarks.peers.flex_cloths import Mesh as Recorder
from benchmarks.peers.flex_sheet import FlexSheet, record
from physworld.calibrate import CalibrationConfig
from physworld.calibrate.parameters import parameters_of
from physworld.effects.anisotropy import Anisotropy
from physworld.effects.registry import effect
from physworld.engine.thin.triangles import Mesh, TriangleLattice, mesh_of
from physworld.errors import BatchRefused, EffectRefused, NotDifferentiable, SceneUnsupported
from physworld.estimation.simulations import Job
from physworld.evaluate.numerics import measure_numerics, refined
from physworld.scene import Scene
from physworld.trace import TraceConfig, document, trace
from physworld.trace.candidates import candidates
from physworld.trace.recordings import JointSimulations, Recordings
from physworld.twin.batch import Episode, simulate_batch
from physworld.twin.build import build_twin
from physworld.twin.gradient import TwinRun
from physworld.twin.twin import Twin

SHEET = FlexSheet(frames=16, noise_sigma_m=5e-4, seed=1)
MESH = Mesh((16, 15))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A sheet of MuJoCo's, held by two corners."""
    return record(SHEET)


def test_a_mesh_has_no_numbers_and_no_effects_that_splines_alone_have(scene: Scene) -> None:
    twin = build_twin(scene, mesh=MESH)
    assert {p.name for p in parameters_of(twin, separate_bending=False, damping=False)} == {
        "youngs_modulus_pa", "bending_ratio", "poissons_ratio"
    }  # fmt: skip
    found, refused = candidates(twin)
    names = {candidate.effect for candidate in found}
    assert {"air_drag_quadratic", "wind", "gravity_tilt", "tether", "viscosity_kelvin_voigt"} <= names
    for name in ("anisotropy", "plasticity", "viscoelastic_maxwell", "strain_stiffening", "rest_shape"):
        assert "240 cells of triangles" in refused[name]
    with pytest.raises(EffectRefused, match="triangles"):
        twin.with_effect(Anisotropy(ratio=0.5))


def test_a_mesh_travels_as_arrays_and_is_refused_where_it_cannot_go(scene: Scene) -> None:
    twin = build_twin(scene, mesh=Mesh((8, 15), odd=True))
    back = Twin.from_arrays(twin.to_arrays())
    assert isinstance(back.lattice, TriangleLattice) and back.lattice.mesh == Mesh((8, 15), odd=True)
    times, controls = scene.control_track()
    assert np.array_equal(
        back.simulate_nodes(times, controls, scene.times[:3]), twin.simulate_nodes(times, controls, scene.times[:3])
    )  # fmt: skip
    with pytest.raises(BatchRefused, match="triangles"):
        simulate_batch(twin, [Episode(times, controls, scene.times[:3])])
    with pytest.raises(SceneUnsupported, match="does not touch itself"):
        build_twin(replace(scene, declared={"body": {"self_contact": True}}), mesh=MESH)
    with pytest.raises(SceneUnsupported, match="is no 16 x 15 cells"):
        build_twin(replace(scene, kind="rope"), mesh=MESH)
    with pytest.raises(SceneUnsupported, match="no finer ones"):
        refined(scene, twin, 500)
    with pytest.raises(SceneUnsupported, match="the ledger is of splines"):
        measure_numerics(scene, twin)
    with pytest.raises(NotDifferentiable, match="120 cells of triangles"):
        TwinRun(twin, times, controls, scene.times[:3])


def test_a_grid_that_starts_as_measured_is_no_mesh(scene: Scene) -> None:
    side = 6
    grid = replace(
        scene,
        points=scene.points[:, : side**2],
        visible=scene.visible[:, : side**2],
        body=replace(scene.body, side_m=0.25, grid_shape=(side, side)),
        grips=(),
    )
    with pytest.raises(SceneUnsupported, match="starts flat and undeformed"):
        build_twin(grid, mesh=MESH)


def test_other_recordings_of_a_mesh_are_that_mesh(scene: Scene) -> None:
    mesh = build_twin(scene, mesh=MESH)
    recordings = Recordings([scene, scene], [scene], 12, 3)
    simulations = JointSimulations(recordings, mesh, 500, 1.4)
    both = simulations.run([Job(mesh, 4)])[0]
    assert both is not None
    np.testing.assert_array_equal(*np.split(both, 2, axis=1))
    every = simulations.predictions(mesh, np.zeros((both.shape[1], 3)))
    np.testing.assert_array_equal(every[2], every[0])


def test_a_mesh_is_named_by_its_cells() -> None:
    assert str(Mesh((16, 15), odd=True)) == "16 x 15 cells of two triangles, the first cut the other way"
    assert Mesh.read("16x15odd") == Mesh((16, 15), odd=True) and Mesh.read("8x4") == Mesh((8, 4))
    for wrong in ("", "16", "16x0", "x", "16x15x2", "16x15 odd", "1e3x4"):
        with pytest.raises(ValueError, match="16x15"):
            Mesh.read(wrong)


@pytest.mark.slow
def test_a_trace_on_the_named_mesh_names_the_drag_and_says_what_the_sheet_was_taken_as() -> None:
    sheet, mesh = Recorder(cells=(8, 7), frames=24, seed=3), Mesh((8, 7))
    scene = record(sheet)
    declared = build_twin(scene, mesh=mesh)
    membrane = sheet.young_pa * sheet.thickness_m / (1.0 - sheet.poisson**2)
    own = declared.with_parameters(membrane_n_m=membrane, bending_n_m=membrane * sheet.thickness_m**2 / 12.0)
    dragged = recorded_by(own.with_effect(effect("air_drag_linear", rate_per_s=3.0)), scene, 5e-4)
    config = TraceConfig(
        calibration=CalibrationConfig(damping="none", mesh=mesh),
        candidates=("air_drag_linear", "gravity_tilt"),
        bootstraps=100,
        experiment=None,
    )
    found = trace(dragged, config)
    assert found.verdict.name == "named" and found.better is not None
    assert mesh_of(found.better.lattice) == mesh
    assert document(found)["effects"][0]["parameters"]["rate_per_s"]["value"] == pytest.approx(3.0, rel=0.1)
    assert "taken as a mesh that another engine recorded, 8 x 7 cells" in " ".join(document(found)["notes"])
