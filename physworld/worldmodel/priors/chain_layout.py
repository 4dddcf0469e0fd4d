"""Where the nodes of a chain lie, and how grips and vertices carry them (``physworld.worldmodel.priors.chain``).

A grip's frame R follows from its control vertices as the twin's does: three that are not in line give a full one, two
the least rotation that turns their direction from the start's, one none. A vertex is held by the grip in whose frame it
does not move in the data. NumPy only.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from physworld.arrays import Array
from physworld.geometry.rigid import least_rotation
from physworld.worldmodel.model.graph import GraphSpec

STRAIGHT = 1e-3  # rest vertices leave a line by less than that share of its length
HELD = (2e-4, 1e-3, 4e-3)
"""A held vertex moves in its grip's frame by less than that share of the length: by the first that any vertex meets.
The twin's frame of a grip is fitted to all its markers, this one to three of them, and markers are noisy."""
IN_LINE = (
    1e-3  # control vertices nearer to the line of two others than that share of their distance are on it
)
READ_RIDGE = 1e-6
FEWEST_VERTICES = 12


@dataclass(frozen=True)
class GripFrames:
    """Frames of G grips from C control vertices.

    Attributes:
        anchor: c̄_g = anchor · c, (G, C).
        first, second: two directions of a grip, rows of (G, C) times c; 0 where there are too few vertices.
        axis: the first direction at the start, (G, 3).
        markers: 1: a frame that does not turn; 2: the least rotation of ``axis`` onto the first direction; 3: the first
            direction, the normal of both, and what is left.
    """

    anchor: Array
    first: Array
    second: Array
    axis: Array
    markers: Array


@dataclass(frozen=True)
class ChainLayout:
    """``nodes`` (K,): arc lengths [m]; the other arrays are those of ``ChainPrior``."""

    nodes: Array
    spread: Array
    read: Array
    hold: Array
    member: Array
    offset: Array
    share: Array
    carry: Array
    normal: Array
    between: Array
    grips: GripFrames


@dataclass(frozen=True)
class Held:
    """The grip that holds each vertex, (n,), -1 for none, and where in its frame [m], (n, 3).

    ``tangent`` (G, 3): the mean direction, in each grip's frame, between the two vertices that move least in it.
    """

    grips: GripFrames
    owner: Array
    offset: Array
    tangent: Array


def arc_lengths(spec: GraphSpec) -> Array | None:
    """Places of the object vertices along the straight line that they lie on at rest [m], (n,); None if on none."""
    rest = spec.rest_vertices - spec.rest_vertices.mean(axis=0)
    _, _, axes = np.linalg.svd(rest, full_matrices=False)
    along: Array = rest @ axes[0]
    off = np.linalg.norm(rest - np.outer(along, axes[0]), axis=1).max()
    if len(rest) < FEWEST_VERTICES or off > STRAIGHT * np.ptp(along):
        return None
    return along


def grip_frames(spec: GraphSpec) -> GripFrames:
    """The frames of the grips that the graph links its control vertices to."""
    n, count = spec.object_count, spec.control_count
    receivers, slots = np.nonzero((spec.neighbours[n:] >= n) & (spec.neighbours[n:] < spec.vertex_count))
    senders = spec.neighbours[n:][receivers, slots] - n
    at_start = np.zeros((count, count, 3))
    at_start[receivers, senders] = spec.rest_relative[n:][receivers, slots]
    links = coo_matrix((np.ones(len(receivers)), (receivers, senders)), shape=(count, count))
    groups, label = connected_components(links, directed=False)
    anchor, first, second = np.zeros((3, groups, count))
    axis, markers = np.zeros((groups, 3)), np.ones(groups)
    for g in range(groups):
        members = np.flatnonzero(label == g)
        anchor[g, members] = 1.0 / len(members)
        relative = at_start[members[0], members]
        far = int(np.argmax(np.linalg.norm(relative, axis=1)))
        reach = float(np.linalg.norm(relative[far]))
        if reach == 0.0:
            continue
        axis[g], markers[g] = relative[far] / reach, 2
        first[g, members[far]], first[g, members[0]] = 1.0, -1.0
        off = np.linalg.norm(relative - np.outer(relative @ axis[g], axis[g]), axis=1)
        side = int(np.argmax(off))
        if off[side] > IN_LINE * reach:
            markers[g] = 3
            second[g, members[side]], second[g, members[0]] = 1.0, -1.0
    return GripFrames(anchor, first, second, axis, markers)


