"""What may have recorded a sheet: a mesh of triangles, if one follows the first frames better than the plate does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_scene import recorded_by

from benchmarks.peers.flex_sheet import FlexSheet, record
from physworld.calibrate.parameters import parameters_of
from physworld.effects.actuation_lag import ActuationLag
from physworld.effects.air_drag_quadratic import AirDragQuadratic
from physworld.effects.anisotropy import Anisotropy
from physworld.engine.gradients.gradient_twin import TwinRun
from physworld.engine.thin.triangles import Mesh, TriangleLattice, mesh_of
from physworld.errors import BatchRefused, EffectRefused, NotDifferentiable, SceneUnsupported
from physworld.estimation.simulations import Job
from physworld.evaluate.numerics import measure_numerics, refined
from physworld.geometry.body import first_points
from physworld.geometry.sheet_body import possible_meshes
from physworld.scene import Ground, Scene
from physworld.trace import meshes
from physworld.trace.candidates import candidates
from physworld.trace.meshes import recorded_as, taken_as
from physworld.trace.recordings import JointSimulations, Recordings
from physworld.twin.batch import Episode, simulate_batch
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

SHEET = FlexSheet(frames=16, noise_sigma_m=5e-4, seed=1)
MESH = Mesh((16, 15))


def plate_of(scene: Scene, young_pa: float) -> Twin:
    membrane = young_pa * SHEET.thickness_m / (1.0 - SHEET.poisson**2)
    return build_twin(scene, 500).with_parameters(
        membrane_n_m=membrane, bending_n_m=membrane * SHEET.thickness_m**2 / 12.0, bending_twist_ratio=3.0
    )


def taken(scene: Scene, plate: Twin) -> list[Twin]:
    recordings = Recordings([scene], (), 12, 3)
    simulations = JointSimulations(recordings, plate, 500, 1.4)
    return recorded_as(recordings.scene, plate, simulations, recordings.split.train[1])


def kinds(scene: Scene, plate: Twin) -> list[Mesh | None]:
    return [mesh_of(twin.lattice) for twin in taken(scene, plate)]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A sheet of MuJoCo's, held by two corners."""
    return record(SHEET)


def test_a_mesh_that_recorded_is_found_although_the_stiffness_is_off(scene: Scene) -> None:
    assert kinds(scene, plate_of(scene, 0.87 * SHEET.young_pa)) == [MESH, None]


def test_a_mesh_is_found_although_the_plate_makes_up_for_it_by_half_as_much_stiffness_again(
    scene: Scene,
) -> None:
    mesh, plate = taken(scene, plate_of(scene, 1.45 * SHEET.young_pa))
    own = plate_of(scene, SHEET.young_pa).parameters["membrane_n_m"]
    assert mesh_of(mesh.lattice) == MESH and mesh_of(plate.lattice) is None
    assert mesh.parameters["membrane_n_m"] == pytest.approx(own, rel=0.05)


def test_a_mesh_is_found_beside_an_effect_that_is_not_declared(scene: Scene) -> None:
    own = build_twin(scene, mesh=MESH).with_effect(AirDragQuadratic(coefficient_per_m=1.5))
    law = plate_of(scene, SHEET.young_pa).law
    dragged = recorded_by(replace(own, law=replace(law, bending_twist_ratio=1.0)), scene, 5e-4)
    assert kinds(dragged, plate_of(scene, 0.87 * SHEET.young_pa)) == [MESH, None]


def test_a_plate_that_recorded_stays_a_plate(scene: Scene) -> None:
    finer = build_twin(scene, 2000)
    plate = plate_of(scene, SHEET.young_pa)
    found = kinds(recorded_by(replace(finer, law=plate.law), scene, 5e-4), plate)
    assert found == [None]


def test_where_no_grip_ends_on_the_sheet_it_is_a_plate(scene: Scene) -> None:
    loose = tuple(replace(grip, region_min_m=None, region_max_m=None) for grip in scene.grips)
    plate = plate_of(scene, SHEET.young_pa)
    assert kinds(replace(scene, grips=loose), plate) == [None]


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


def test_a_sheet_that_touches_itself_is_traced_as_a_plate(scene: Scene) -> None:
    touching = replace(scene, declared={"body": {"self_contact": True}})
    plate = build_twin(touching, 500)
    assert plate.self_friction is not None and possible_meshes(touching)
    assert taken(touching, plate) == [plate]


