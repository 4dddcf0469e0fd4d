"""Pictures of textured triangles by casting rays (Warp, CPU): colour, depth, and which material point a pixel shows.

A texture is a function of the place in the undeformed body, so that it moves as painted material does. One light from
above, no shadows, Lambert's law: brightness changes as a surface turns, which a tracker has to bear.

A pixel is the mean over its area, as of a sensor: nine rays of which no two share a row or a column (rooks on a chess
board), shifted by chance in every pixel (Cranley & Patterson 1976). A regular grid of rays would put every edge that
runs along a row of pixels at the next ray, up to half a ray's distance away, all along it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.camera import Camera

FAR_M = 10.0
SAMPLES = 3
"""Its square is the number of a pixel's rays; their mean is the colour."""

SPECKLED, PLAIN, MARKER = 0, 1, 2
"""What a triangle is painted with: speckles of its material, one colour, or the picture of a marker."""


@dataclass(frozen=True)
class Surface:
    """Triangles with their paint.

    Attributes:
        triangles: (F, 3) indices into the vertices.
        rest: places of the vertices in the undeformed body [m], (V, 3); of a marker, its picture's coordinates in
        0 to 1. paint: SPECKLED, PLAIN or MARKER.
        colour: red, green, blue in 0 to 1.
        grain_m: size of the speckles.
    """

    triangles: Array
    rest: Array
    paint: int = SPECKLED
    colour: tuple[float, float, float] = (0.7, 0.45, 0.3)
    grain_m: float = 0.006


class Stage:
    """Surfaces over a speckled table, seen by cameras.

    Args:
        surfaces: their vertices follow one another in the arrays given to ``show``.
        table_m: height of the table [m].
        marker: picture of the markers, (n, n) uint8.
    """

    def __init__(self, surfaces: list[Surface], table_m: float, marker: Array | None = None) -> None:
        starts = np.cumsum([0, *(len(surface.rest) for surface in surfaces)])
        triangles = [surface.triangles + start for surface, start in zip(surfaces, starts[:-1], strict=True)]
        self._triangles = wp.array(np.concatenate(triangles).ravel(), dtype=wp.int32)
        self._rest = wp.array(np.concatenate([surface.rest for surface in surfaces]), dtype=wp.vec3)
        owner = np.repeat(np.arange(len(surfaces)), [len(surface.triangles) for surface in surfaces])
        self._owner = wp.array(owner, dtype=wp.int32)
        self._paint = wp.array([surface.paint for surface in surfaces], dtype=wp.int32)
        self._colour = wp.array([surface.colour for surface in surfaces], dtype=wp.vec3)
        self._grain = wp.array([surface.grain_m for surface in surfaces], dtype=wp.float32)
        self._marker = wp.array(np.full((1, 1), 255) if marker is None else marker, dtype=wp.uint8)
        self._table_m = table_m
        self._own = [slice(*ends) for ends in pairwise(starts)]
        self._bare: tuple[Camera, tuple[Array, Array, Array]] | None = None

    def show(self, vertices: Array, camera: Camera, seed: int = 0) -> tuple[Array, Array, Array]:
        """Colour (H, W, 3) uint8, depth along the axis (H, W) float32 [m], and the surface seen (H, W), -1 for none.

        Args:
            vertices: of all surfaces [m], (V, 3).
            camera: from where.
            seed: of the shifts of the rays.
        """
        found = [part.copy() for part in self._table(camera)]
        for own in self._own:
            pixels, distance = camera.project(vertices[own])
            low, high = np.zeros(2, dtype=int), np.array([camera.width, camera.height])
            if (distance > 0.0).all():
                low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - 1, low, high)
                high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + 1, low, high)
            if (high > low).all():
                box = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
                for whole, part in zip(found, self._cast_box(vertices, camera, seed, box), strict=True):
                    whole[box[1] : box[3], box[0] : box[2]] = part
        return found[0], found[1], found[2]

    def _table(self, camera: Camera) -> tuple[Array, Array, Array]:
        """What the camera sees where none of the surfaces is: it does not move, nor does the table."""
        if self._bare is None or self._bare[0] is not camera:
            nowhere = np.tile([0.0, 0.0, self._table_m - FAR_M], (len(self._rest), 1))
            whole = (0, 0, camera.width, camera.height)
            self._bare = (camera, self._cast_box(nowhere, camera, 0, whole))
        return self._bare[1]

    def _cast_box(
        self, vertices: Array, camera: Camera, seed: int, box: tuple[int, int, int, int]
    ) -> tuple[Array, Array, Array]:
        """Colour, depth and surface of the pixels from left and top to before right and bottom."""
        mesh = wp.Mesh(points=wp.array(vertices, dtype=wp.vec3), indices=self._triangles)
        turn = wp.mat33(*camera.world_to_camera[:3, :3].T.ravel().tolist())
        size = (box[3] - box[1], box[2] - box[0])
        colour = wp.zeros(size, dtype=wp.vec3)
        depth = wp.zeros(size, dtype=wp.float32)
        seen = wp.zeros(size, dtype=wp.int32)
        wp.launch(
            _cast,
            dim=size,
            inputs=[
                mesh.id,
                self._triangles,
                self._rest,
                self._owner,
                self._paint,
                self._colour,
                self._grain,
                self._marker,
                turn,
                wp.vec3(*camera.centre.tolist()),
                wp.vec4(camera.fx, camera.fy, camera.cx - box[0], camera.cy - box[1]),
                self._table_m,
                seed,
            ],
            outputs=[colour, depth, seen],
        )
        return np.clip(colour.numpy() * 255.0, 0.0, 255.0), depth.numpy(), seen.numpy()


