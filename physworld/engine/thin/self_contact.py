"""Contact of a rope or a sheet with itself, in the total Lagrangian form.

    depth g = thickness - distance        distance: of a contact point's place to the nearest one far along the body
    pressure, friction                    those of the contact with the ground, two in series: half of its k, k_t, c

Distances are those of the spline itself, curve to curve for a rope and point to surface for a sheet, so that the cells
may be larger than the thickness. A sheet's contact points look from both of two layers, and each has half of the
pressure; a rope's pairs share what acts where strands cross (:mod:`physworld.engine.thin.self_contact_search`). Forces
act along the line between the two places, equal and opposite: they conserve linear and angular momentum. Friction is
equal and opposite too, and acts on middle lines a thickness apart: its couple, thickness times force, is what a section
would take up by turning about its axis, which neither form has.

A pair that is first seen nearer than the thickness touches where it is and farther out as it opens, never farther than
the thickness. Each remembers from which side it came, so that what passed through within a substep is pushed back.

Pairs are sought on a grid in space, out to a skin beyond the thickness, and again when the body has moved by half the
skin, the common motion of all of it aside.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.terms.contact import contact_surface
from physworld.engine.terms.term import BoundTerm
from physworld.engine.thin.self_contact_kernels import touch_itself
from physworld.engine.thin.self_contact_places import Body
from physworld.engine.thin.self_contact_search import (
    Points,
    Slots,
    end_search,
    place_cells,
    seek_pairs,
    watch_nodes,
)
from physworld.errors import ContactFailed, SceneUnsupported

if TYPE_CHECKING:
    from physworld.engine.problem import Problem

THINNEST = 0.01  # of a cell: the splines' own waves are larger
COARSE = 0.04  # of a cell: thinner layers may cross where they are bent within a cell
_APART = 2.0  # thicknesses along the body below which no two places touch
_APART_CELLS = {1: 4.0, 2: 2.0}  # and cells: a rope's windows reach a cell to either side
_SKIN = 0.5  # of a cell
_STRETCH = 1.25  # up to which pairs are found
_CROSSED = 1.5  # thicknesses of depth: half of one on the wrong side
_SLOTS = {1: 40, 2: 8}  # the nearest pairs that a contact point keeps
_LANES = 1  # of a search on a CPU, where they run one after another


@dataclass(frozen=True, eq=False)
class SelfContact:
    """A rope or a sheet that cannot pass through itself.

    Attributes:
        thickness_m: distance at which two of its places touch: a sheet's thickness, twice a rope's radius.
        friction: Coulomb's coefficient of the body against itself.
        held: nodes that grips move, (H,): two places that are both held do not touch.
        damping: factor on the damping of the contact; 0 for an elastic one.
    """

    thickness_m: float
    friction: float
    held: Array = field(default_factory=lambda: np.empty(0, dtype=int))
    damping: float = 1.0

    def bind(self, problem: Problem) -> BoundSelfContact:
        """Device arrays for one problem.

        Raises:
            SceneUnsupported: see :func:`refuse_thickness`.
            ValueError: a negative or not finite friction or damping.
        """
        refuse_thickness(problem.lattice, self.thickness_m)
        if not (0 <= self.friction < np.inf and 0 <= self.damping < np.inf):
            raise ValueError(
                f"friction {self.friction} and damping {self.damping} of self-contact: 0 or more"
            )
        return BoundSelfContact(self, problem)


def refuse_thickness(lattice: Lattice, thickness_m: float) -> None:
    """Whether a body can touch itself.

    Raises:
        SceneUnsupported: it is a solid, or so thin that its cells cannot tell its layers apart.
    """
    if lattice.dim == 3:
        raise SceneUnsupported("a solid touches itself in the updated Lagrangian form only")
    cell = float(lattice.spacing.max())
    if not THINNEST * cell <= thickness_m < np.inf:
        raise SceneUnsupported(
            f"self-contact of layers {thickness_m:.3g} m thick on cells of {cell:.3g} m: at least "
            f"{THINNEST * cell:.3g} m is needed (refine the cells, or declare the thickness)"
        )


def apart_m(lattice: Lattice, thickness_m: float) -> float:
    """Distance along the undeformed body below which no two places touch [m]."""
    return max(_APART * thickness_m, _APART_CELLS[lattice.dim] * float(lattice.spacing.max()))


class BoundSelfContact(BoundTerm):
    """Self-contact on a device.

    The bound on what it adds to the time step counts one neighbour on one side of every contact point, like that of
    the ground; the share of the limit that is used (:mod:`physworld.engine.total.stability`) holds one on both sides.

    Attributes:
        differentiable: no; pairs come and go.
    """

    differentiable = False

    def __init__(self, contact: SelfContact, problem: Problem) -> None:
        lattice, device = problem.lattice, problem.device
        self.contact, self.device = contact, device
        surface = contact_surface(lattice, problem.law)
        coordinates, cells, measures = self_points(lattice)
        load = np.asarray(lattice.interpolation(coordinates).T @ measures)
        per_mass = float((load / problem.nodal_mass()).max())
        stiffness, damping = 0.5 * surface.stiffness, 0.5 * contact.damping * surface.damping
        self.frequency_rad_s = float(np.sqrt(2 * stiffness * per_mass))
        self.friction_per_s = 2 * damping * per_mass
        self._law = [wp.float64(0.5 * stiffness), wp.float64(0.5 * damping), wp.float64(contact.friction)]

        def array(values: Array, dtype: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        most = _SLOTS[lattice.dim]
        if lattice.dim == 1:  # those of a strand that bends around another
            most += int(np.ceil(8 * np.pi * contact.thickness_m / lattice.spacing[0]))
        count, points, nodes = len(lattice.cells), len(coordinates), len(lattice.nodes)
        corner = lattice.cells.min(axis=0)
        box = np.ones(2, dtype=int)
        box[: lattice.dim] = np.ptp(lattice.cells, axis=0) + 1
        places = np.zeros((count, 2), dtype=np.int32)
        places[:, : lattice.dim] = lattice.cells - corner
        table = np.full(box, -1, dtype=np.int32)
        table[places[:, 0], places[:, 1]] = np.arange(count)
        low, high = _ends(lattice)
        begin = lattice.origin + corner * lattice.spacing

        def in_cells(values: Array) -> Array:
            found = np.full((len(values), 2), 0.5)
            found[:, : lattice.dim] = (values - begin) / lattice.spacing
            return found

        ends = in_cells(np.stack([low, high]))
        cell = float(lattice.spacing.max())
        self._skin = _SKIN * cell
        half = 0.5 * _STRETCH * float(np.linalg.norm(lattice.spacing))
        # The windows of a rope reach a cell beyond its points.
        self._around = half if lattice.dim == 2 else 5 * half
        self._width = wp.float64(contact.thickness_m + self._skin + half + self._around)
        self._body, self._points, self._slots = Body(), Points(), _empty_slots(points, most, device)
        body = self._body
        body.dim = lattice.dim
        body.cell_nodes = array(lattice.cell_nodes.reshape(-1), wp.int32)
        body.table = array(table.reshape(-1), wp.int32)
        body.counts = wp.vec2i(*(int(n) for n in box))
        body.low, body.high = wp.vec2d(*ends[0]), wp.vec2d(*ends[1])
        spacing = np.zeros(2)
        spacing[: lattice.dim] = lattice.spacing
        body.spacing = wp.vec2d(*spacing)
        body.thickness, body.skin = wp.float64(contact.thickness_m), wp.float64(self._skin)
        body.apart = wp.float64(apart_m(lattice, contact.thickness_m))
        self._points.place = array(in_cells(coordinates), wp.vec2d)
        self._points.measure = array(measures, wp.float64)
        self._points.first = array(np.searchsorted(cells, np.arange(count + 1)), wp.int32)
        self._lanes = _LANES if wp.get_device(device).is_cpu else count
        self._middle = nodes // 2
        self._cells = array(places, wp.vec2i)
        held = np.zeros(nodes)
        held[contact.held] = 1.0
        self._held = array(held, wp.float64)
        self._built = wp.zeros(3 * nodes, dtype=wp.float64, device=device)
        self._moved = wp.zeros(5, dtype=wp.int32, device=device)
        self._ways = wp.zeros(4, dtype=wp.float64, device=device)
        self._centres = wp.zeros(count, dtype=wp.vec3d, device=device)
        self._nexts = wp.zeros(count, dtype=wp.int32, device=device)
        self._heads = wp.full(1 << int(np.ceil(np.log2(2 * count + 1))), -1, dtype=wp.int32, device=device)
        self._deepest = wp.zeros(1, dtype=wp.float64, device=device)

    @property
    def deepest_m(self) -> float:
        """Greatest depth of a contact since the start of the last run [m]."""
        return float(self._deepest.numpy()[0])

    @property
    def searches(self) -> int:
        """How often pairs were sought in the last run."""
        return int(self._moved.numpy()[4])

    @property
    def pairs(self) -> int:
        """Pairs that are followed now."""
        return int(self._slots.counts.numpy().sum())

    def check(self, time_s: float) -> None:
        """After a frame.

        Raises:
            ContactFailed: a part of the body was forced through another.
        """
        thickness = self.contact.thickness_m
        if not self.deepest_m <= _CROSSED * thickness:
            raise ContactFailed(
                f"the body came {self.deepest_m:.3g} m into itself before t = {time_s:.4f} s, where it is "
                f"{thickness:.3g} m thick: it is forced through itself, or too fast for cells of "
                f"{self._skin / _SKIN:.3g} m"
            )

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add contact forces [N] at nodal positions and velocities (3n,) to ``force``.

        Args:
            x, v, clock, counter, force: as in :meth:`BoundTerm.launch`.
        """
        lanes, moved, slots, heads = self._lanes, self._moved, self._slots, self._heads
        most = wp.float64(0.25 * self._skin**2)
        launches = (
            (watch_nodes, [self._middle, most, x, self._built, counter, moved, self._ways]),
            (place_cells,
             [self._body, self._width, x, counter, moved, heads, self._centres, self._nexts, slots, self._deepest]),
            (seek_pairs,
             [self._body, self._points, self._width, wp.float64(self._around), self._cells, x, counter, moved,
              self._centres, heads, self._nexts, slots]),
            (end_search, [x, counter, moved, self._built, heads]),
            (touch_itself,
             [self._body, self._points, *self._law, self._held, x, v, clock, counter, self._ways, moved, slots, force,
              self._deepest]),
        )  # fmt: skip
        for kernel, inputs in launches:
            wp.launch(kernel, dim=lanes, inputs=[lanes, *inputs], device=self.device)


