"""What a twin of a discrete rod has beside its nodes: what its grips hold, and its natural curvature and twist.

The natural curvature and twist are sums of a few shapes (:func:`shapes`), whose amplitudes are the rows of
``Twin.natural``: first, for every grip, the angles of the joint next to it [rad] (a gripper seldom holds a rod exactly
along its axis), then, for every branch, those of the joint where it leaves the cable [rad], then the smoothest fields
over the rod [1/m], the constant one first.

A body whose base stands still and that starts to move by itself is driven from inside, by chambers or tendons whose
pressure or pull nobody recorded. ``Twin.drive`` holds the steps of its rest shape, each a ramp: curvatures
about both directors and a stretch, the same all along.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.engine.problem import HeldNodes
from physworld.engine.rods.chain import Chain
from physworld.engine.rods.discrete_rods import Sections, joint_angles
from physworld.errors import SceneUnsupported
from physworld.geometry.body import ReferenceBody
from physworld.geometry.rigid import least_rotation, rigid_motion
from physworld.scene import Grip

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

MODES = 8
"""Shapes of the natural curvature, from the constant one to seven half waves over the rod."""
_OFF_LINE = 0.05  # second extent of control points over the first, below which they are on a line


def natural_of(body: ReferenceBody, grips: int) -> Array | None:
    """What is known beforehand, (grips + branches + modes, 3): a straight rod whose branches leave it as at the start.

    None of bodies that are no discrete rod.
    """
    lattice = body.lattice
    if not isinstance(lattice, Chain):
        return None
    leaving = np.zeros((len(lattice.branches), 3))
    leaving[:, :2] = joint_angles(lattice, body.start)[lattice.branches]
    modes = min(MODES, len(lattice.cells))
    return np.concatenate([np.zeros((grips, 3)), leaving, np.zeros((modes, 3))])


def gripped_of_chain(lattice: Chain, start: Array, controllers: Array, grip: Grip | None) -> Array:
    """Nodes that a grip holds: from the nearest to one of its controllers to the nearest to another.

    Three controllers or more are a pose and hold an edge at least. A grip's declared box or radius counts where it has
    one.

    Args:
        lattice: of the rod.
        start: nodal positions [m], (n, 3).
        controllers: of the grip [m], (k, 3).
        grip: as declared, or None.

    Raises:
        SceneUnsupported: no node lies in what is declared.
    """
    distance = np.linalg.norm(start[:, None] - controllers[None], axis=2)
    if grip is not None and grip.radius_m is not None:
        nodes = np.flatnonzero(distance.min(axis=1) <= grip.radius_m)
    elif grip is not None and grip.region_min_m is not None and grip.region_max_m is not None:
        low, high = np.asarray(grip.region_min_m), np.asarray(grip.region_max_m)
        nodes = np.flatnonzero(np.all((start >= low) & (start <= high), axis=1))
    else:
        near = np.unique(np.argmin(distance, axis=0))
        nodes = _between(lattice, near)
        nodes = clamped(lattice, nodes) if is_pose(controllers) else nodes
    if not len(nodes):
        raise SceneUnsupported(
            f"a declared grip with {len(controllers)} controllers holds no node of the rod"
        )
    return nodes


def is_pose(controllers: Array) -> bool:
    """Whether control points (k, 3) fix a pose: three or more, not on a line."""
    if len(controllers) < 3:
        return False
    extents = np.linalg.svd(controllers - controllers.mean(axis=0), compute_uv=False)
    return bool(extents[1] > _OFF_LINE * extents[0])


def clamped(lattice: Chain, nodes: Array) -> Array:
    """The nodes that a grip holds, and of a single one its neighbour too: a base holds an edge, not a point."""
    return nodes if len(nodes) != 1 else np.union1d(nodes, _beside(lattice, int(nodes[0])))


def shapes(twin: Twin) -> Array:
    """Natural curvature or twist of every joint [1/m] of a unit amplitude in each row of ``natural``, (n, R)."""
    lattice = twin.lattice
    assert isinstance(lattice, Chain) and twin.natural is not None
    grips, first = len(twin.held_nodes), first_mode(twin)
    found = np.zeros((len(lattice.parent), len(twin.natural)))
    found[:, first:] = lattice.modes(len(twin.natural) - first)
    for number, node in enumerate(lattice.branches):
        found[node, grips + number] = 1.0 / lattice.joint_lengths[node]
    held = held_edges(lattice, twin.held_nodes)
    for number in range(grips):
        for node in np.flatnonzero(lattice.parent > 0):
            ends = held[node] == number, held[lattice.parent[node]] == number
            if ends[0] != ends[1]:
                found[node, number] = 1.0 / lattice.joint_lengths[node]
    return found


def first_mode(twin: Twin) -> int:
    """Row of ``natural`` at which the smooth fields begin."""
    assert isinstance(twin.lattice, Chain)
    return len(twin.held_nodes) + len(twin.lattice.branches)


def held_edges(lattice: Chain, groups: tuple[Array, ...]) -> Array:
    """Number of the grip that holds both ends of every edge, by the node at which the edge ends, (n,); -1: none."""
    grip = np.full(len(lattice.parent), -1)
    for number, nodes in enumerate(groups):
        grip[nodes] = number
    return np.where((lattice.parent >= 0) & (grip == grip[lattice.parent]), grip, -1)


def sections_of(twin: Twin, held: HeldNodes, knots: Array, controls: Array) -> Sections:
    """What the sections of a twin's rod do in a run.

    Args:
        twin: of a discrete rod.
        held: prescribed nodes; their paths are given at the knots.
        knots: times [s], (T,).
        controls: control points at the knots [m], (T, K, 3).
    """
    lattice = twin.lattice
    assert isinstance(lattice, Chain) and twin.natural is not None
    grips = held_edges(lattice, twin.held_nodes)
    place = {int(node): k for k, node in enumerate(held.nodes)}
    opening = [number for number, one in enumerate(twin.openings) if one is not None]
    # An effect may let go of a node that a grip holds; what is left of its edge is free to turn.
    edges = np.array(
        [
            e
            for e in np.flatnonzero((grips >= 0) & ~np.isin(grips, opening))
            if e in place and lattice.parent[e] in place
        ],
        dtype=int,
    )
    turns = np.zeros((len(knots), len(edges)))
    for column, edge in enumerate(edges):
        group = twin.controller_groups[grips[edge]]
        if is_pose(twin.controllers_start[group]):
            ends = held.positions[:, place[int(edge)]] - held.positions[:, place[int(lattice.parent[edge])]]
            rotation, _ = rigid_motion(twin.controllers_start[group], controls[:, group])
            turns[:, column] = _turned(ends, rotation)
    return Sections(
        natural=shapes(twin) @ twin.natural,
        radius_m=twin.body.thickness_m,
        edges=edges,
        turns=turns,
        driven=driven_at(twin.drive, knots),
        settles=twin.body.settles,
    )


def driven_at(drive: Array | None, times: Array) -> Array:
    """Curvatures [1/m] and stretch that steps drive at ``times`` (T,) [s], (T, 3).

    Args:
        drive: a step a row: when it begins [s], how long it rises [s], what it adds in the end (3), and whether a
            calibration takes it for one back to nothing, (J, 6); or None.
        times: [s].
    """
    found = np.zeros((len(times), 3))
    if drive is not None:
        for begin, rise, *added in drive[:, :5]:
            found += np.clip((times - begin) / max(rise, 1e-9), 0.0, 1.0)[:, None] * np.array(added)
    return found


def _turned(edges: Array, rotations: Array) -> Array:
    """Angles by which rotations (T, 3, 3) turn edges (T, 3) about themselves, beyond the least turns, (T,) [rad]."""
    tangents = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    across = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    directors = rotations @ (rotations[0].T @ (across / np.linalg.norm(across)))
    carried = np.einsum("tij,tj->ti", least_rotation(tangents[:-1], tangents[1:]), directors[:-1])
    sine = np.einsum("ti,ti->t", np.cross(carried, directors[1:]), tangents[1:])
    cosine = np.einsum("ti,ti->t", carried, directors[1:])
    return np.concatenate([[0.0], np.cumsum(np.arctan2(sine, cosine))])


def _between(lattice: Chain, nodes: Array) -> Array:
    """The nodes on the way from each of ``nodes`` to the first of them."""
    ways = []
    for node in nodes:
        way = [int(node)]
        while way[-1] > 0:
            way.append(int(lattice.parent[way[-1]]))
        ways.append(set(way))
    common = set.intersection(*ways)
    joined: set[int] = {max(common)}.union(*(way - common for way in ways))
    return np.array(sorted(joined))


def _beside(lattice: Chain, node: int) -> Array:
    """A neighbour of a node: the next one, or the one before of a node at an end."""
    children = np.flatnonzero(lattice.parent == node)
    return children[:1] if len(children) else lattice.parent[node : node + 1]
