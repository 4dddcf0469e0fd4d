"""The twin's promises: what goes in and out, what is held, released, scaled and refused."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from made_scene import FPS, box_body, made_scene
from scipy.spatial.transform import Rotation
from tiny_scene import tiny_scene

from physworld.materials.library import with_law
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Ground, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

SAME_RUN = 1e-12  # [m] two runs of the same numbers
SAME_MOTION = 1e-8  # [m] the same numbers by another way
SINGLE_PRECISION = 1e-6  # [m] two runs of a solid, whose forces are added up in single precision
SMOOTHED = 1e-7  # [m] the smoothing of what particles do not see, felt by what they see
UNSEEN = 3e-4  # [m] what a body of one cell's thickness may bend between its particles
FRAMES = 10
SIZE = np.array([0.12, 0.03, 0.03])
PLATE = np.array([[0.0, 0.0, 0.0], [0.0, 0.03, 0.0], [0.0, 0.0, 0.03]])


def pose(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A smooth motion of a gripper: rotations (T, 3, 3) and shifts (T, 3), none at t = 0."""
    turn = Rotation.from_rotvec(np.sin(3 * times)[:, None] ** 2 * np.array([0.2, -0.5, 0.3])).as_matrix()
    return turn, np.sin(4 * times)[:, None] ** 2 * np.array([0.01, 0.02, 0.015])


def gripped(scene: Scene, markers: np.ndarray, samples: int = FRAMES) -> Scene:
    """The scene with a gripper that moves these markers (K, 3), sampled ``samples`` times over the recording."""
    times = np.linspace(0.0, scene.times[-1], samples)
    turn, shift = pose(times)
    track = np.einsum("tij,kj->tki", turn, markers) + shift[:, None]
    turn, shift = pose(scene.times)
    coarse = np.einsum("tij,kj->tki", turn, markers) + shift[:, None]
    return replace(scene, controllers=coarse, control_times=times, control_points=track)


def bar(**facts: object) -> Scene:
    points = [[0.06, 0.015, 0.03], [0.12, 0.0, 0.015], [0.13, 0.02, 0.04]]  # the last one sits on a stalk
    fields = {
        "body": box_body([0, 0, 0], SIZE, density_kg_m3=300.0),
        "initial_state": UNDEFORMED_AT_REST,
        **facts,
    }
    grips = (Grip((0, 1, 2), np.zeros(3), np.array([0.02, 0.03, 0.03])),)
    return gripped(
        made_scene(points, "beam", PLATE, FRAMES, grips=grips, **fields), PLATE, 6 * (FRAMES - 1) + 1
    )