@wp.func
def _speckles(place: wp.vec3, grain: float) -> float:
    coarse = wp.noise(wp.uint32(7), place / (2.5 * grain))
    fine = wp.noise(wp.uint32(11), place / grain)
    return 0.6 * coarse + 0.6 * fine


@wp.kernel
def _cast(
    # model
    mesh: wp.uint64,
    triangles: wp.array(dtype=wp.int32),
    rest: wp.array(dtype=wp.vec3),
    owner: wp.array(dtype=wp.int32),
    paint: wp.array(dtype=wp.int32),
    paint_colour: wp.array(dtype=wp.vec3),
    grain: wp.array(dtype=wp.float32),
    marker: wp.array2d(dtype=wp.uint8),
    turn: wp.mat33,
    eye: wp.vec3,
    lens: wp.vec4,
    table: float,
    seed: int,
    # out
    colour_out: wp.array2d(dtype=wp.vec3),
    depth_out: wp.array2d(dtype=wp.float32),
    seen_out: wp.array2d(dtype=wp.int32),
) -> None:
    row, column = wp.tid()
    light = wp.normalize(wp.vec3(0.3, -0.5, 0.8))
    total = wp.vec3(0.0, 0.0, 0.0)
    chance = wp.rand_init(seed, row * 65536 + column)
    shift_x = wp.randf(chance)
    shift_y = wp.randf(chance)
    for sample in range(SAMPLES * SAMPLES + 1):
        # the last ray goes through the middle and measures
        dx = float(sample) / float(SAMPLES * SAMPLES) + shift_x
        dy = float(SAMPLES * (sample % SAMPLES) + sample // SAMPLES) / float(SAMPLES * SAMPLES) + shift_y
        dx -= wp.floor(dx)
        dy -= wp.floor(dy)
        if sample == SAMPLES * SAMPLES:
            dx = 0.5
            dy = 0.5
        local = wp.vec3((float(column) + dx - lens[2]) / lens[0], (float(row) + dy - lens[3]) / lens[1], 1.0)
        length = wp.length(local)
        direction = turn * (local / length)
        far = float(FAR_M)
        colour = wp.vec3(0.35, 0.37, 0.4)
        seen = -1
        if direction[2] < 0.0:
            reach = (table - eye[2]) / direction[2]
            if reach < far:
                far = reach
                speckle = _speckles(eye + reach * direction, 0.02)
                colour = wp.vec3(0.45, 0.45, 0.42) * (0.8 + 0.5 * speckle)
        hit = wp.mesh_query_ray(mesh, eye, direction, far)
        if hit.result:
            far = hit.t
            seen = owner[hit.face]
            a = rest[triangles[3 * hit.face]]
            b = rest[triangles[3 * hit.face + 1]]
            c = rest[triangles[3 * hit.face + 2]]
            place = hit.u * a + hit.v * b + (1.0 - hit.u - hit.v) * c
            bright = 0.55 + 0.45 * wp.abs(wp.dot(hit.normal, light))
            tone = 1.0
            if paint[seen] == SPECKLED:
                tone = 0.75 + 0.8 * _speckles(place, grain[seen])
            if paint[seen] == MARKER:
                n = float(marker.shape[0])
                i = int(wp.clamp(place[1] * n, 0.0, n - 1.0))
                j = int(wp.clamp(place[0] * n, 0.0, n - 1.0))
                tone = float(marker[i, j]) / 255.0
            colour = paint_colour[seen] * tone * bright
        if sample < SAMPLES * SAMPLES:
            total += colour / float(SAMPLES * SAMPLES)
        else:
            depth_out[row, column] = far / length
            seen_out[row, column] = seen
    colour_out[row, column] = total