def frame_rotations(grips: GripFrames, g: int, controls: Array) -> Array:
    """R_g of control vertices (T, C, 3), (T, 3, 3)."""
    if grips.markers[g] == 1:
        return np.repeat(np.eye(3)[None], len(controls), axis=0)
    along = np.einsum("c,tcx->tx", grips.first[g], controls)
    if grips.markers[g] == 2:
        return least_rotation(grips.axis[g], along)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.cross(along, np.einsum("c,tcx->tx", grips.second[g], controls))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([along, np.cross(normal, along), normal], axis=-1)


def held_vertices(spec: GraphSpec, paths: Array, length_m: float) -> Held:
    """Who is held, from vertex tracks (F, V, 3) of frames that show the grips turning."""
    n, grips = spec.object_count, grip_frames(spec)
    controls = paths[:, n:]
    owner, offset, best = np.full(n, -1), np.zeros((n, 3)), np.full(n, HELD[-1] * length_m)
    tangent = np.zeros((len(grips.markers), 3))
    for g in range(len(grips.markers)):
        centre = np.einsum("c,tcx->tx", grips.anchor[g], controls)
        turns = frame_rotations(grips, g, controls)
        local = np.einsum("tji,tnj->tni", turns, paths[:, :n] - centre[:, None])
        mean = local.mean(axis=0)
        moved = np.sqrt(np.square(local - mean).sum(axis=2).mean(axis=0))
        still = np.argsort(moved)[:2]
        tangent[g] = mean[still[1]] - mean[still[0]]
        better = moved < best
        owner[better], offset[better], best[better] = g, mean[better], moved[better]
    for share in HELD:
        near = (owner >= 0) & (best <= share * length_m)
        if near.any():
            owner[~near] = -1
            break
    return Held(grips, owner, offset, tangent / np.linalg.norm(tangent, axis=1, keepdims=True))


def lay_out(along: Array, held: Held, segments: int) -> ChainLayout:
    """Nodes at every held vertex and evenly between them, about ``segments`` over the whole length."""
    spacing = np.ptp(along) / segments
    fixed = {float(along[i]): int(i) for i in np.flatnonzero(held.owner >= 0)}
    stations = sorted({float(along.min()), float(along.max()), *fixed})
    parts = []
    for begin, end in pairwise(stations):
        both = begin in fixed and end in fixed and held.owner[fixed[begin]] == held.owner[fixed[end]]
        count = 1 if both else max(1, round((end - begin) / spacing))
        parts.append(begin + (end - begin) * np.arange(count) / count)
    nodes = np.append(np.concatenate(parts), stations[-1])
    count = len(nodes)
    member, offset = np.zeros((count, len(held.grips.markers))), np.zeros((count, 3))
    for place, vertex in fixed.items():
        node = int(np.argmin(np.abs(nodes - place)))
        member[node, held.owner[vertex]], offset[node] = 1.0, held.offset[vertex]
    free = member.sum(axis=1) == 0
    spread = CubicSpline(nodes, np.eye(count), bc_type="natural")(along)
    moving = spread[:, free]
    pin = np.linalg.solve(moving.T @ moving + READ_RIDGE * np.eye(free.sum()), moving.T)
    read, hold = np.zeros((count, len(along))), np.zeros((count, count))
    read[free] = pin
    hold[np.ix_(free, ~free)] = -pin @ spread[:, ~free]
    hold[~free, ~free] = 1.0
    near = np.exp(-0.5 * np.square((along[None] - nodes[:, None]) / spacing))
    share = near / near.sum(axis=1, keepdims=True)
    carried = _carried(nodes, member, held.tangent)
    return ChainLayout(nodes, spread, read, hold, member, offset, share, *carried, held.grips)


def _carried(nodes: Array, member: Array, tangent: Array) -> tuple[Array, Array, Array]:
    """``carry`` (2, 2), ``normal`` (2, 3) and ``between`` (K-1,) of ``ChainPrior``.

    A normal is the axis of the grip's frame that is least along ``tangent`` (G, 3), the rope's direction in it.
    """
    held = member.sum(axis=1) > 0
    beside = np.flatnonzero(held[1:] != held[:-1])
    grips = [int(np.argmax(member[k if held[k] else k + 1])) for k in (beside[0], beside[-1])]
    ends = [int(beside[0]), int(beside[-1]) if grips[1] != grips[0] else int(beside[0])]
    carry = np.stack([ends, grips], axis=1)
    normal = np.eye(3)[np.argmin(np.abs(tangent[grips]), axis=1)]
    middle = 0.5 * (nodes[1:] + nodes[:-1])
    way = middle[ends[1]] - middle[ends[0]]
    between = np.clip((middle - middle[ends[0]]) / way, 0.0, 1.0) if way > 0.0 else np.zeros(len(middle))
    return carry, normal, between
