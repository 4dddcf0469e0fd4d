"""What of a body touches: its contact points, how stiff they are, and the ground under them.

A solid touches with points on the exposed faces of its cells (2 x 2 a face, drawn in where a cell is not full), a sheet
or a rod with its particles, half its thickness or its radius before they reach the obstacle. The penalty is that of one
more cell of the material:

    solid          p = (lambda + 2 mu) / dx depth      shear mu / dx
    sheet, rod     p = rho (c / dx)^2 depth            shear the same, both with half of critical damping

with rho and c the law's own density (per area, per length) and fastest wave speed: a contact adds no mode much faster
than the body's own. Thin bodies have no thickness in which an impact could ring: the damping stands for the energy that
real ones lose there. Friction is Coulomb's, with an elastic slip that holds what sticks where it is (docs/contact.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.engine.lattice.bspline import GAUSS_POINTS
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.terms.colliders import BoundCollider, Collider, ContactSurface
from physworld.engine.terms.colliders_path import RigidPath
from physworld.engine.terms.ground import BoundGround
from physworld.materials.laws import Law
from physworld.shapes.sdf import half_space

if TYPE_CHECKING:
    from physworld.engine.problem import Problem

_EMPTY = 0.02  # an eighth of a cell with less material has no surface
_THIN_DAMPING = 0.5  # share of critical damping in the contact of sheets and rods


@dataclass(frozen=True)
class GroundContact:
    """Ground at ``height_m`` with Coulomb ``friction`` under a body; see :class:`ColliderContact` for ``offsets``."""

    height_m: float
    friction: float
    offsets: Array | float = 0.0

    def bind(self, problem: Problem) -> BoundCollider:
        """Device arrays for one problem; its friction may be a field."""
        plane = ground(self.height_m, self.friction)
        surface = contact_surface(problem.lattice, problem.law, self.offsets)
        if problem.friction_factor is None:
            return BoundCollider(plane, surface, problem)
        return BoundGround(plane, self.height_m, surface, problem)


def ground(height_m: float, friction: float) -> Collider:
    """The ground as a collider: everything below ``height_m``."""
    return Collider("ground", half_space(), RigidPath.still((0.0, 0.0, height_m)), friction)


@dataclass(frozen=True)
class ColliderContact:
    """A rigid collider beside a body.

    Attributes:
        collider: what pushes.
        offsets: distance at which the contact points touch [m]: half a sheet's thickness, a rod's radius, 0 for a
            solid; one number, or one for each point (:func:`touching`).
    """

    collider: Collider
    offsets: Array | float = 0.0

    def bind(self, problem: Problem) -> BoundCollider:
        """Device arrays for one problem."""
        surface = contact_surface(problem.lattice, problem.law, self.offsets)
        return BoundCollider(self.collider, surface, problem)


def contact_surface(lattice: Lattice, law: Law, offsets: Array | float = 0.0) -> ContactSurface:
    """Contact points of a body and their stiffness; see the module's text."""
    points, measures, groups = contact_points(lattice)
    dx = float(lattice.spacing.min())
    stiffness, shear = law.contact_stiffness(dx)
    rate = law.wave_speed_m_s / dx
    damping = 0.0 if lattice.dim == 3 else 2 * _THIN_DAMPING * law.density * rate
    return ContactSurface(
        points=points,
        measures=measures,
        groups=groups,
        offsets=np.broadcast_to(np.asarray(offsets, dtype=float), len(points)),
        stiffness=stiffness,
        shear_stiffness=shear,
        damping=damping,
        rate_per_s=rate,
    )


def touching(lattice: Lattice, nodes: Array, collider: Collider, time_s: float, thickness_m: float) -> Array:
    """Offsets (S,) [m] with which nothing is pressed at nodal positions ``nodes`` (n, 3).

    Points that start inside, by noise or by a thickness that is not quite right, touch there and further in: else the
    penalty would throw them out.

    Args:
        lattice: the body's.
        nodes: nodal positions at the start [m], (n, 3).
        collider: what touches.
        time_s: when the body is let go [s].
        thickness_m: offset of a body that just touches [m].
    """
    points, _, _ = contact_points(lattice)
    gap = collider.distance(lattice.interpolation(points) @ nodes, time_s)
    return np.minimum(thickness_m, gap)


def contact_points(lattice: Lattice) -> tuple[Array, Array, Array]:
    """Reference coordinates (S, d) [m], measures (S,) [m**(d-1) of a solid, else m**d] and groups (S,) of the points
    that touch; those of one group may touch at the same time.
    """
    if lattice.dim < 3:
        solid = lattice.particle_measures > 0
        return (
            lattice.particle_coordinates[solid],
            lattice.particle_measures[solid],
            np.zeros(int(solid.sum()), dtype=int),
        )
    points, areas, groups = [], [], []
    for side, (axis, reference) in enumerate(_face_points(lattice)):
        others = [a for a in range(3) if a != axis]
        area = float(np.prod(lattice.spacing[others])) / 4
        points.append(reference)
        areas.append(np.full(len(reference), area))
        groups.append(np.full(len(reference), side))
    return np.concatenate(points), np.concatenate(areas), np.concatenate(groups)


def _face_points(lattice: Lattice) -> list[tuple[int, Array]]:
    """Axis and points of the exposed faces that look along each of the six directions.

    Where a cell is filled in part, the surface lies as far behind its face as the two eighths of the cell there are
    empty; a quarter of a face with nothing behind it has no point.
    """
    present = {tuple(cell) for cell in lattice.cells}
    eighths = lattice.fill.reshape(-1, 2, 2, 2)
    sides = []
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        for side in (0, 1):
            step = np.zeros(3, dtype=int)
            step[axis] = 1 if side else -1
            exposed = np.array([tuple(c + step) not in present for c in lattice.cells])
            behind = np.moveaxis(eighths[exposed], 1 + axis, 1)
            outer, inner = (behind[:, side], behind[:, 1 - side])
            depth = 0.5 * (1 - outer) * (2 - inner)
            local = np.zeros((int(exposed.sum()), 2, 2, 3))
            local[..., axis] = np.abs(side - depth)
            local[..., others[0]] = np.array(GAUSS_POINTS)[:, None]
            local[..., others[1]] = np.array(GAUSS_POINTS)[None, :]
            places = lattice.origin + (lattice.cells[exposed][:, None, None] + local) * lattice.spacing
            sides.append((axis, places[np.maximum(outer, inner) > _EMPTY]))
    return sides


def surface_points(lattice: Lattice) -> tuple[Array, Array]:
    """Reference coordinates (S, d) [m] and measures (S,) of the contact points."""
    points, measures, _ = contact_points(lattice)
    return points, measures
