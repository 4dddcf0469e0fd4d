"""A twin in the updated Lagrangian form: tracked, written, read, compared with the total form."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from tiny_scene import tiny_scene

from physworld.materials.plastic import DruckerPrager, VonMises
from physworld.scene import Body, DeclaredCollider, Ground
from physworld.shapes.sdf import sphere
from physworld.twin.build import build_twin
from physworld.twin.colliders import TwinCollider
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

BUDGET = 300


def stiff(twin: Twin) -> Twin:
    return twin.with_parameters(youngs_modulus_pa=3e5)


def observed(twin: Twin) -> np.ndarray:
    scene = tiny_scene()
    return twin.observe(twin.simulate_nodes(*scene.control_track(), scene.times), scene.times)


def test_the_two_forms_agree_on_an_elastic_bar_in_a_grip() -> None:
    total = stiff(build_twin(tiny_scene(), BUDGET))
    updated = stiff(build_twin(tiny_scene(), BUDGET, formulation="updated_lagrangian"))
    assert (total.formulation, updated.formulation) == ("total_lagrangian", "updated_lagrangian")
    tracks = observed(total), observed(updated)
    moved = np.abs(tracks[0] - tracks[0][0]).max()
    assert np.abs(tracks[1] - tracks[0]).max() < 0.2 * moved  # three cells, one of them in the grip
    assert np.abs(tracks[1][0] - tracks[0][0]).max() < 1e-12


def test_a_transfer_that_damps_less_may_be_asked_for() -> None:
    scene = tiny_scene()
    kinds = {
        name: stiff(build_twin(scene, BUDGET, formulation="updated_lagrangian", transfer=name))
        for name in ("apic", "asflip")
    }
    assert kinds["asflip"].body.notes[-1].endswith("; transfers by asflip")
    assert Twin.from_arrays(kinds["asflip"].to_arrays()).transfer == "asflip"
    times = np.linspace(0.0, 1.0, 61)
    still = np.repeat(scene.control_track()[1][:1], 2, axis=0)
    late = {}
    for name, twin in kinds.items():
        path = twin.observe(twin.simulate_nodes(np.array([0.0, 1.0]), still, times, from_rest=True), times)
        late[name] = np.ptp(path[40:, -1, 2])  # how far it still swings in the last third
    assert late["asflip"] > 1.2 * late["apic"] > 0.0


def test_an_unknown_transfer_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no transfer is called 'pic'; there are \['apic', 'asflip'\]"):
        build_twin(tiny_scene(), BUDGET, transfer="pic")


def test_the_choice_and_its_reason_stand_in_the_notes() -> None:
    assert "total lagrangian form: an elastic solid" in build_twin(tiny_scene(), BUDGET).body.notes[-1]
    twin = build_twin(tiny_scene(), BUDGET, plasticity=VonMises(1e3))
    assert "updated lagrangian form: its flow law is von_mises" in twin.body.notes[-1]


def test_a_twin_that_flows_is_written_and_read_as_it_was() -> None:
    twin = stiff(build_twin(tiny_scene(), BUDGET, plasticity=VonMises(800.0, 50.0)))
    twin = twin.with_parameters(yield_stress_pa=300.0)
    assert twin.parameters["yield_stress_pa"] == 300.0 and twin.parameters["hardening_pa"] == 50.0
    file = io.BytesIO()
    np.savez(file, **twin.to_arrays())
    file.seek(0)
    again = Twin.from_arrays(dict(np.load(file)))
    assert again.plasticity == VonMises(300.0, 50.0)
    assert np.array_equal(observed(again), observed(twin))
    elastic = observed(replace(twin, plasticity=None))
    assert elastic[-1, -1, 2] - observed(twin)[-1, -1, 2] > 1e-3  # what flows sags further


def test_particles_are_what_a_run_returns_and_tracks_are_followed_among_them() -> None:
    scene = tiny_scene()
    twin = stiff(build_twin(scene, BUDGET, formulation="updated_lagrangian"))
    particles = twin.simulate(*scene.control_track(), scene.times)
    assert particles.shape == (scene.frame_count, len(twin.particles_start), 3)
    assert np.abs(particles[0] - twin.particles_start).max() < 1e-12
    assert np.array_equal(twin.track(particles), twin.observe(particles, scene.times))


def test_grains_that_nobody_holds_are_tracked_into_their_heap() -> None:
    base = tiny_scene()
    size = np.array([0.04, 0.04, 0.06])
    points = np.array([[0.0, 0.0, 0.055], [0.015, 0.0, 0.05], [0.0, -0.015, 0.03]])
    scene = replace(
        base,
        kind="sand",
        points=np.repeat(points[None], len(base.times), axis=0),
        visible=np.ones((len(base.times), 3), dtype=bool),
        controllers=np.zeros((len(base.times), 0, 3)),
        body=Body(
            size_m=size, box_min_m=-size * [0.5, 0.5, 0], box_max_m=size * [0.5, 0.5, 1], density_kg_m3=1500.0
        ),
        grips=(),
        ground=Ground(0.0, 0.5),
    )
    twin = stiff(build_twin(scene, 500, plasticity=DruckerPrager(np.radians(30.0))))
    particles = twin.simulate_nodes(*scene.control_track(), scene.times)
    tracks = twin.observe(particles, scene.times)
    assert tracks[-1, 0, 2] < 0.7 * tracks[0, 0, 2]  # the top has come down
    assert (tracks[-1, :, 2] > -0.002).all()
    nearest = np.linalg.norm(tracks[-1][:, None] - particles[-1][None], axis=2).min(axis=1)
    assert nearest.max() < float(twin.lattice.spacing.max())  # and every point is in the heap


def test_a_ball_pushes_a_bar_of_particles_as_it_pushes_one_of_nodes() -> None:
    """The ball comes from the side of the free end and carries it along."""
    scene = tiny_scene()
    tracks = {}
    for form in ("total_lagrangian", "updated_lagrangian"):
        twin = stiff(build_twin(scene, BUDGET, formulation=form)).with_parameters(air_drag_per_s=20.0)
        poses = np.zeros((3, 7))
        poses[:, 3] = 1.0
        poses[:, 0], poses[:, 2] = scene.body.box_max_m[0], 0.0
        poses[:, 1] = scene.body.box_min_m[1] - np.array([0.045, 0.024, 0.024])
        times = scene.times[[0, len(scene.times) // 2, -1]]
        declared = DeclaredCollider("ball", "sphere", radius_m=0.03, poses="ball", friction=0.0)
        pushed = replace(twin, colliders=(TwinCollider(declared, sphere(0.03), times, poses),))
        tracks[form] = observed(pushed) - observed(twin)
    total, updated = tracks.values()
    assert np.abs(total).max() > 2e-3
    assert np.abs(updated - total).max() < 0.35 * np.abs(total).max()  # three cells, one of them in the grip