def test_a_sheet_whose_thickness_nobody_says_is_traced_as_a_plate(scene: Scene) -> None:
    points = first_points(scene)
    low, high = points.min(axis=0), points.max(axis=0)
    half = replace(scene.grips[0], region_min_m=low, region_max_m=0.5 * (low + high))
    facts = replace(scene.body, size_m=None, thickness_m=None)
    unknown = replace(scene, body=facts, grips=(half, *scene.grips[1:]))
    plate = build_twin(unknown, 500)
    assert possible_meshes(unknown)
    assert taken(unknown, plate) == [plate]


def test_what_is_known_of_the_ground_goes_along_to_the_mesh(scene: Scene) -> None:
    above = replace(scene, ground=Ground(-1.0))
    plate = replace(plate_of(above, SHEET.young_pa), ground_friction=0.2)
    mesh = taken(above, plate)[0]
    assert mesh_of(mesh.lattice) == MESH and mesh.ground_friction == 0.2


def test_grips_that_say_little_leave_the_squarest_meshes_and_not_too_many(scene: Scene) -> None:
    middle, half = 0.5 * SHEET.size_m[1], 0.5 * SHEET.size_m[0]
    boxes = [
        ([-half, -0.01, 0.6 - middle], [0.0, 0.01, 0.6]),
        ([0.0, -0.01, 0.6 - middle], [half, 0.01, 0.6]),
    ]
    halves = tuple(
        replace(grip, region_min_m=np.array(low), region_max_m=np.array(high))
        for grip, (low, high) in zip(scene.grips, boxes, strict=True)
    )
    found = possible_meshes(replace(scene, grips=halves))
    assert len(found) == len(set(found)) == 24
    shapes = [SHEET.size_m[0] / mesh.counts[0] * mesh.counts[1] / SHEET.size_m[1] for mesh in found]
    assert all(1 / 1.3 < shape < 1.3 for shape in shapes)


def test_other_recordings_of_a_mesh_are_that_mesh(scene: Scene) -> None:
    mesh = build_twin(scene, mesh=MESH)
    recordings = Recordings([scene, scene], [scene], 12, 3)
    simulations = JointSimulations(recordings, mesh, 500, 1.4)
    both = simulations.run([Job(mesh, 4)])[0]
    assert both is not None
    np.testing.assert_array_equal(*np.split(both, 2, axis=1))
    every = simulations.predictions(mesh, np.zeros((both.shape[1], 3)))
    np.testing.assert_array_equal(every[2], every[0])


def test_a_report_says_which_mesh_and_how_to_fit_it() -> None:
    said = taken_as(Mesh((16, 15), odd=True))
    assert "16 x 15 cells of two triangles, the first cut the other way" in said and said.endswith(
        "--mesh 16x15odd fits it so"
    )
    assert Mesh.read("16x15odd") == Mesh((16, 15), odd=True) and Mesh.read("8x4") == Mesh((8, 4))
    for wrong in ("", "16", "16x0", "x", "16x15x2", "16x15 odd", "1e3x4"):
        with pytest.raises(ValueError, match="16x15"):
            Mesh.read(wrong)


def test_a_mesh_is_found_although_the_controls_come_late(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = build_twin(scene, mesh=MESH).with_effect(ActuationLag(lag_s=0.04))
    law = plate_of(scene, SHEET.young_pa).law
    late = recorded_by(replace(own, law=replace(law, bending_twist_ratio=1.0)), scene, 5e-4)
    plate = plate_of(late, 0.87 * SHEET.young_pa)
    found = taken(late, plate)
    assert [mesh_of(twin.lattice) for twin in found] == [MESH, None]
    assert not any(twin.effects for twin in found)  # a lag is for the trace to find
    monkeypatch.setattr(meshes, "_LAGS_S", (-0.01, 0.0))  # without it the mesh is not told from the plate
    assert kinds(late, plate) != [MESH, None]


def test_frames_in_which_nothing_is_seen_do_not_count(scene: Scene) -> None:
    hidden = scene.visible.copy()
    hidden[1:5] = False
    plate = plate_of(scene, 0.87 * SHEET.young_pa)
    assert kinds(replace(scene, visible=hidden), plate) == [MESH, None]