def self_points(lattice: Lattice) -> tuple[Array, Array, Array]:
    """Reference coordinates (S, d) [m], cells (S,) ascending, and measures (S,) [m**d] of the contact points.

    The particles of a sheet; of a rope the middles of its half cells, which are evenly spaced.
    """
    filled = np.flatnonzero(lattice.particle_measures > 0)
    cells = filled // lattice.fill.shape[1]
    coordinates = lattice.particle_coordinates[filled]
    if lattice.dim == 1:
        halves = 0.25 + 0.5 * (filled % 2)
        coordinates = (lattice.origin + (lattice.cells[cells, 0] + halves) * lattice.spacing)[:, None]
        coordinates = np.clip(coordinates, *_ends(lattice))
    return coordinates, cells, lattice.particle_measures[filled]


def _ends(lattice: Lattice) -> tuple[Array, Array]:
    """Where material begins and ends along every axis [m], (d,) each."""
    low, high = np.empty(lattice.dim), np.empty(lattice.dim)
    for axis in range(lattice.dim):
        others = tuple(a + 1 for a in range(lattice.dim) if a != axis)
        halves = lattice.fill.reshape(-1, *(2,) * lattice.dim).max(axis=others)
        begin = lattice.origin[axis] + (lattice.cells[:, axis, None] + [0.0, 0.5]) * lattice.spacing[axis]
        size = 0.5 * lattice.spacing[axis]
        first, last = np.min(begin[halves > 0]), np.max(begin[halves > 0])
        low[axis] = first + size * (1 - halves[begin == first].max())
        high[axis] = last + size * halves[begin == last].max()
    return low, high


def _empty_slots(points: int, most: int, device: str) -> Slots:
    """Room for ``most`` partners of every point of a body, none of them known yet."""
    slots = Slots()
    slots.most = most
    slots.counts = wp.zeros(points, dtype=wp.int32, device=device)
    slots.own = wp.zeros(points * most, dtype=wp.vec2d, device=device)
    slots.other = wp.zeros_like(slots.own)
    slots.middles = wp.zeros_like(slots.own)
    slots.slip = wp.zeros(points * most, dtype=wp.vec3d, device=device)
    slots.side = wp.zeros_like(slots.slip)
    slots.reach = wp.zeros(points * most, dtype=wp.float64, device=device)
    slots.gap = wp.zeros_like(slots.reach)
    slots.active = wp.zeros(points, dtype=wp.int32, device=device)
    slots.actives = wp.zeros(1, dtype=wp.int32, device=device)
    return slots
