"""What the cameras look at: a beam, a rope, a cloth and a toy of known material, moved by engines that are not ours.

The beam is MuJoCo's flex of ``scripts/make_sample_scene.py``, the bar the same of finite elements whose modulus is
that of the material (``benchmarks.peers.finite_elements``), in a vacuum or in air, or soft in its middle, the rope
the chain of ``scripts/make_sample_rope.py``, the cloth MuJoCo's flex of ``benchmarks.peers.flex_cloths`` or, clamped,
those elements, as is the toy. A gripper of boxes holds them, covers what it holds, and carries an ArUco marker; a stick
goes by between object and camera in the second second.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from benchmarks.tracking.raycast import MARKER, PLAIN, Surface
from physworld.arrays import Array
from physworld.camera import Camera, look_at
from scripts import make_sample_rope, make_sample_scene

FPS, FRAMES = 30.0, 90
CONVERGED_PA, BAR_ELEMENTS, DRAG_PER_S = 2.85e5, (8, 2, 2), 1.0
SOFT_LOG, SOFT_WIDTH = -1.2, 0.18
"""Of the uneven bar: logarithm of its modulus in the middle over the ends', deviation of the dip over its length."""
CLOTH_SIZE_M, CLOTH_THICK_M, CLOTH_DENSITY_KG_M3, CLOTH_PA = (0.25, 0.27), 0.0045, 370.0, 2e5
CLAMPED_CELLS, CLAMPED_M, CLOTH_POISSON = (12, 18), 0.03, 0.3
TOY_PA, TOY_ELEMENTS, TOY_DENSITY_KG_M3, TOY_HELD_M = 3e5, (18, 3, 3), 900.0, 0.04
MARKER_SIDE_M = 0.05
"""Of the marker itself; the plate that it is printed on is a fifth wider on every side."""
MARKER_ID = 7

Pose = Callable[[float], tuple[Array, Array]]
"""Time [s] to a rotation (3, 3) and a shift (3,) [m] about the gripper's middle."""


@dataclass(frozen=True)
class Play:
    """A motion in front of cameras.

    Attributes:
        kind: of the scene.
        surfaces: the object first.
        vertices: of all of them, (T, V, 3) [m].
        object_vertices: how many of them are the object's.
        cameras: the first is the one that a recording with one camera has.
        table_m: height of the table [m].
        declared: what a person knows: keys of ``scene.json``.
        truth: what nobody tells the tracker.
        grip_poses: rotation and shift at every frame, (T, 3, 3) and (T, 3).
        grip_centre: what the gripper turns about, at rest, (3,) [m].
        box_px: around the object in the first camera's first picture, left, top, right, bottom.
        line: of a rope, its middle at every frame, (T, n, 3) [m].
    """

    kind: str
    surfaces: list[Surface]
    vertices: Array
    object_vertices: int
    cameras: list[Camera]
    table_m: float
    declared: dict[str, Any]
    truth: dict[str, Any]
    grip_poses: tuple[Array, Array]
    grip_centre: Array
    box_px: tuple[int, int, int, int] = field(default=(0, 0, 0, 0))
    line: Array | None = None

    @property
    def triangles(self) -> Array:
        """Of the object, (F, 3)."""
        return self.surfaces[0].triangles


