"""Bodies of the gallery with a surface: the skins and tubes of the dashboard's 3D views, drawn by the film's renderer.

``physworld_services.dashboard.surfaces`` says what a twin's body looks like from outside and what carries it. Here all
of the twin's particles carry it, and each frame becomes small flat Gaussians, one for every part of a triangle, which
have the triangle's shape and the light that falls on it. So a surface that is stretched stays closed.
"""

from __future__ import annotations

import numpy as np

from physworld.arrays import Array
from physworld.twin.twin import Twin
from physworld.video import Gaussians
from physworld.video.gaussians import SH_DC
from physworld.worldmodel.model.skinning import local_rotations, quaternion_of
from physworld_services.dashboard.surfaces import Surface, body_surface
from physworld_services.dashboard.tubes import Tubes

SIDES = 16  # of a tube
MOST_PATCHES = 24_000
SPREAD = 2.0  # standard deviation of a patch over that of its triangle: patches just close the surface
THIN = 0.05  # thickness of a patch over its smaller width
OPAQUE_LOGIT = 5.0
SHADE, LIGHT = 0.55, 0.5  # a face's brightness away from the light, and what the light adds
SUN = np.array([0.3, 0.2, 1.0])  # where the light comes from, beside the camera


def surface_of_twin(twin: Twin) -> Surface | Tubes:
    """The surface of a twin's body, carried by all of its particles.

    Raises:
        ValueError: a body without one.
    """
    rest = twin.particles_rest
    found = body_surface(twin.to_arrays(), rest, np.arange(len(rest)))
    if found is None:
        raise ValueError("the twin has no cells, or too many for a surface")
    return found


class DrawnSurface:
    """A surface as Gaussians.

    Args:
        surface: of the body.
        start: particles at the first frame [m], (P, 3).
        camera: where the camera is [m], (3,).

    Attributes:
        middles: of the patches at the first frame [m], (G, 3).
    """

    def __init__(self, surface: Surface | Tubes, start: Array, camera: Array) -> None:
        self._surface, self._camera = surface, camera
        self._triangles = (
            surface.triangles if isinstance(surface, Surface) else _tube_triangles(surface.lines)
        )
        self._parts = _parts(max(1, int(np.sqrt(MOST_PATCHES / len(self._triangles)))))
        self.middles = self._patches(start)[0].mean(axis=1)

    def at(self, particles: Array, colours: Array) -> Gaussians:
        """The patches when the particles are at (P, 3) [m], in colours (G, 3) of [0, 1] under white light."""
        corners, normals = self._patches(particles)
        middles = corners.mean(axis=1)
        offsets = corners - middles[:, None]
        spread, axes = np.linalg.eigh(np.einsum("gkx,gky->gxy", offsets, offsets) / 12.0)
        axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
        widths = SPREAD * np.sqrt(np.maximum(spread, 1e-16))
        widths[:, 0] = THIN * widths[:, 1]
        toward = self._camera - middles
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        normals *= np.where((normals * toward).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
        return Gaussians(
            middles,
            np.log(widths),
            quaternion_of(axes),
            np.full(len(middles), OPAQUE_LOGIT),
            ((lit(colours, normals, toward) - 0.5) / SH_DC)[:, None],
        )

    def _patches(self, particles: Array) -> tuple[Array, Array]:
        """Corners (G, 3, 3) and normals (G, 3) of the parts of all triangles."""
        points = _points(self._surface, particles)
        corners = points[self._triangles]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals = np.zeros_like(points)
        for corner in self._triangles.T:
            np.add.at(normals, corner, across)
        patches = np.einsum("pkc,tcx->tpkx", self._parts, corners).reshape(-1, 3, 3)
        turned = np.einsum("pc,tcx->tpx", self._parts.mean(axis=1), normals[self._triangles]).reshape(-1, 3)
        length = np.linalg.norm(turned, axis=1, keepdims=True)
        return patches, turned / np.maximum(length, np.finfo(float).tiny)


def lit(colours: Array, normals: Array, toward: Array) -> Array:
    """Colours (G, 3) of faces under the light, which stands above the camera.

    Args:
        colours: under white light, (G, 3) or (3,).
        normals: of the faces, (G, 3).
        toward: unit vectors to the camera, (G, 3) or (3,).
    """
    sun = toward + SUN
    sun /= np.linalg.norm(sun, axis=-1, keepdims=True)
    brightness = SHADE + LIGHT * np.maximum((normals * sun).sum(axis=-1), 0.0)
    found: Array = np.minimum(colours * brightness[:, None], 1.0)
    return found


def _points(surface: Surface | Tubes, particles: Array) -> Array:
    """Where the surface's points are when the particles are at (P, 3) [m]."""
    if isinstance(surface, Surface):
        turns = local_rotations(surface.rest, particles, index=surface.neighbours)[surface.index]
        offsets = surface.points[:, None] - surface.rest[surface.index]
        carried = particles[surface.index] + np.einsum("mkxy,mky->mkx", turns, offsets)
        points: Array = np.einsum("mk,mkx->mx", surface.weight, carried)
        return points
    centres = np.einsum("mk,mkx->mx", surface.weight, particles[surface.index])
    lines = np.split(centres, np.cumsum(surface.lines)[:-1])
    return np.concatenate([_rings(line, surface.radius_m) for line in lines])


def _rings(line: Array, radius_m: float) -> Array:
    """Rings of ``SIDES`` points around the places (m, 3) of a centre line, each without a turn to the one before."""
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    outward = np.eye(3)[2 if abs(along[0, 2]) < 0.8 else 0]
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    rings = np.empty((len(line), SIDES, 3))
    for place, direction in enumerate(along):
        outward = outward - (outward @ direction) * direction
        outward /= np.linalg.norm(outward)
        ring = np.cos(angle)[:, None] * outward + np.sin(angle)[:, None] * np.cross(direction, outward)
        rings[place] = line[place] + radius_m * ring
    return rings.reshape(-1, 3)


def _tube_triangles(lines: tuple[int, ...]) -> Array:
    """Triangles (t, 3) between the rings of each line."""
    found, first = [], 0
    for count in lines:
        corner = (first + np.arange(count))[:, None] * SIDES + np.arange(SIDES)
        low, high = corner[:-1], corner[1:]
        low_next, high_next = np.roll(low, -1, axis=1), np.roll(high, -1, axis=1)
        for three in ((low, low_next, high), (low_next, high_next, high)):
            found.append(np.stack(three, axis=-1).reshape(-1, 3))
        first += count
    return np.concatenate(found)


def _parts(count: int) -> Array:
    """The count² equal parts of a triangle: barycentric coordinates of their corners, (count², 3, 3)."""
    found = []
    for i in range(count):
        for j in range(count - i):
            found.append([(i, j), (i + 1, j), (i, j + 1)])
            if i + j + 2 <= count:
                found.append([(i + 1, j), (i + 1, j + 1), (i, j + 1)])
    place = np.array(found) / count
    return np.concatenate([1.0 - place.sum(axis=-1, keepdims=True), place], axis=-1)
