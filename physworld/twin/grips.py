"""Grips: which nodes they hold (every node that the gripped material touches), how they move them, how they twist.

A grip of a rope prescribes how the section turns about the axis only where its control points fix a pose: three or
more, not on a line, and far enough from the rope's axis for a turn to stand out of their noise.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.engine.rods.chain import Chain
from physworld.engine.terms.soft_grips import AS_HELD, gripped_points, holds_a_part, touched_nodes
from physworld.engine.terms.term import Term
from physworld.engine.thin.twist import Twist, span_between
from physworld.errors import SceneUnsupported
from physworld.geometry.body import ReferenceBody
from physworld.geometry.rigid import rigid_motion
from physworld.scene import Grip
from physworld.twin.rods import gripped_of_chain

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_OFF_LINE = 0.05  # second extent of control points over the first, below which they count as a line
_FLAT = 1e-9  # component of a unit normal along which a sheet has no depth
_LEVER_SIGMAS = 10.0  # of the tracking noise that control points must stand off the rope's axis


def gripped_nodes(body: ReferenceBody, controllers: Array, grip: Grip | None) -> Array:
    """Every node that gripped material touches: all nodes of cells most of whose material is in the grip.

    In the grip is what lies in its declared box, or within its radius of any of its controllers; without either, what
    is nearest to them.

    Raises:
        SceneUnsupported: no material lies within the radius.
    """
    lattice = body.lattice
    if isinstance(lattice, Chain):
        return gripped_of_chain(lattice, body.start, controllers, grip)
    particles = lattice.interpolation(lattice.particle_coordinates) @ body.start
    slack, tie = 1e-6, 1e-9
    radius = None if grip is None else grip.radius_m
    region = None if grip is None else _region(grip)
    if region is not None and lattice.dim == 3 and np.any(region[1] <= region[0]):
        return _bonded_nodes(body, region)
    if radius is not None:
        inside = _within(body, particles, controllers, radius)
    elif region is not None:
        low, high = region[0] - slack, region[1] + slack
        inside = _through(body, particles, low, high)
    else:
        nearest = lattice.particle_coordinates[_nearest(particles, controllers)]
        reach = 0.5 * lattice.spacing
        low, high = nearest.min(axis=0) - reach, nearest.max(axis=0) + reach
        coordinates = lattice.particle_coordinates
        inside = np.all((coordinates >= low) & (coordinates <= high), axis=1)
    material = lattice.fill.sum(axis=1)
    share = (inside.reshape(lattice.fill.shape) * lattice.fill).sum(axis=1) / np.where(
        material > 0, material, 1.0
    )
    most = share > 0.5 + tie if region is not None or radius is not None else share >= 0.5 - tie
    cells = most if np.any(most) else share > 0
    if not np.any(cells):
        cells = np.zeros(len(lattice.cells), dtype=bool)
        cells[np.unique(_nearest(particles, controllers) // lattice.fill.shape[1])] = True
    return np.unique(lattice.cell_nodes[cells])


def _through(body: ReferenceBody, particles: Array, low: Array, high: Array) -> Array:
    """Whether the body lies in the box from ``low`` to ``high`` (3,) at particles (P, 3), somewhere in its depth, (P,).

    A sheet reaches half its thickness to either side along its normal, and a rope its radius across its axis, nowhere
    else: a box that ends on it holds nothing beyond its end. The material of a cell that is filled in part lies beside
    its particle.
    """
    lattice = body.lattice
    if lattice.dim == 3:
        inside: Array = np.all((particles >= low) & (particles <= high), axis=1)
        return inside
    if lattice.dim == 1:  # a box that cuts half of the section holds it
        tangent = lattice.interpolation(lattice.particle_coordinates, (1,)) @ body.start
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        margin = 0.5 * body.half_thickness_m * np.sqrt(np.clip(1.0 - tangent**2, 0.0, 1.0))
        beside: Array = np.all((particles >= low - margin) & (particles <= high + margin), axis=1)
        return beside
    along, across = (
        lattice.interpolation(lattice.particle_coordinates, orders) @ body.start
        for orders in ((1, 0), (0, 1))
    )
    room = 0.25 * lattice.spacing.max() * (1.0 - lattice.fill.reshape(-1, 1))
    low, high = low - room, high + room
    normal = np.cross(along, across)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # the depths along the normal between which each axis lies in the box; those at which all do
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(low - particles) / normal, (high - particles) / normal])
    flat = np.abs(normal) < _FLAT
    outside = flat & ((particles < low) | (particles > high))
    ends = np.where(flat, np.array([-np.inf, np.inf])[:, None, None], ends)
    first = np.maximum(ends.min(axis=0).max(axis=1), -body.half_thickness_m)
    last = np.minimum(ends.max(axis=0).min(axis=1), body.half_thickness_m)
    through: Array = (first <= last) & ~outside.any(axis=1)
    return through


def _within(body: ReferenceBody, particles: Array, controllers: Array, radius_m: float) -> Array:
    """Which particles (P, 3) with material lie within a radius of any controller (k, 3), (P,) bool.

    Particles stand for an eighth of a cell, or a quarter or a half: one that is as near as its own size counts where no
    other lies within.
    """
    lattice = body.lattice
    distance = np.linalg.norm(particles[:, None] - controllers, axis=2).min(axis=1)
    distance[lattice.fill.reshape(-1) <= 0] = np.inf
    nearest, own = float(distance.min()), 0.25 * float(np.linalg.norm(lattice.spacing))
    if nearest > radius_m + own:
        raise SceneUnsupported(
            f"a grip holds material within {radius_m:.4g} m of its {len(controllers)} controllers; the nearest is "
            f"{nearest:.4g} m away"
        )
    within: Array = distance <= max(radius_m, nearest)
    return within


def declared_region(grip: Grip | None, dim: int) -> Array | None:
    """The box that a grip of a solid holds at the start, (2, 3) [m]; None where none with a depth is declared."""
    box = None if dim != 3 or grip is None else _region(grip)
    return box if box is not None and np.all(box[1] > box[0]) else None


def _region(grip: Grip) -> Array | None:
    """The declared box, (2, 3) [m], or None."""
    if grip.region_min_m is None or grip.region_max_m is None:
        return None
    return np.array([grip.region_min_m, grip.region_max_m], dtype=float)


def softly_held(twin: Twin) -> Twin:
    """A twin of a solid whose grips hold the material in their boxes, if one holds a part of a section; else the same.

    No lattice of splines holds a part of a section as a grip does: prescribed nodes hold far too much. A clamp across
    a whole section needs no more than its reach.
    """
    regions = [region for region in twin.grip_regions if region is not None]
    parts = any(holds_a_part(twin.lattice, twin.body.start, region) for region in regions)
    if not parts or twin.openings or not twin.form.supports("soft_grips") or twin.grip_softness > 0:
        return twin
    return replace(twin, grip_softness=AS_HELD)


def soft_regions(twin: Twin) -> list[Array]:
    """Boxes (2, 3) [m] that soft grips hold; none where all gripped nodes are prescribed, or where a grip opens."""
    if twin.grip_softness <= 0 or twin.openings or not twin.form.supports("soft_grips"):
        return []
    return [region for region in twin.grip_regions if region is not None]


def with_touched_nodes(twin: Twin, start: Array) -> Twin:
    """A twin whose declared grips hold every node that material in their boxes touches at ``start`` (n, 3)."""
    held = []
    taken = np.concatenate([np.empty(0, dtype=int), *twin.held_nodes])
    for nodes, region in zip(twin.held_nodes, twin.grip_regions, strict=True):
        if region is not None:
            touched = touched_nodes(twin.lattice, gripped_points(twin.lattice, start, region))
            more = np.setdiff1d(touched, taken)
            nodes, taken = np.concatenate([nodes, more]), np.concatenate([taken, more])
        held.append(nodes)
    return replace(twin, held_nodes=tuple(held))


def why_no_turn(body: ReferenceBody, nodes: Array, points: Array, noise_sigma_m: float | None) -> str | None:
    """Why a grip's control points do not show how a rope's section turns; None if they do.

    Args:
        body: the rope.
        nodes: that the grip holds.
        points: its control points at the start [m], (k, 3).
        noise_sigma_m: of the tracking [m], or None where nobody says.
    """
    if len(points) < 3:
        return f"{len(points)} control points fix no turn about the axis, 3 are needed"
    local = points - points.mean(axis=0)
    extents = np.linalg.svd(local, compute_uv=False)
    if extents[1] < _OFF_LINE * extents[0]:
        return f"its {len(points)} control points lie on a line, within {extents[1] / max(extents[0], 1e-12):.1%} of it"
    low, high = _extent(body, nodes)
    axis = np.squeeze(body.lattice.interpolation(np.array([[0.5 * (low + high)]]), (1,)) @ body.start)
    axis /= np.linalg.norm(axis)
    lever = float(np.sqrt(np.mean(np.sum(np.cross(local, axis) ** 2, axis=1))))
    least = _LEVER_SIGMAS * (noise_sigma_m or 0.0)
    if lever < least:
        return (
            f"its points stand {lever:.2g} m off the axis, {_LEVER_SIGMAS:g} sigma of noise are {least:.2g} m"
        )
    return None


def twist_between_grips(twin: Twin, times: Array, controls: Array) -> tuple[Term, ...]:
    """Twist of a rope's spans between the grips that show a turn, at ``times`` (T,) under ``controls`` (T, K, 3)."""
    opening = {g for g, one in enumerate(twin.openings) if one is not None}
    turning = [g for g in twin.turning if len(twin.held_nodes[g]) and g not in opening]
    if len(turning) < 2 or twin.law.torsion_n_m2 == 0:
        return ()
    extents = {g: _extent(twin.body, twin.held_nodes[g]) for g in turning}
    turning.sort(key=lambda g: sum(extents[g]))
    spans = []
    for low, high in pairwise(turning):
        groups = [twin.controller_groups[g] for g in (low, high)]
        turns = np.stack([rigid_motion(twin.controllers_start[g], controls[:, g])[0] for g in groups])
        ends = extents[low][1], extents[high][0]
        spans.append(span_between(twin.lattice, twin.body.start, ends, turns, times))
    found = tuple(span for span in spans if span is not None)
    return (Twist(found),) if found else ()


def _extent(body: ReferenceBody, nodes: Array) -> tuple[float, float]:
    """Arc lengths [m] between which a rope's held ``nodes`` fix it: whole cells, else the middle of the nodes."""
    lattice = body.lattice
    whole = np.isin(lattice.cell_nodes, nodes).all(axis=1)
    if not np.any(whole):
        middle = float(lattice.node_coordinates[nodes, 0].mean())
        return middle, middle
    cells = lattice.cells[whole, 0]
    low, high = lattice.origin[0] + np.array([cells.min(), cells.max() + 1]) * lattice.spacing[0]
    return float(low), float(high)


def _bonded_nodes(body: ReferenceBody, region: Array) -> Array:
    """The two layers of nodes whose splines fix an end face: of a grip without depth."""
    axis = int(np.argmin(region[1] - region[0]))
    lattice = body.lattice
    distance = np.abs(lattice.node_coordinates[:, axis] - region[0, axis]) / lattice.spacing[axis]
    return np.flatnonzero(distance < 1.0)


def _nearest(particles: Array, targets: Array) -> Array:
    nearest: Array = np.argmin(np.linalg.norm(targets[:, None] - particles[None], axis=2), axis=1)
    return nearest
