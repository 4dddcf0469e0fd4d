"""A twin of a scene with colliders: who grips, what pushes, and that it survives being stored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from physworld.errors import SceneUnsupported
from physworld.scene import UNDEFORMED_AT_REST, Body, DeclaredCollider, Ground, Scene
from physworld.shapes.surface_mesh import SurfaceMesh
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin

pytestmark = pytest.mark.slow

FRAMES = 31
TIMES = np.linspace(0.0, 0.6, FRAMES)
LOW, HIGH = np.array([-0.05, -0.05, 0.0]), np.array([0.05, 0.05, 0.05])
HAND = np.array([[-0.09, 0.0, 0.03], [-0.09, 0.02, 0.03], [-0.09, 0.0, 0.05]])
BALL = DeclaredCollider("ball", "sphere", radius_m=0.02, position_m=HAND[0], controllers=(0, 1, 2))


def pushed(*colliders: DeclaredCollider, carriers: int = 3, **arrays: np.ndarray) -> Scene:
    """A soft block on a table; three controllers (or none) move 80 mm along x."""
    corners = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (0.0, 0.05)])
    travel = np.linspace(0.0, 0.08, FRAMES)
    controllers = HAND[None, :carriers] + travel[:, None, None] * np.array([1.0, 0.0, 0.0])
    return Scene(
        name="push",
        kind="block",
        points=np.repeat(corners[None], FRAMES, axis=0),
        visible=np.ones((FRAMES, 8), dtype=bool),
        controllers=controllers,
        times=TIMES,
        gravity_m_s2=np.array([0.0, 0.0, -9.81]),
        noise_sigma_m=1e-3,
        train=(0, 20),
        test=(20, FRAMES),
        initial_state=UNDEFORMED_AT_REST,
        body=Body(box_min_m=LOW, box_max_m=HIGH, density_kg_m3=500.0),
        ground=Ground(0.0, 0.3),
        colliders=colliders,
        extra_arrays=arrays,
    )


def travel_of(scene: Scene) -> float:
    """How far the block's particles went along x."""
    twin = build_twin(scene, particle_budget=150)
    particles = twin.simulate(scene.times, scene.controllers, scene.times)
    return float((particles[-1] - particles[0])[:, 0].mean())


def test_controllers_that_carry_a_collider_grip_nothing_and_push() -> None:
    scene = pushed(BALL)
    assert build_twin(scene, particle_budget=150).controller_groups == ()
    assert travel_of(scene) == pytest.approx(0.08 - 0.02, abs=4e-3)


def test_the_same_push_from_a_track_of_poses_and_from_a_mesh() -> None:
    poses = np.zeros((FRAMES, 7))
    poses[:, :3] = HAND[0] + np.linspace(0.0, 0.08, FRAMES)[:, None] * np.array([1.0, 0.0, 0.0])
    poses[:, 3] = 1.0
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    on_track = DeclaredCollider("ball", "sphere", radius_m=0.02, poses="ball_poses")
    carved = replace(on_track, shape="mesh", mesh=SurfaceMesh(mesh.vertices, mesh.faces), friction=0.5)
    far = travel_of(pushed(BALL))
    assert travel_of(pushed(on_track, carriers=0, ball_poses=poses)) == pytest.approx(far, abs=2e-3)
    assert travel_of(pushed(carved, carriers=0, ball_poses=poses)) == pytest.approx(far, abs=2e-3)


def test_a_collider_that_never_comes_near_changes_nothing() -> None:
    away = replace(BALL, position_m=np.array([-0.5, 0.0, 0.5]))
    assert travel_of(pushed(away)) == pytest.approx(0.0, abs=1e-5)


def test_a_stored_twin_keeps_its_colliders() -> None:
    mesh = trimesh.creation.box((0.04, 0.04, 0.04))
    turned = Rotation.from_euler("z", 30, degrees=True).as_quat(scalar_first=True)
    cube = replace(
        BALL, shape="mesh", mesh=SurfaceMesh(mesh.vertices, mesh.faces), quaternion_wxyz=turned, friction=0.7
    )
    twin = build_twin(pushed(cube), particle_budget=150)
    again = Twin.from_arrays(twin.to_arrays())
    scene = pushed(cube)
    one = twin.simulate(scene.times[:11], scene.controllers[:11], scene.times[:11])
    other = again.simulate(scene.times[:11], scene.controllers[:11], scene.times[:11])
    assert np.array_equal(one, other)
    assert again.colliders[0].declared.friction == 0.7


def test_a_body_that_starts_inside_a_collider_is_refused_with_the_depth() -> None:
    scene = pushed(replace(BALL, radius_m=0.05, position_m=np.array([0.0, 0.0, 0.05])))
    twin = build_twin(scene, particle_budget=150)
    with pytest.raises(
        SceneUnsupported, match=r"starts 0\.0\d+ m inside of collider 'ball', which is 0\.1 m thick"
    ):
        twin.simulate(scene.times, scene.controllers, scene.times)


@pytest.mark.parametrize(
    ("collider", "message"),
    [
        (replace(BALL, poses="gone", controllers=()), "the poses 'gone' of collider 'ball': no such array"),
        (replace(BALL, radius_m=None), "has no volume"),
        (replace(BALL, shape="mesh"), "collider 'ball' is a mesh without triangles"),
    ],
)
def test_a_collider_that_cannot_be_built_is_refused(collider: DeclaredCollider, message: str) -> None:
    with pytest.raises(SceneUnsupported, match=message):
        build_twin(pushed(collider), particle_budget=150)
