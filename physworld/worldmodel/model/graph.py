"""The graph: which particles are vertices, which controllers, and who hears whom. NumPy only.

Vertices are the object's particles picked by farthest-point sampling (n of them, smallest separation d_v),
followed by the control vertices (C). Edges are bidirectional, of three kinds:

* NEAR: object vertices, the nearest neighbours within d_e = ``edge_radius_spacings`` · d_v;
* COARSE: object vertices, the first few of the sampling (they are spread over the body) with each other and
  every vertex with the nearest of them. In one step of 1/30 s a bending wave crosses the whole body; seven
  hops of a local graph do not;
* GRIP: with control vertices. A marker of the gripper may sit outside the body, so no radius is asked of
  these.

Neighbours are *material* unless the config says otherwise: found once on the undeformed body and kept. An elastic
solid keeps its neighbours, so the force on a vertex comes from the same vertices at all times; parts that merely pass
close by (a folded rope) exert no elastic force, while a spatial radius would connect them; and a fixed graph trains as
one dense batch and rolls out without a search. What it cannot express is contact of the object with itself, fracture
and flow. With ``near_edges = "current"`` the table holds COARSE and GRIP edges only, and the NEAR ones are found at
every step (``physworld.worldmodel.model.nearest``).

Legend: n object vertices, C control vertices, V = n + C, D slots per vertex (largest degree), K controllers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.worldmodel.errors import GraphInvalid
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.frame import GripFrame, grip_frame

NEAR, COARSE, GRIP = 0, 1, 2
EDGE_KINDS = 3
MOST_KEPT = 150


@dataclass(frozen=True)
class GraphSpec:
    """A scene's graph at a fixed clock.

    Attributes:
        dt_s: the model's time step [s].
        rest_vertices: undeformed places of the object vertices [m], (n, 3).
        particle_index: the particle that each object vertex is, (n,).
        control_index: the controller that each control vertex is, (C,).
        neighbours: senders that each vertex hears, (V, D); V marks an empty slot.
        edge_kind: NEAR, COARSE or GRIP of each slot, (V, D); NEAR in empty slots.
        rest_relative: undeformed x_sender − x_receiver of each slot [m], (V, D, 3); 0 in empty slots. For
            GRIP edges: as at the start of the recording.
        vertex_spacing_m: d_v, the smallest separation of object vertices.
        edge_radius_m: d_e, the longest edge allowed between object vertices, the network's unit of length.
        ground_height_m: the plane's height, or None.
        current_neighbours: how many nearest object vertices each of them hears by NEAR edges, found at every step; 0:
            the NEAR edges are material and stand in ``neighbours``.
        frame: the grip's frame in which a step is taken (``physworld.worldmodel.model.frame``); None: world axes.
    """

    dt_s: float
    rest_vertices: Array
    particle_index: Array
    control_index: Array
    neighbours: Array
    edge_kind: Array
    rest_relative: Array
    vertex_spacing_m: float
    edge_radius_m: float
    ground_height_m: float | None = None
    current_neighbours: int = 0
    frame: GripFrame | None = None

    @property
    def object_count(self) -> int:
        """n."""
        return len(self.rest_vertices)

    @property
    def control_count(self) -> int:
        """C."""
        return len(self.control_index)

    @property
    def vertex_count(self) -> int:
        """V = n + C."""
        return self.object_count + self.control_count

    @property
    def edge_count(self) -> int:
        """Directed edges that are kept."""
        return int((self.neighbours < self.vertex_count).sum())


def farthest_points(points: Array, count: int) -> Array:
    """Indices (≤ count,) of a farthest-point sampling of ``points`` (P, 3), from the point nearest the
    middle.
    """
    points = np.asarray(points, dtype=np.float64)
    chosen = [int(np.argmin(((points - points.mean(axis=0)) ** 2).sum(axis=1)))]
    distance = ((points - points[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < min(count, points.shape[0]):
        farthest = int(np.argmax(distance))
        if distance[farthest] <= 0.0:
            break
        chosen.append(farthest)
        distance = np.minimum(distance, ((points - points[farthest]) ** 2).sum(axis=1))
    return np.asarray(chosen, dtype=np.int64)


def kept_vertices(particles_rest: Array) -> Array:
    """Particles (M,) that a store keeps beside all of them: the vertices of every graph with at most ``MOST_KEPT``.

    A farthest-point sampling of fewer points is the beginning of one of more.
    """
    return farthest_points(particles_rest, MOST_KEPT)


def choose_control_vertices(controllers: Array, groups: tuple[Array, ...], config: WorldModelConfig) -> Array:
    """Controllers that become vertices, (C,): all of a few, or a spread of each rigid group (K, 3)."""
    count = controllers.shape[0]
    if count <= config.control_vertices_all:
        return np.arange(count, dtype=np.int64)
    grouped = [np.asarray(group, dtype=np.int64) for group in groups if len(group)]
    single = np.setdiff1d(np.arange(count), np.concatenate(grouped) if grouped else np.zeros(0, np.int64))
    if len(single):
        grouped.append(single)
    picked = [g[farthest_points(controllers[g], config.control_vertices_per_grip)] for g in grouped]
    return np.sort(np.concatenate(picked))


def build_graph(
    particles_rest: Array,
    particles_start: Array,
    controllers_start: Array,
    *,
    dt_s: float,
    config: WorldModelConfig,
    control_groups: tuple[Array, ...] = (),
    holding: tuple[int, ...] | None = None,
    ground_height_m: float | None = None,
    gravity_m_s2: Array | None = None,
) -> GraphSpec:
    """The graph of a body.

    Args:
        particles_rest: undeformed particles [m], (P, 3).
        particles_start: the same at the start of the recording [m], (P, 3).
        controllers_start: controllers at that moment [m], (K, 3).
        dt_s: the model's clock [s].
        config: number of vertices and neighbours.
        control_groups: controllers that move as one rigid grip.
        holding: numbers of the groups that hold the body; the others' controllers are no vertices. None: all hold.
        ground_height_m: height of the ground plane, or None.
        gravity_m_s2: (3,); with it the graph has a grip's frame, unless there is a ground or NEAR edges are found anew.
    """
    if particles_rest.shape != particles_start.shape or particles_rest.shape[0] < 2:
        raise GraphInvalid(f"rest {particles_rest.shape} and start {particles_start.shape} make no body")
    index = farthest_points(particles_rest, config.vertices)
    rest = np.asarray(particles_rest, dtype=np.float64)[index]
    n = rest.shape[0]
    distances = np.linalg.norm(rest[:, None] - rest[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    spacing = float(distances.min())
    radius = config.edge_radius_spacings * spacing

    controllers = np.asarray(controllers_start, dtype=np.float64)
    control = choose_control_vertices(controllers, control_groups, config)
    control = control[~np.isin(control, _of_open_grips(control_groups, holding))]
    start = np.asarray(particles_start, dtype=np.float64)[index]
    vertex_count = n + len(control)
    kind = np.full((vertex_count, vertex_count), -1)
    object_kind = kind[:n, :n]
    object_kind[_coarse_links(distances, min(config.coarse_vertices, n), config.coarse_links)] = COARSE
    nearest = min(config.neighbours, n - 1)
    material = config.near_edges == "material"
    if material:
        object_kind[_near_links(distances, nearest, radius)] = NEAR
    reach = np.linalg.norm(start[:, None] - controllers[control][None], axis=2)
    for block, links in zip(
        (kind[:n, n:], kind[n:, :n], kind[n:, n:]),
        _control_links(reach, control, control_groups, config.neighbours),
        strict=True,
    ):
        block[links] = GRIP
    np.fill_diagonal(kind, -1)
    neighbours, edge_kind = _slot_table(kind)
    reference = np.concatenate([start, controllers[control]])
    undeformed = np.concatenate([rest, np.zeros((len(control), 3))])
    framed = gravity_m_s2 is not None and ground_height_m is None and material
    return GraphSpec(
        dt_s=dt_s,
        rest_vertices=rest,
        particle_index=index,
        control_index=control,
        neighbours=neighbours,
        edge_kind=edge_kind,
        rest_relative=_relative(neighbours, undeformed, reference, n),
        vertex_spacing_m=spacing,
        edge_radius_m=radius,
        ground_height_m=ground_height_m,
        current_neighbours=0 if material else nearest,
        frame=grip_frame(controllers[control], np.asarray(gravity_m_s2), dt_s) if framed else None,
    )


def _of_open_grips(groups: tuple[Array, ...], holding: tuple[int, ...] | None) -> Array:
    """Controllers of the groups that are not among ``holding``; none where all hold. Raises GraphInvalid."""
    if holding is None:
        return np.zeros(0, dtype=np.int64)
    if not holding or len(set(holding)) < len(holding) or not set(holding) <= set(range(len(groups))):
        raise GraphInvalid(
            f"grips {list(holding)} hold: at least one, and each once, of the {len(groups)} that there are, from 0"
        )
    opened = [np.asarray(group) for number, group in enumerate(groups) if number not in holding]
    return np.concatenate([np.zeros(0, dtype=np.int64), *opened])


def _near_links(distances: Array, neighbours: int, radius: float) -> Array:
    """Each vertex with its nearest within the radius, (n, n) bool."""
    nearest = np.argsort(distances, axis=1, kind="stable")[:, :neighbours]
    linked = np.zeros(distances.shape, dtype=bool)
    np.put_along_axis(linked, nearest, True, axis=1)
    return (linked | linked.T) & (distances <= radius)


def _coarse_links(distances: Array, coarse: int, links: int) -> Array:
    """The first ``coarse`` sampled vertices with each other, and every vertex with its nearest ones of them."""
    linked = np.zeros(distances.shape, dtype=bool)
    if coarse and links:
        linked[:coarse, :coarse] = True
        nearest = np.argsort(distances[:, :coarse], axis=1, kind="stable")[:, :links]
        np.put_along_axis(linked, nearest, True, axis=1)
    return linked | linked.T


def _control_links(
    reach: Array, control: Array, groups: tuple[Array, ...], neighbours: int
) -> tuple[Array, Array, Array]:
    """Object with control vertices (n, C), the same turned round (C, n), control with control vertices (C,
    C).

    Every control vertex with its nearest object vertices; every object vertex with the nearest control
    vertex of every grip, from which it reads its displacement against the grip; the control vertices of a
    grip with each other, from which the grip's turn is read.
    """
    n, count = reach.shape
    to_object = np.zeros((n, count), dtype=bool)
    np.put_along_axis(to_object, np.argsort(reach, axis=0, kind="stable")[:neighbours], True, axis=0)
    together = np.zeros((count, count), dtype=bool)
    for group in groups:
        members = np.nonzero(np.isin(control, group))[0]
        if len(members):
            together[np.ix_(members, members)] = True
            to_object[np.arange(n), members[np.argmin(reach[:, members], axis=1)]] = True
    return to_object, to_object.T, together


def _slot_table(kind: Array) -> tuple[Array, Array]:
    """Senders by receiver (V, D), empty slots filled with V, and their kinds, from kinds (V, V) with -1 for
    none.
    """
    vertex_count = kind.shape[0]
    linked = kind >= 0
    width = max(1, int(linked.sum(axis=1).max()))
    order = np.argsort(~linked, axis=1, kind="stable")[:, :width]
    filled = np.take_along_axis(linked, order, axis=1)
    return np.where(filled, order, vertex_count), np.where(
        filled, np.take_along_axis(kind, order, axis=1), NEAR
    )


def _relative(neighbours: Array, undeformed: Array, reference: Array, n: int) -> Array:
    """Undeformed x_sender − x_receiver of each slot, (V, D, 3): at rest, or at the start beside a
    controller.
    """
    vertex_count = neighbours.shape[0]
    filled = neighbours < vertex_count
    sender = np.where(filled, neighbours, 0)
    receiver = np.broadcast_to(np.arange(vertex_count)[:, None], neighbours.shape)
    with_control = (sender >= n) | (receiver >= n)
    relative = np.where(
        with_control[..., None],
        reference[sender] - reference[receiver],
        undeformed[sender] - undeformed[receiver],
    )
    return np.where(filled[..., None], relative, 0.0)