def marker_picture() -> Array:
    """The plate with its marker, (n, n) uint8; the marker takes the middle 5/7."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    picture = cv2.aruco.generateImageMarker(dictionary, MARKER_ID, 120)
    return cv2.copyMakeBorder(picture, 24, 24, 24, 24, cv2.BORDER_CONSTANT, value=255)


def beam(frames: int = FRAMES) -> Play:
    """A soft beam that a gripper holds at one end, lifts, swings aside and turns."""
    recipe = make_sample_scene.Recipe()
    mesh = make_sample_scene.build_mesh(recipe)
    positions, _ = make_sample_scene.simulate(recipe, mesh, frames)
    truth = {
        "youngs_modulus_pa": CONVERGED_PA,
        "note": "the coarse mesh, of 2.5e5 Pa, bends as a converged one of this",
    }
    return _held_beam(Surface(boundary(mesh.tetrahedra), mesh.vertices), positions, truth)


def bar(frames: int = FRAMES, drag_per_s: float = 0.0, soft_log: float = 0.0) -> Play:
    """The same body and motion, of quadratic elements, perhaps in air that nobody declares or soft in its middle.

    Args:
        frames: T.
        drag_per_s: c of the air's a = -c v.
        soft_log: logarithm of the modulus in the middle of its length over that of its ends.
    """
    from benchmarks.peers.finite_elements import Acting, Elements, record

    recipe = make_sample_scene.Recipe()
    low, size = np.array(recipe.corner_m), recipe.size_m

    def young_pa(places: Array) -> Array:
        along = (places[:, 0] - low[0]) / size[0]
        modulus: Array = CONVERGED_PA * np.exp(soft_log * np.exp(-0.5 * ((along - 0.5) / SOFT_WIDTH) ** 2))
        return modulus

    elements = Elements(
        BAR_ELEMENTS, lambda unit: low + unit * size, young_pa, recipe.poisson, recipe.density_kg_m3
    )
    held = np.flatnonzero(elements.nodes[:, 0] <= low[0] + recipe.grip_m + 1e-9)
    path = record(
        elements,
        Acting(linear_drag_per_s=drag_per_s),
        [(held, make_sample_scene.grip_pose)],
        np.arange(frames) / FPS,
    )
    mesh = make_sample_scene.build_mesh(recipe)
    nodes, weights = elements.weights(np.clip((mesh.vertices - low) / size, 1e-6, 1.0 - 1e-6))
    positions = np.einsum("pk,tpki->tpi", weights, path[:, nodes])
    truth = {
        "youngs_modulus_pa": CONVERGED_PA,
        "air_drag_per_s": drag_per_s,
        "soft_log": soft_log,
        "note": "these elements bend 1.2 % more stiffly than 16 x 3 x 3 of them do",
    }
    return _held_beam(Surface(boundary(mesh.tetrahedra), mesh.vertices), positions, truth)


def _held_beam(surface: Surface, positions: Array, truth: dict[str, Any]) -> Play:
    recipe = make_sample_scene.Recipe()
    low, size = np.array(recipe.corner_m), recipe.size_m
    centre = low + 0.5 * np.array([recipe.grip_m, size[1], size[2]])
    jaws = [
        box([-0.015, -0.026, 0.52], [0.03, 0.026, 0.535]),
        box([-0.015, -0.026, 0.465], [0.03, 0.026, 0.48]),
        box([-0.09, -0.02, 0.47], [-0.015, 0.02, 0.53]),
    ]
    plate = plate_at([-0.052, -0.024, 0.5])
    declared = {
        "body": {
            "box_min_m": low.tolist(),
            "box_max_m": (low + size).tolist(),
            "size_m": size.tolist(),
            "density_kg_m3": recipe.density_kg_m3,
        },
        "grip": {
            "region_min_m": low.tolist(),
            "region_max_m": (low + np.array((recipe.grip_m, size[1], size[2]))).tolist(),
        },
    }
    return _play(
        "beam", surface, positions, jaws, plate, make_sample_scene.grip_pose,
        centre, declared, truth, target=(0.1, 0.0, 0.5), distance=0.62, table_m=0.25,
    )  # fmt: skip


def rope(frames: int = FRAMES, drag_per_s: float = 0.0) -> Play:
    """A soft round cord that hangs from a gripper, swayed and lifted, perhaps in air that nobody declares: a = -c v.

    One homogeneous section stretches and bends. It is stiff enough that what bends below the jaws, sqrt(E I / T) long
    for the tension T, spans many masses. A chain whose masses are held bends from half a spacing before the last of
    them on: there the jaws end.
    """
    recipe = replace(
        make_sample_rope.Recipe(), masses=121, held=5, radius_m=0.006, bending_n_m2=5e-4, stretching_n=55.0,
        bend_dashpot_n_m2_s=1e-8, stretch_dashpot_n_s=5e-3, steps_per_frame=1200,
    )  # fmt: skip
    path = make_sample_rope.simulate(recipe, frames, drag_per_s)
    around = 12
    tube = np.stack([tube_around(line, recipe.radius_m, around) for line in path])
    triangles = tube_triangles(recipe.masses, around)
    top = np.array([0.0, 0.0, recipe.top_m])
    held = (recipe.held - 1.5) * recipe.length_m / (recipe.masses - 1)
    jaws = [
        box([-0.02, -0.014, recipe.top_m - held], [-0.006, 0.014, recipe.top_m + 0.02]),
        box([0.006, -0.014, recipe.top_m - held], [0.02, 0.014, recipe.top_m + 0.02]),
    ]
    plate = plate_at([0.06, -0.016, recipe.top_m + 0.01])
    declared = {
        "body": {
            "length_m": recipe.length_m,
            "radius_m": recipe.radius_m,
            "mass_kg": recipe.length_m * recipe.density_kg_m,
        },
        "grip": {
            "region_min_m": [-0.01, -0.01, recipe.top_m - held],
            "region_max_m": [0.01, 0.01, recipe.top_m + 0.01],
        },
    }
    truth = {
        "stretching_n": recipe.stretching_n,
        "bending_n_m2": recipe.bending_n_m2,
        "air_drag_per_s": drag_per_s,
    }

    def pose(t: float) -> tuple[Array, Array]:
        return np.eye(3), make_sample_rope.gripped(recipe, t)

    play = _play(
        "rope", Surface(triangles, tube[0], grain_m=0.004), tube, jaws, plate, pose, top, declared, truth,
        target=(0.0, 0.0, 0.78), distance=1.05, table_m=0.2,
    )  # fmt: skip
    return replace(play, line=path)


def cloth(frames: int = FRAMES) -> Play:
    """A cloth that hangs from a bar along its upper edge and is swung to and from the camera.

    Its triangles are held by one row of vertices, about which it turns as on a hinge.
    """
    from benchmarks.peers.finite_elements import Acting
    from benchmarks.peers.flex_cloths import Mesh

    mesh = Mesh(
        CLOTH_SIZE_M, (20, 18), young_pa=CLOTH_PA, thickness_m=CLOTH_THICK_M,
        density_kg_m3=CLOTH_DENSITY_KG_M3, steps_per_frame=460,
    )  # fmt: skip
    rest = mesh.vertices()
    held = np.flatnonzero(rest[:, 2] >= rest[:, 2].max() - 1e-6)
    positions = mesh.record(
        Acting(), [(held, _swing)], (rest[:, [0, 2]] - rest[:, [0, 2]].min(axis=0)) / CLOTH_SIZE_M,
        np.arange(frames) / FPS,
    )  # fmt: skip
    return _hung(mesh.triangles(), positions, 1e-3, 8e-3, {"youngs_modulus_pa": CLOTH_PA})


def clamped_cloth(frames: int = FRAMES, cells: tuple[int, int] = CLAMPED_CELLS) -> Play:
    """The same cloth and motion of quadratic finite elements: a plate, of which the bar holds the upper ``CLAMPED_M``.

    Args:
        frames: T.
        cells: elements across and up.
    """
    from benchmarks.peers.finite_elements import Acting, Elements, record

    width, height = CLOTH_SIZE_M
    size = np.array([width, CLOTH_THICK_M, height])
    elements = Elements(
        (cells[0], 1, cells[1]), lambda unit: unit * size, CLOTH_PA, CLOTH_POISSON, CLOTH_DENSITY_KG_M3
    )
    held = np.flatnonzero(elements.nodes[:, 2] >= height - CLAMPED_M - 1e-6)
    path = record(elements, Acting(), [(held, _swing)], np.arange(frames) / FPS)
    across, up = np.meshgrid(np.linspace(1e-6, 1 - 1e-6, 51), np.linspace(1e-6, 1 - 1e-6, 55))
    nodes, weights = elements.weights(
        np.stack([across.ravel(), np.full(across.size, 0.5), up.ravel()], axis=1)
    )
    positions = np.einsum("pk,tpki->tpi", weights, path[:, nodes])
    number = np.arange(across.size).reshape(across.shape)
    a, b, c, d = (
        part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    )
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    truth = {"youngs_modulus_pa": CLOTH_PA, "poisson": CLOTH_POISSON}
    return _hung(triangles, positions, CLAMPED_M, CLAMPED_M, truth)


def _swing(t: float) -> tuple[Array, Array]:
    gain = 1.0 - np.exp(-((t / 0.4) ** 2))
    shift = gain * np.array([0.04 * np.sin(2.3 * t), 0.05 * np.sin(4.0 * t), 0.02 * np.sin(3.1 * t)])
    angle = gain * 0.3 * np.sin(2.0 * t)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    return turn, shift


def _hung(triangles: Array, positions: Array, held_m: float, jaws_m: float, truth: dict[str, Any]) -> Play:
    """A cloth that hangs from a bar, at first undeformed in a plane of x and z.

    Args:
        triangles: (F, 3).
        positions: (T, V, 3) [m].
        held_m: how much of its upper edge the bar holds.
        jaws_m: how far the bar's jaws reach over it.
        truth: what nobody tells the tracker.
    """
    rest = positions[0]
    low, high = rest.min(axis=0), rest.max(axis=0)
    centre = np.array([0.5 * (low[0] + high[0]), rest[:, 1].mean(), high[2]])
    jaws = [
        box(
            [low[0] - 0.01, centre[1] - 0.012, high[2] - jaws_m],
            [high[0] + 0.01, centre[1] + 0.012, high[2] + 0.01],
        )
    ]
    marker = plate_at([centre[0], centre[1] - 0.014, high[2] + 0.045])
    declared = {
        "body": {
            "size_m": [CLOTH_SIZE_M[0], CLOTH_THICK_M, CLOTH_SIZE_M[1]],
            "thickness_m": CLOTH_THICK_M,
            "density_kg_m3": CLOTH_DENSITY_KG_M3,
        },
        "grip": {
            "region_min_m": [low[0] - 1e-3, centre[1] - 1e-2, high[2] - held_m],
            "region_max_m": [high[0] + 1e-3, centre[1] + 1e-2, high[2] + 1e-3],
        },
    }
    return _play(
        "sheet", Surface(triangles, rest), positions, jaws, marker, _swing, centre, declared, truth,
        target=(centre[0], centre[1], high[2] - 0.13), distance=0.62, table_m=high[2] - 0.45,
    )  # fmt: skip


def toy(frames: int = FRAMES) -> Play:
    """A soft body of no simple shape, of quadratic finite elements: round, thin in its middle, arched; a gripper holds
    one end, lifts, swings aside and turns."""
    from benchmarks.peers.finite_elements import Acting, Elements, record

    def shape(unit: Array) -> Array:
        along, square = unit[:, 0], 2.0 * unit[:, 1:] - 1.0
        disc = square * np.sqrt(1.0 - 0.3 * square[:, ::-1] ** 2)  # a square with round corners
        radius = 0.027 + 0.006 * np.cos(2.0 * np.pi * along)
        arch = 0.03 * np.sin(np.pi * along)
        low = make_sample_scene.Recipe().corner_m
        return np.stack(
            [low[0] + 0.24 * along, radius * disc[:, 0], 0.5 + arch + radius * disc[:, 1]], axis=1
        )

    elements = Elements(TOY_ELEMENTS, shape, TOY_PA, 0.35, TOY_DENSITY_KG_M3)
    end = float(elements.nodes[:, 0].min()) + TOY_HELD_M
    held = np.flatnonzero(elements.nodes[:, 0] <= end + 1e-9)
    path = record(elements, Acting(), [(held, make_sample_scene.grip_pose)], np.arange(frames) / FPS)
    places, triangles = box_skin(33, 13)
    nodes, weights = elements.weights(np.clip(places, 1e-6, 1.0 - 1e-6))
    positions = np.einsum("pk,tpki->tpi", weights, path[:, nodes])
    rest = positions[0]
    low, high = rest.min(axis=0), rest.max(axis=0)
    centre = elements.nodes[held].mean(axis=0)
    jaws = [
        box([low[0] - 0.015, -0.03, 0.538], [end - 0.005, 0.03, 0.553]),
        box([low[0] - 0.015, -0.03, 0.447], [end - 0.005, 0.03, 0.462]),
        box([low[0] - 0.09, -0.02, 0.47], [low[0] - 0.015, 0.02, 0.53]),
    ]
    declared = {
        "body": {"density_kg_m3": TOY_DENSITY_KG_M3},
        "grip": {
            "region_min_m": [low[0], -0.04, 0.44],
            "region_max_m": [end, 0.04, 0.56],
        },
    }
    return _play(
        "toy", Surface(triangles, rest), positions, jaws, plate_at([low[0] - 0.052, -0.024, 0.5]),
        make_sample_scene.grip_pose, centre, declared, {"youngs_modulus_pa": TOY_PA},
        target=(float(0.5 * (low[0] + high[0])), 0.0, 0.5), distance=0.62, table_m=0.25,
    )  # fmt: skip


PLAYS = {
    "beam": beam,
    "bar": bar,
    "uneven_bar": partial(bar, soft_log=SOFT_LOG),
    "bar_in_air": partial(bar, drag_per_s=DRAG_PER_S),
    "rope": rope,
    "rope_in_air": partial(rope, drag_per_s=DRAG_PER_S),
    "cloth": cloth,
    "clamped_cloth": clamped_cloth,
    "toy": toy,
}


def _play(
    kind: str,
    surface: Surface,
    positions: Array,
    jaws: list[tuple[Array, Array]],
    plate: tuple[Array, Array, Array],
    pose: Pose,
    centre: Array,
    declared: dict[str, Any],
    truth: dict[str, Any],
    target: tuple[float, float, float],
    distance: float,
    table_m: float,
) -> Play:
    frames = len(positions)
    turns, shifts = (np.stack(part) for part in zip(*(pose(t / FPS) for t in range(frames)), strict=True))
    surfaces, parts = [surface], [positions]
    for corners, triangles in jaws:
        surfaces.append(Surface(triangles, corners, PLAIN, (0.25, 0.27, 0.3)))
        parts.append(np.einsum("tij,vj->tvi", turns, corners - centre) + centre + shifts[:, None])
    corners, triangles, uv = plate
    surfaces.append(Surface(triangles, uv, MARKER, (1.0, 1.0, 1.0)))
    parts.append(np.einsum("tij,vj->tvi", turns, corners - centre) + centre + shifts[:, None])
    eyes = [around(np.array(target), distance, azimuth, 24.0) for azimuth in (-90.0, -35.0, -145.0)]
    cameras = [look_at(eye, np.array(target), field_of_view_deg=43.0) for eye in eyes]
    stick, triangles = box([-0.008, -0.008, -0.4], [0.008, 0.008, 0.4])
    share = np.clip((np.arange(frames) / FPS - 0.9) / 1.0, 0.0, 1.0)
    way = np.array(target) + [-0.45, -0.25, 0.0] + share[:, None] * [0.9, 0.0, 0.0]
    surfaces.append(Surface(triangles, stick, PLAIN, (0.15, 0.3, 0.5)))
    parts.append(stick + way[:, None])
    pixels, _ = cameras[0].project(positions[0])
    low, high = np.floor(pixels.min(axis=0)).astype(int) - 6, np.ceil(pixels.max(axis=0)).astype(int) + 6
    return Play(
        kind,
        surfaces,
        np.concatenate(parts, axis=1),
        positions.shape[1],
        cameras,
        table_m,
        declared,
        truth,
        (turns, shifts),
        centre,
        (int(low[0]), int(low[1]), int(high[0]), int(high[1])),
    )


def around(target: Array, distance: float, azimuth_deg: float, elevation_deg: float) -> Array:
    """A place (3,) [m] so far from the target, in that direction."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    return target + distance * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def boundary(tetrahedra: Array) -> Array:
    """Triangles (F, 3) that belong to one tetrahedron alone."""
    faces = np.concatenate([tetrahedra[:, list(f)] for f in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]


def box(low: Any, high: Any) -> tuple[Array, Array]:
    """Corners (8, 3) and triangles (12, 3) of a box."""
    import trimesh

    shape = trimesh.creation.box(bounds=[low, high])
    return np.asarray(shape.vertices), np.asarray(shape.faces)


def box_skin(along: int, across: int) -> tuple[Array, Array]:
    """Places (V, 3) on the six sides of a box from 0 to 1, and triangles (F, 3), so many points along x and across."""
    places, triangles, begin = [], [], 0
    counts = (along, across, across)
    for axis in range(3):
        u, v = [other for other in range(3) if other != axis]
        one, two = np.meshgrid(np.linspace(0, 1, counts[u]), np.linspace(0, 1, counts[v]), indexing="ij")
        number = np.arange(one.size).reshape(one.shape)
        a, b, c, d = (
            part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:])
        )
        for side in (0.0, 1.0):
            own = np.zeros((one.size, 3))
            own[:, u], own[:, v], own[:, axis] = one.ravel(), two.ravel(), side
            outward = (axis != 1) is (side == 1.0)  # u, v and the axis turn right but for y
            way = (a, b, c, d) if outward else (a, d, c, b)
            triangles += [
                begin + np.stack([way[0], way[1], way[2]], axis=1),
                begin + np.stack([way[0], way[2], way[3]], axis=1),
            ]
            places.append(own)
            begin += one.size
    return np.concatenate(places), np.concatenate(triangles)


