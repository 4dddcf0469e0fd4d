"""The body of a measured rope, rod, branched cable, arm or trunk: a chain of nodes at tracked points and between them.

The rest shape is not known and is calibrated; what a scene has to say is which points follow each other, and how far
apart along the material they are: ``body.segment_rest_lengths_m`` with ``body.topology`` for branches, else the order
of the points from the grip and the largest distances that are seen between neighbours. Where points are few, a rod that
starts at rest begins as it hangs still (the run finds that shape), else on splines through the first frame.

An arm or a trunk of which only a few markers are tracked, and no volume is declared, is a rod too, from the middle of
its base's controllers on: through markers that follow each other along it, or, where all of them sit around its tip, to
their middle, with which they move as a rigid section.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline

from physworld.arrays import Array
from physworld.engine.rods.chain import Chain, chain
from physworld.errors import SceneUnsupported
from physworld.geometry.body import ReferenceBody, first_points
from physworld.scene import AS_MEASURED, Scene

SLENDER = ("arm", "trunk")
KINDS = ("rope", "rod", "branched_rope", *SLENDER)
BRANCHED = "branched_rope"
RADIUS_M = 0.004  # where none is declared
_EDGES, _EDGES_A_GAP = 30, 10  # of the whole length at most, and between two points
_SHOWN_GAP = 0.25  # of the length: points farther apart do not show the shape between them
_STILL_SHARE = 0.02  # of sqrt(g L): slower points rest
_CLOUD = 30  # points that bound a solid
_TIP_SHARE = 0.2  # of the distance from the base: markers within it along the axis sit on one section
_STILL_S, _VELOCITY_S, _LEAST_FRAMES = 0.1, 0.05, 5
_ON_AXIS = 1e-6  # of the length: nearer points are on the curve
_NEAR_SHARE = 0.03  # of the length: a declared length within it is that of the last point


@dataclass(frozen=True)
class Path:
    """Tracked points that follow each other, and their distances along the material [m], one fewer."""

    points: list[int]
    lengths: list[float]


def is_discrete(scene: Scene) -> bool:
    """Whether the scene's body is a rod whose rest shape nobody knows: measured, and not declared to touch itself.

    Branched cables have no other form.
    """
    if scene.kind == BRANCHED:
        return True
    if scene.kind in SLENDER:
        body = scene.body
        solid = (
            body.box_min_m is not None
            or scene.rest_volume_points is not None
            or scene.surface_points is not None
        )
        return not solid and scene.points.shape[1] < _CLOUD and len(scene.controllers[0]) > 0
    touching = (scene.declared.get("body") or {}).get("self_contact")
    return scene.kind in KINDS and scene.initial_state == AS_MEASURED and not touching


def rod_body(scene: Scene, refinement: float) -> ReferenceBody:
    """The chain of a scene and where its nodes are at the start.

    Args:
        scene: the recording.
        refinement: edges are this many times shorter.

    Raises:
        SceneUnsupported: the scene says too little, or what it says is no tree.
    """
    tracked = first_points(scene)
    notes = ["the rest shape is not known: its curvature and twist are calibrated"]
    if scene.kind in SLENDER:
        points, paths = _slender(scene, tracked, notes)
    else:
        points, paths = tracked, _paths(scene, tracked, notes)
    radius = scene.body.radius_m or RADIUS_M
    if scene.body.radius_m is None:
        notes.append(f"radius not declared: {radius} m assumed (only the inertia about the axis)")
    total = sum(sum(path.lengths) for path in paths)
    edges = min(_EDGES, _EDGES_A_GAP * sum(len(path.lengths) for path in paths))
    lattice, numbers = _chain(paths, total / (refinement * edges))
    coordinates = lattice.node_coordinates[numbers]
    start = _curve(lattice, paths, numbers, points)
    gaps = np.concatenate([path.lengths for path in paths])
    settles = bool(gaps.max() > _SHOWN_GAP * total) and _rests(scene, total)
    if settles:
        notes.append(
            f"points up to {gaps.max():.3g} m apart do not show its shape: it starts as it hangs still"
        )
        velocity = np.zeros_like(start)
    else:
        moving = np.zeros_like(points)
        moving[: len(tracked)] = _velocities(scene)
        velocity = _curve(lattice, paths, numbers, moving)
    coordinates = coordinates[: len(tracked)]
    if len(points) == len(tracked) + 2:  # a base and a tip beside the markers
        coordinates = np.repeat(lattice.node_coordinates[numbers[-1:]], len(tracked), axis=0)
    offsets = tracked - lattice.interpolation(coordinates) @ start
    offsets[np.linalg.norm(offsets, axis=1) < _ON_AXIS * total] = 0.0
    rest = np.zeros((len(lattice.nodes), 3))
    rest[:, 0] = lattice.node_coordinates[:, 0]
    return ReferenceBody(
        lattice,
        rest,
        start,
        velocity,
        coordinates,
        offsets,
        radius,
        tuple(notes),
        settles=settles,
    )


def _paths(scene: Scene, points: Array, notes: list[str]) -> list[Path]:
    """The cable from its first grip, then its branches, each from the point at which it leaves."""
    lengths = scene.body.segment_rest_lengths_m
    topology = ((scene.declared.get("body") or {}).get("topology") or {}).get("edges")
    count = len(points)
    if lengths is None:
        return [_ordered(scene, points, notes)]
    pairs = [(k, k + 1) for k in range(count - 1)] if topology is None else [tuple(p) for p in topology]
    if len(pairs) != len(lengths) or len(pairs) != count - 1:
        raise SceneUnsupported(
            f"{len(lengths)} segment rest lengths and {len(pairs)} edges for {count} tracked points; a rope or a "
            "branched cable without rings has one fewer of each than points"
        )
    beside: dict[int, dict[int, float]] = {k: {} for k in range(count)}
    for (a, b), length in zip(pairs, lengths, strict=True):
        if not (0 <= a < count and 0 <= b < count and a != b and length > 0):
            raise SceneUnsupported(f"edge {(a, b)} of {length} m is none between {count} tracked points")
        beside[a][b] = beside[b][a] = float(length)
    first = scene.controllers[0]
    ends = [k for k in beside if len(beside[k]) == 1]
    gap = np.linalg.norm(points[:, None] - first[None], axis=2) if len(first) else np.zeros((count, 1))
    ends.sort(key=lambda k: float(gap[k].min()))
    if not ends:
        raise SceneUnsupported(f"the {count - 1} edges form a ring; a cable has ends")
    root = ends[0]
    held = [k for k in ends[1:] if float(gap[k].min()) < _NEAR_SHARE * sum(lengths)]
    goal = held[0] if held else None
    return _split(beside, root, goal, count)


def _slender(scene: Scene, points: Array, notes: list[str]) -> tuple[Array, list[Path]]:
    """Points with a base, and a tip where all markers sit around one, at the end; and the path through them.

    Returns:
        points (N + 1, 3), base last, or (N + 2, 3), base and tip last [m]; the path from the base.
    """
    base = scene.controllers[0].mean(axis=0)
    middle = points.mean(axis=0)
    reach = float(np.linalg.norm(middle - base))
    if reach <= 0.0:
        raise SceneUnsupported(
            f"{len(points)} markers of a {scene.kind} lie around its base: nothing shows its axis"
        )
    along = (points - base) @ (middle - base) / reach
    count = len(points)
    if np.ptp(along) <= _TIP_SHARE * reach:
        length = max(reach, scene.body.length_m or 0.0)
        notes.append(
            f"{count} markers sit around the tip: a rod of {length:.4g} m from the middle of its base to theirs"
        )
        return np.concatenate([points, base[None], middle[None]]), [Path([count, count + 1], [length])]
    order = np.argsort(along)
    line = np.concatenate([base[None], points[order]])
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    declared = scene.body.length_m
    if declared is not None and declared > lengths.sum():
        lengths = lengths * (declared / lengths.sum())
    notes.append(f"a rod of {lengths.sum():.4g} m from the middle of its base through {count} markers")
    return np.concatenate([points, base[None]]), [Path([count, *order.tolist()], lengths.tolist())]


def _split(beside: dict[int, dict[int, float]], root: int, goal: int | None, count: int) -> list[Path]:
    """A tree as paths: to ``goal`` or the farthest end first, then what is left, longest first."""
    before, away, stack = {root: root}, {root: 0.0}, [root]
    order = []
    while stack:
        node = stack.pop()
        order.append(node)
        for other, length in beside[node].items():
            if other == before[node]:
                continue
            if other in before:
                raise SceneUnsupported(f"point {other} is reached twice: a cable without rings is needed")
            before[other], away[other] = node, away[node] + length
            stack.append(other)
    if len(order) != count:
        raise SceneUnsupported(f"{count - len(order)} of {count} tracked points hang on no edge of the cable")
    paths: list[Path] = []
    taken = {root}
    while len(taken) < count:
        left = [k for k in order if k not in taken]
        end = goal if goal is not None and not paths else max(left, key=lambda k: away[k])
        line = [end]
        while line[-1] not in taken:
            line.append(before[line[-1]])
        line.reverse()
        taken.update(line)
        paths.append(Path(line, [beside[a][b] for a, b in pairwise(line)]))
    return paths


def _ordered(scene: Scene, points: Array, notes: list[str]) -> Path:
    """Points in their order from the first grip, as far apart as they are ever seen in training frames."""
    if not len(scene.controllers[0]):
        raise SceneUnsupported(
            f"nothing orders the {len(points)} points of a {scene.kind} without controllers: declare "
            "body.segment_rest_lengths_m"
        )
    order = np.argsort(np.linalg.norm(points - scene.controllers[0, 0], axis=1))
    frames = slice(0, scene.train[1] or scene.frame_count)
    pair = scene.visible[frames][:, order[1:]] & scene.visible[frames][:, order[:-1]]
    apart = np.linalg.norm(np.diff(scene.points[frames][:, order], axis=1), axis=2)
    lengths = np.where(pair, apart, 0.0).max(axis=0)
    if len(lengths) < 1 or lengths.min() <= 0.0:
        raise SceneUnsupported(f"{len(points)} tracked points show no rod between them: {lengths} m apart")
    declared, seen = scene.body.length_m, float(lengths.sum())
    if declared is not None and seen < declared <= (1.0 + _NEAR_SHARE) * seen:
        lengths = lengths * (declared / seen)
        notes.append(f"points {seen:.4g} m apart at most along a rod of {declared:.4g} m: stretched to it")
    return Path(order.tolist(), lengths.tolist())


def _chain(paths: list[Path], edge_m: float) -> tuple[Chain, Array]:
    """Edges of about ``edge_m`` between the points, and the node at each point, (N,); -1 of those on no path."""
    parent, lengths = [-1], [0.0]
    at = {paths[0].points[0]: 0}
    for path in paths:
        node = at[path.points[0]]
        for point, length in zip(path.points[1:], path.lengths, strict=True):
            pieces = max(1, round(length / edge_m))
            for _ in range(pieces):
                parent.append(node)
                lengths.append(length / pieces)
                node = len(parent) - 1
            at[point] = node
    if len(parent) < 4:  # two points alone: room to bend
        return _chain(paths, 0.5 * edge_m)
    numbers = np.full(max(at) + 1, -1)
    numbers[list(at)] = list(at.values())
    return chain(np.array(parent), np.array(lengths)), numbers


def _curve(lattice: Chain, paths: list[Path], numbers: Array, values: Array) -> Array:
    """Splines along the paths through values (N, 3) at the points, at the nodes, (n, 3)."""
    found = np.zeros((len(lattice.parent), 3))
    away = lattice.distances
    for path in paths:
        nodes = [numbers[path.points[-1]]]
        while nodes[-1] != numbers[path.points[0]]:
            nodes.append(lattice.parent[nodes[-1]])
        known = away[numbers[path.points]]
        found[nodes] = CubicSpline(known, values[path.points])(away[nodes])
    return found


def _velocities(scene: Scene) -> Array:
    """Velocities of the points at the first frame, from a parabola through the first ones, (N, 3) [m/s]."""
    frames = max(_LEAST_FRAMES, int(np.searchsorted(scene.times, _VELOCITY_S)))
    frames = min(frames, scene.train[1] or scene.frame_count)
    seen = scene.visible[:frames].all(axis=0)
    found = np.zeros((scene.points.shape[1], 3))
    if frames < 3 or not seen.any():
        return found
    design = np.vander(scene.times[:frames] - scene.times[0], 3)
    track = scene.points[:frames, seen].reshape(frames, -1)
    found[seen] = np.linalg.lstsq(design, track, rcond=None)[0][1].reshape(-1, 3)
    return found


def _rests(scene: Scene, length: float) -> bool:
    """Whether no point moves in the first frames."""
    until = max(2, int(np.searchsorted(scene.times, scene.times[0] + _STILL_S)))
    visible = scene.visible[:until] & scene.visible[0]
    moved = np.linalg.norm(scene.points[:until] - scene.points[0], axis=2)[visible]
    span = float(scene.times[until - 1] - scene.times[0])
    return bool(moved.max(initial=0.0) < _STILL_SHARE * np.sqrt(9.81 * length) * span)