def sheet() -> Scene:
    plane = np.stack(np.meshgrid(*[np.linspace(0, 0.2, 3)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.concatenate([plane, np.full((9, 1), 0.001)], axis=1)
    points[4, 2] += 0.004  # a thick marker
    scene = made_scene(
        points, "sheet", PLATE, FRAMES, body=Body(thickness_m=2e-3), initial_state=UNDEFORMED_AT_REST
    )
    return gripped(scene, PLATE)


def rope() -> Scene:
    points = np.linspace([0.0, 0.0, 0.0], [0.3, 0.0, 0.0], 5)
    points[2, 2] += 0.003
    scene = made_scene(
        points, "rope", PLATE[:1], FRAMES, body=Body(radius_m=0.004), initial_state=UNDEFORMED_AT_REST
    )
    return gripped(scene, PLATE[:1])


SCENES = {"solid": bar, "sheet": sheet, "rope": rope}


def simulated(twin: Twin, scene: Scene, **options: object) -> np.ndarray:
    return twin.simulate_nodes(*scene.control_track(), scene.times, **options)


@pytest.mark.parametrize("name", SCENES)
def test_a_twin_from_a_file_runs_as_the_one_that_was_written(name: str) -> None:
    scene = SCENES[name]()
    twin = build_twin(scene, 100).with_parameters(air_drag_per_s=0.7)
    twin = replace(twin, release_s=0.05)
    file = io.BytesIO()
    np.savez(file, **twin.to_arrays())
    file.seek(0)
    with np.load(file, allow_pickle=False) as arrays:
        again = Twin.from_arrays(dict(arrays))
    assert again.parameters == twin.parameters and again.body.notes == twin.body.notes
    assert again.release_s == 0.05
    nodes = simulated(twin, scene)
    np.testing.assert_array_equal(simulated(again, scene), nodes)
    np.testing.assert_array_equal(again.track_nodes(nodes), twin.track_nodes(nodes))


@pytest.mark.parametrize(
    ("name", "law", "changed"),
    [
        ("solid", "transversely_isotropic", {"fibre_modulus_pa": 3e5, "fibre_azimuth_rad": 0.2}),
        ("sheet", "orthotropic_sheet", {"shear_ratio": 0.1}),
    ],
)
def test_a_twin_of_another_law_is_written_and_read_with_it(name: str, law: str, changed: dict) -> None:
    scene = SCENES[name]()
    plain = build_twin(scene, 100)
    twin = replace(plain, law=with_law(plain.law, law)).with_parameters(**changed)
    arrays = twin.to_arrays()
    assert Twin.from_arrays(arrays).law == twin.law
    assert np.abs(simulated(twin, scene) - simulated(plain, scene)).max() > SAME_MOTION
    first_version = str(plain.to_arrays()["facts"]).replace(type(plain.law).name, type(plain.law).__name__)
    assert Twin.from_arrays({**arrays, "facts": np.array(first_version)}).law == plain.law


@pytest.mark.parametrize("name", SCENES)
def test_points_tracked_through_the_particles_are_those_tracked_through_the_nodes(name: str) -> None:
    scene = SCENES[name]()
    twin = build_twin(scene, 400)  # at least two cells in every direction
    nodes = simulated(twin, scene)
    particles = twin.simulate(*scene.control_track(), scene.times)
    np.testing.assert_allclose(particles, twin.particles_at(nodes), atol=SAME_RUN)
    np.testing.assert_allclose(twin.track(particles), twin.track_nodes(nodes), atol=SMOOTHED)
    np.testing.assert_allclose(twin.track_nodes(nodes)[0], scene.points[0], atol=SAME_MOTION)
    np.testing.assert_allclose(particles[0], twin.particles_start, atol=SAME_RUN)


def test_points_in_a_body_of_one_cell_s_thickness_are_tracked_through_its_particles() -> None:
    scene = bar()
    twin = build_twin(scene, 100)
    nodes = simulated(twin, scene)
    assert np.ptp(twin.lattice.cells, axis=0).tolist()[1:] == [0, 0]
    np.testing.assert_allclose(twin.track(twin.particles_at(nodes)), twin.track_nodes(nodes), atol=UNSEEN)
    turn = Rotation.from_rotvec([0.4, -0.9, 1.1])
    whole = turn.apply(twin.body.start) + np.array([1.0, 2.0, 3.0])
    tracks = twin.track(twin.particles_at(whole[None]))
    np.testing.assert_allclose(tracks, twin.track_nodes(whole[None]), atol=1e-6)


@pytest.mark.parametrize("name", SCENES)
def test_tracked_points_turn_with_a_body_that_turns_as_a_whole(name: str) -> None:
    twin = build_twin(SCENES[name](), 100)
    turn = Rotation.from_rotvec([0.4, -0.9, 1.1])
    nodes = turn.apply(twin.body.start) + np.array([1.0, 2.0, 3.0])
    if name == "rope":  # a rod carries no twist: turn it about an axis across it
        turn = Rotation.from_rotvec([0.0, -0.9, 1.1])
        nodes = turn.apply(twin.body.start) + np.array([1.0, 2.0, 3.0])
    wanted = turn.apply(SCENES[name]().points[0]) + np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(twin.track_nodes(nodes[None])[0], wanted, atol=SAME_MOTION)


def test_held_material_follows_the_gripper_exactly() -> None:
    scene = bar()
    twin = build_twin(scene, 100)
    nodes = simulated(twin, scene)
    turn, shift = pose(scene.times)
    held = twin.held_nodes[0]
    wanted = np.einsum("tij,nj->tni", turn, twin.body.start[held]) + shift[:, None]
    np.testing.assert_allclose(nodes[:, held], wanted, atol=1e-9)
    free = np.setdiff1d(np.arange(nodes.shape[1]), held)
    assert np.abs(nodes[-1, free] - (twin.body.start[free] @ turn[-1].T + shift[-1])).max() > 1e-3
    clamp = 0.02 - 0.5 / np.sqrt(3.0) * twin.lattice.spacing[0]  # a held layer acts beyond its face
    inside = np.all(twin.particles_start <= [clamp, 0.03, 0.03], axis=1)
    rows = twin.lattice.interpolation(twin.particles_start[inside])
    assert set(np.unique(rows.indices)) <= set(held)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_one_two_and_three_controllers_hold_and_lead(count: int) -> None:
    markers = PLATE[:count]
    times = np.arange(FRAMES) / FPS
    lift = 0.02 * np.sin(4 * times)[:, None, None] ** 2 * np.array([0.0, 0.0, 1.0])
    scene = made_scene(
        [[0.1, 0.0, 0.0]], "beam", markers, FRAMES, body=box_body([0, 0, 0], SIZE, density_kg_m3=300.0)
    )
    scene = replace(scene, controllers=markers[None] + lift)
    twin = build_twin(scene, 100)
    assert [g.tolist() for g in twin.controller_groups] == [list(range(count))]
    nodes = simulated(twin, scene)
    np.testing.assert_allclose(
        nodes[:, twin.held_nodes[0]], twin.body.start[twin.held_nodes[0]] + lift, atol=SAME_MOTION
    )


def test_two_grippers_share_no_node() -> None:
    far = PLATE + np.array([SIZE[0], 0.0, 0.0])
    scene = made_scene(
        [[0.06, 0.0, 0.0]], "beam", np.concatenate([PLATE, far]), body=box_body([0, 0, 0], SIZE)
    )
    twin = build_twin(scene, 100)
    assert [g.tolist() for g in twin.controller_groups] == [[0, 1, 2], [3, 4, 5]]
    assert not set(twin.held_nodes[0]) & set(twin.held_nodes[1])


def test_without_controllers_a_body_falls_freely() -> None:
    scene = made_scene([[0.06, 0.0, 0.0]], "beam", (), FRAMES, body=box_body([0, 0, 0], SIZE))
    twin = build_twin(scene, 100)
    nodes = simulated(twin, scene)
    fall = -0.5 * 9.81 * scene.times**2
    np.testing.assert_allclose(
        (nodes - twin.body.start)[..., 2], fall[:, None] * np.ones(nodes.shape[1]), atol=2e-3
    )


def test_only_ratios_to_the_density_show() -> None:
    scene = bar()
    twin = build_twin(scene, 100)
    both = np.full((len(twin.particles_rest), 2), np.log(3.0))
    plain = simulated(twin, scene)
    np.testing.assert_allclose(simulated(twin, scene, properties=both), plain, atol=SINGLE_PRECISION)
    scaled = twin.with_parameters(youngs_modulus_pa=3e5, density_kg_m3=900.0)
    np.testing.assert_allclose(simulated(scaled, scene), plain, atol=SINGLE_PRECISION)
    stiff = both * [1.0, 0.0]
    stiffer = twin.with_parameters(youngs_modulus_pa=3e5)
    np.testing.assert_allclose(
        simulated(twin, scene, properties=stiff), simulated(stiffer, scene), atol=SINGLE_PRECISION
    )
    assert np.abs(simulated(stiffer, scene) - plain).max() > 1e-3


def test_parameters_go_in_and_out_by_name() -> None:
    twin = build_twin(bar(ground=Ground(-0.5)), 100)
    changed = twin.with_parameters(youngs_modulus_pa=5e4, air_drag_per_s=0.2, ground_friction=0.9)
    assert changed.parameters == {
        **twin.parameters, "youngs_modulus_pa": 5e4, "air_drag_per_s": 0.2, "ground_friction": 0.9,
    }  # fmt: skip
    assert twin.parameters["air_drag_per_s"] == 0.0
    assert twin.parameters["ground_friction"] == 0.5
    with pytest.raises(KeyError, match=r"youngs_modulus.*this twin has.*youngs_modulus_pa"):
        twin.with_parameters(youngs_modulus=1.0)
    with pytest.raises(KeyError, match="ground_friction"):
        build_twin(bar(), 100).with_parameters(ground_friction=0.1)


def test_mass_is_the_declared_one() -> None:
    assert build_twin(bar(), 100).particle_mass.sum() == pytest.approx(300.0 * np.prod(SIZE))
    weighed = bar(body=box_body([0, 0, 0], SIZE, mass_kg=0.5))
    assert build_twin(weighed, 100).particle_mass.sum() == pytest.approx(0.5)


@pytest.mark.parametrize("every", [0.25, 3.0])
def test_frames_may_be_finer_or_coarser_than_the_controls(every: float) -> None:
    scene = bar()
    twin = build_twin(scene, 100)
    times, controls = scene.control_track()
    frames = np.arange(0.0, times[-1], every * (times[1] - times[0]))
    nodes = twin.simulate_nodes(times, controls, frames)
    assert nodes.shape == (len(frames), len(twin.lattice.nodes), 3)
    turn, shift = pose(frames)
    held = twin.held_nodes[0]
    wanted = np.einsum("tij,nj->tni", turn, twin.body.start[held]) + shift[:, None]
    np.testing.assert_allclose(
        nodes[:, held], wanted, atol=1e-4
    )  # between samples the controls are interpolated


def test_one_frame_is_the_start() -> None:
    scene = bar()
    twin = build_twin(scene, 100)
    particles = twin.simulate(*scene.control_track(), scene.times[:1])
    np.testing.assert_allclose(particles, twin.particles_start[None], atol=SAME_RUN)


def test_frames_beyond_the_controls_find_the_gripper_where_it_stopped() -> None:
    scene = bar()
    twin = build_twin(scene, 100)
    times, controls = scene.control_track()
    nodes = twin.simulate_nodes(times, controls, np.array([0.0, times[-1], times[-1] + 0.1]))
    held = twin.held_nodes[0]
    np.testing.assert_allclose(nodes[2, held], nodes[1, held], atol=SAME_RUN)


def test_progress_ends_at_its_total_and_may_stop_the_run() -> None:
    scene = bar()
    told: list[tuple[int, int]] = []
    simulated(build_twin(scene, 100), scene, progress=lambda done, total: told.append((done, total)))
    assert [done for done, _ in told] == list(range(1, told[-1][1] + 1))

    def stop(done: int, total: int) -> None:
        raise InterruptedError(done)

    with pytest.raises(InterruptedError):
        simulated(build_twin(scene, 100), scene, progress=stop)


def dropped(still: int, **facts: object) -> Scene:
    """A bar held level by nobody known for ``still`` frames, then falling about its clamp."""
    scene = made_scene(
        np.linspace([0.03, 0.0, 0.0], [0.12, 0.0, 0.0], 4), "beam", PLATE, FRAMES,
        body=box_body([0, 0, 0], SIZE, density_kg_m3=300.0), noise_sigma_m=1e-4, **facts,
    )  # fmt: skip
    fall = np.where(np.arange(FRAMES) >= still, 0.01 * (np.arange(FRAMES) - still + 1.0), 0.0)
    return replace(scene, points=scene.points - fall[:, None, None] * np.array([0.0, 0.0, 1.0]))


def test_a_body_that_somebody_lets_go_is_held_until_then() -> None:
    scene = dropped(still=5)
    twin = build_twin(scene, 100)
    assert twin.release_s == pytest.approx(4 / FPS)
    nodes = simulated(twin, scene)
    np.testing.assert_array_equal(nodes[:5], np.repeat(twin.body.start[None], 5, axis=0))
    assert np.abs(nodes[5] - twin.body.start).max() > 1e-4
    freed = simulated(twin, scene, from_rest=True)
    assert np.abs(freed[1] - twin.body.start).max() > 1e-4
    # the run after the release is the run without one, later
    early = replace(twin, release_s=0.0).simulate_nodes(
        scene.times[:6], scene.controllers[:6], scene.times[:6]
    )
    np.testing.assert_allclose(nodes[4:], early, atol=1e-7)


def test_a_release_is_read_from_the_points_that_are_seen() -> None:
    scene = dropped(still=5)
    visible, points = scene.visible.copy(), scene.points.copy()
    visible[:, 1], points[:, 1] = False, 0.0
    visible[0, 3], points[0, 3] = False, 90.0  # hidden at first, and zero or anything there
    assert build_twin(replace(scene, visible=visible, points=points), 100).release_s == pytest.approx(4 / FPS)


def test_one_point_that_jumps_is_no_release() -> None:
    scene = dropped(still=6)
    points = scene.points.copy()
    points[2, 0] += 0.05
    assert build_twin(replace(scene, points=points), 100).release_s == pytest.approx(5 / FPS)


def test_a_body_that_is_driven_moves_or_is_declared_at_rest_has_no_release() -> None:
    driven = dropped(still=5)
    controllers = driven.controllers + 0.002 * np.arange(FRAMES)[:, None, None]
    assert build_twin(replace(driven, controllers=controllers), 100).release_s == 0.0
    assert build_twin(dropped(still=1), 100).release_s == 0.0
    assert build_twin(dropped(still=FRAMES), 100).release_s == 0.0
    assert build_twin(dropped(still=5, initial_state=UNDEFORMED_AT_REST), 100).release_s == 0.0
    assert build_twin(dropped(still=8), 100).release_s == 0.0  # nothing of the kind in the training frames


def test_a_run_from_rest_starts_without_velocity() -> None:
    twin = build_twin(bar(), 100)
    thrown = replace(twin, body=replace(twin.body, start_velocity=np.full_like(twin.body.start, 0.5)))
    free = replace(thrown, held_nodes=tuple(h[:0] for h in thrown.held_nodes), gravity_m_s2=np.zeros(3))
    scene = bar()
    np.testing.assert_allclose(simulated(free, scene)[-1], twin.body.start + 0.5 * scene.times[-1], atol=1e-6)
    np.testing.assert_allclose(simulated(free, scene, from_rest=True)[-1], twin.body.start, atol=1e-6)


def test_ground_carries_a_solid_that_nobody_holds() -> None:
    scene = made_scene(
        [[0.06, 0.0, 0.03]], "block", (), 15, body=box_body([0, 0, 0], SIZE), ground=Ground(-0.01, 0.4)
    )
    twin = build_twin(scene, 100)
    assert twin.ground_friction == 0.4
    lowest = simulated(twin, scene)
    heights = twin.particles_at(lowest)[..., 2].min(axis=1)
    assert heights.min() > -0.012
    assert heights[-1] < 0.005


def test_a_control_clock_that_begins_before_the_first_frame_starts_there() -> None:
    scene = tiny_scene()
    clock = np.arange(-60, 100) / 250.0
    lift = 0.05 * clock[:, None, None] * np.array([0.0, 0.0, 1.0])
    track = scene.controllers[:1] + lift
    early = replace(scene, control_times=clock + 1e-3, control_points=track)
    times, points = early.control_track()
    assert times[0] == scene.times[0] and np.all(np.diff(times) > 0.0) and times[-1] == clock[-1] + 1e-3
    np.testing.assert_allclose(
        points, scene.controllers[:1] + lift[0] * (times - 1e-3)[:, None, None] / clock[0]
    )
    np.testing.assert_array_equal(build_twin(early, 60).controllers_start, points[0])
    late = replace(scene, control_times=clock[60:] + 1e-3, control_points=track[60:])
    assert late.control_track()[0] is late.control_times