def plate_at(middle: Any) -> tuple[Array, Array, Array]:
    """Corners (4, 3), triangles (2, 3) and picture coordinates (4, 3) of a plate that looks along -y."""
    half = 0.5 * MARKER_SIDE_M * 7.0 / 5.0
    uv = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    offset = np.stack([uv[:, 0] - 0.5, np.zeros(4), 0.5 - uv[:, 1]], axis=1) * 2.0 * half
    return np.asarray(middle) + offset, np.array([[0, 2, 1], [0, 3, 2]]), uv


def tube_around(line: Array, radius_m: float, around: int) -> Array:
    """Vertices (n * around, 3) of a tube along a line (n, 3), its section carried on without twist."""
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    first = np.cross(tangent[0], [0.0, 1.0, 0.0])
    normals = [first / np.linalg.norm(first)]
    for now in tangent[1:]:
        carried = normals[-1] - (normals[-1] @ now) * now
        normals.append(carried / np.linalg.norm(carried))
    normal = np.stack(normals)
    side = np.cross(tangent, normal)
    angle = 2.0 * np.pi * np.arange(around) / around
    ring = np.cos(angle)[None, :, None] * normal[:, None] + np.sin(angle)[None, :, None] * side[:, None]
    return (line[:, None] + radius_m * ring).reshape(-1, 3)


def tube_triangles(rings: int, around: int) -> Array:
    """Triangles of ``tube_around``, open at the ends, (F, 3)."""
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    return np.concatenate(
        [np.stack([a, b, b + around], axis=-1), np.stack([a, b + around, a + around], axis=-1)]
    ).reshape(-1, 3)
