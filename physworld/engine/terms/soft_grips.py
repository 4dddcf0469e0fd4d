"""Grips that hold the material in their region instead of every node that it touches.

A quadratic spline has no kink, so a body whose gripped nodes are all prescribed is held with zero strain at the grip's
face: too stiff by a quarter of a cell at a plane clamp, and by far more where a grip holds a part of a section and the
free material pulls around its edges. Here the gripped material is tied to the grip's motion y by a spring per volume,

    E = 1/2 rho (c / l)^2 int_grip |x - y|^2 dV        c speed of pressure waves, l = softness * (cell volume)^(1/3)

so what the grip holds well follows it, and what only reaches into the grip, a strain at its face, gives. l is the
length over which the hold sets in; l = 0 prescribes all nodes. ``AS_HELD`` of a cell is as stiff as the region itself
(``docs/adr/0012-soft-grips.md``). The springs are implicit: in the modes of the gripped
volume's Gram matrix relative to the nodal masses a substep removes the share s dt^2 / (1 + s dt^2) of a mode's distance
from the path, s the square of its frequency (backward Euler of the springs alone), so the stable time step stays as it
is. Nodes that see gripped material only are prescribed. Compare the finite cell method's weak boundary conditions
(Ruess et al. 2013).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp
from scipy.linalg import eigh

from physworld.arrays import Array
from physworld.engine.lattice.bspline import gauss_points, tensor_weights
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.term import BoundTerm
from physworld.engine.total.node_kernels import on_path

AS_HELD = 0.16
"""Softness with which a body rings as finite elements do whose nodes in the region are prescribed."""
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(3)  # exact for products of quadratic splines
_SLACK_M = 1e-6  # around a declared region
_WHOLE = 0.9  # share of a section that a clamp across it holds at least, as far as cells show


def soften(
    problem: Problem, held: HeldNodes, softness: float, regions: Sequence[Array]
) -> tuple[Problem, HeldNodes]:
    """The problem with grips that hold their material over ``softness`` cells, and the nodes that stay prescribed.

    Args:
        problem: of a solid.
        held: all nodes that gripped material touches (:func:`touched_nodes`), and those of other grips.
        softness: l over the side of a cube of a cell's volume; 0 changes nothing.
        regions: boxes that grips hold, (2, 3) [m] each.
    """
    lattice = problem.lattice
    material = lattice.fill[:, _owners(lattice.dim)] > 0.0
    if softness <= 0 or not regions:
        return problem, held
    shares = np.any([gripped_points(lattice, lattice.node_coordinates, box) for box in regions], axis=0)
    gripped = np.any(shares & material, axis=1)
    free = np.any(~shares & material, axis=1)
    loose = np.isin(held.nodes, lattice.cell_nodes[gripped]) & np.isin(held.nodes, lattice.cell_nodes[free])
    soft = _part(held, loose)
    if not len(soft.nodes):
        return problem, held
    rate = problem.law.wave_speed_m_s / (softness * float(np.prod(lattice.spacing)) ** (1 / lattice.dim))
    stiffness = problem.law.density * rate**2
    grips = SoftGrips(soft, stiffness * gram_matrix(lattice, regions, soft.nodes))
    return replace(problem, terms=(*problem.terms, grips)), _part(held, ~loose)


def gripped_points(lattice: Lattice, start: Array, region: Array) -> Array:
    """Which of the cells' quadrature points lie in a box (2, 3) [m] when nodes are at ``start`` (n, 3), (C, Q) bool."""
    splines = tensor_weights(_places(lattice.dim), (0,) * lattice.dim)
    places = np.einsum("qa,cai->cqi", splines, start[lattice.cell_nodes])
    inside: Array = np.all((places >= region[0] - _SLACK_M) & (places <= region[1] + _SLACK_M), axis=2)
    return inside


def touched_nodes(lattice: Lattice, shares: Array) -> Array:
    """Every node that gripped material touches, (k,)."""
    material = lattice.fill[:, _owners(lattice.dim)] > 0.0
    return np.unique(lattice.cell_nodes[np.any(shares & material, axis=1)])


def holds_a_part(lattice: Lattice, start: Array, region: Array) -> bool:
    """Whether a box (2, 3) [m] holds a part of the body's section only, along whichever axis it is a clamp."""
    volumes = lattice.fill[:, _owners(lattice.dim)] * _weights(lattice.dim)
    gripped = float(volumes[gripped_points(lattice, start, region)].sum())
    for axis in range(lattice.dim):
        slab = np.array([[-np.inf], [np.inf]]) * np.ones(lattice.dim)
        slab[:, axis] = region[:, axis]
        if gripped >= _WHOLE * float(volumes[gripped_points(lattice, start, slab)].sum()):
            return False
    return gripped > 0.0


def gram_matrix(lattice: Lattice, regions: Sequence[Array], nodes: Array) -> Array:
    """Integrals of products of the splines of ``nodes`` (k,) over material in boxes (2, 3) [m], (k, k) [m^3].

    The parts of the cells' octants inside a box are integrated exactly: how hard a grip holds hangs on a tenth of a
    cell at its faces. Where octants are filled in part, their material counts as spread evenly.
    """
    place = np.full(len(lattice.nodes), -1)
    place[nodes] = np.arange(len(nodes))
    gram = np.zeros((len(nodes), len(nodes)))
    sides = 0.5 * (gauss_points(lattice.dim) >= 0.5)
    for region in regions:
        box = (region - lattice.origin) / lattice.spacing
        begin = lattice.cells[:, None] + sides
        low, high = np.maximum(begin, box[0]), np.minimum(begin + 0.5, box[1])
        inside = np.all(high > low, axis=2) & (lattice.fill > 0.0)
        for cell, part in np.argwhere(inside):
            size = high[cell, part] - low[cell, part]
            lines = 0.5 * (1.0 + _POINTS)[:, None] * size + (low[cell, part] - lattice.cells[cell])
            splines = tensor_weights(_grid(lines), (0,) * lattice.dim)
            shares = np.prod(_grid(0.5 * _WEIGHTS[:, None] * size), axis=1)
            volume = float(np.prod(lattice.spacing)) * lattice.fill[cell, part]
            local = splines.T @ (splines * (volume * shares)[:, None])
            numbers = place[lattice.cell_nodes[cell]]
            own = numbers >= 0
            gram[np.ix_(numbers[own], numbers[own])] += local[np.ix_(own, own)]
    return gram


def _places(dim: int) -> Array:
    """Local coordinates of a cell's quadrature points, three to each half along an axis, (6**dim, dim)."""
    halves = 0.25 * (1.0 + _POINTS)
    return _grid(np.tile(np.concatenate([halves, 0.5 + halves])[:, None], dim))


def _grid(lines: Array) -> Array:
    """All combinations of the entries of columns (k, dim), (k**dim, dim)."""
    return np.stack(np.meshgrid(*lines.T, indexing="ij"), axis=-1).reshape(-1, lines.shape[1])


def _weights(dim: int) -> Array:
    """Shares of a cell that its quadrature points stand for, (6**dim,)."""
    shares: Array = np.prod(_grid(np.tile(np.tile(0.25 * _WEIGHTS, 2)[:, None], dim)), axis=1)
    return shares


def _owners(dim: int) -> Array:
    """The particle whose part of the cell each quadrature point lies in, (6**dim,)."""
    corners = (gauss_points(dim) >= 0.5).astype(int)
    sides = (_places(dim) >= 0.5).astype(int)
    owners: Array = np.argmax((sides[:, None] == corners[None]).all(axis=2), axis=1)
    return owners


@dataclass(frozen=True)
class SoftGrips:
    """Term: nodes on springs to their paths, ``stiffness`` (k, k) [N/m] between them."""

    held: HeldNodes
    stiffness: Array

    def bind(self, problem: Problem) -> BoundSoftGrips:
        """Device arrays."""
        device, frames = problem.device, len(self.held.positions)
        mass = problem.nodal_mass()[self.held.nodes]
        squares, modes = eigh(self.stiffness, np.diag(mass))

        def upload(values: Array, dtype: type = wp.float64) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        count = len(mass)
        width = _LANES * -(-count // _LANES)
        return BoundSoftGrips(
            [
                upload(self.held.nodes, wp.int32),
                upload(mass),
                upload(self.held.positions.reshape(frames, -1)),
                upload(self.held.velocities.reshape(frames, -1)),
                wp.vec3d(*problem.gravity_m_s2),
                wp.float64(problem.drag_per_s),
                width,
            ],
            wp.zeros((count, width), dtype=wp.float64, device=device),
            wp.zeros(3 * width, dtype=wp.float64, device=device),
            np.maximum(squares, 0.0),
            mass[:, None] * modes,
            device,
        )


@dataclass
class BoundSoftGrips(BoundTerm):
    """Springs on the device; ``pull`` (k, k) [kg/s^2], padded, takes distances to forces.

    The distances are those from the paths after a substep without springs. ``squares`` (k,) [1/s^2] and ``modes``
    (k, k), times the nodal masses, are on the host.
    """

    model: list[Any]
    pull: wp.array
    gap: wp.array
    squares: Array
    modes: Array
    device: str
    frequency_rad_s: float = 0.0
    friction_per_s: float = 0.0
    _paced_s: float = field(default=0.0)

    @property
    def paths(self) -> tuple[wp.array, wp.array]:
        """Positions [m] and velocities [m/s] of the nodes' paths at the frames, (T, 3k) each."""
        return self.model[2], self.model[3]

    def pace(self, time_step_s: float) -> None:
        """The springs' implicit step of this length."""
        if time_step_s == self._paced_s:
            return
        self._paced_s = time_step_s
        reach = self.squares * time_step_s**2
        share = reach / (1.0 + reach)
        rows = np.zeros(self.pull.shape)
        rows[:, : len(rows)] = (self.modes * share) @ self.modes.T / time_step_s**2
        self.pull.assign(rows)

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the pulls [N]; the term must come last, it takes the others' forces into account.

        Args:
            x, v, clock, counter, force: as in :meth:`BoundTerm.launch`.
        """
        count = self.pull.shape[0]
        inputs = [*self.model, clock, counter, x, v, force]
        wp.launch(distance_from_path, dim=count, inputs=inputs, outputs=[self.gap], device=self.device)
        inputs = [self.model[0], self.pull, self.gap]
        wp.launch(pull_to_path, dim=count, inputs=inputs, outputs=[force], device=self.device)


@wp.kernel(enable_backward=False)
def distance_from_path(
    # model
    nodes: wp.array[wp.int32],
    mass: wp.array[wp.float64],
    path_x: wp.array2d[wp.float64],
    path_v: wp.array2d[wp.float64],
    gravity: wp.vec3d,
    drag: wp.float64,
    width: int,
    clock: wp.array[wp.float64],
    counter: wp.array[wp.int32],
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
    force: wp.array[wp.float64],
    # out
    gap: wp.array[wp.float64],
) -> None:
    """Where a node would be after this substep, minus where its grip takes it [m].

    ``force`` is that of everything but the springs, or of all [N]; or an acceleration where ``mass`` is 1.
    """
    held = wp.tid()
    dt = clock[2]
    share = wp.float64(counter[1] + 1) / wp.float64(counter[2])
    for i in range(3):
        k = 3 * nodes[held] + i
        speed = v[k] + dt * (force[k] / mass[held] + gravity[i] - drag * v[k])
        goal = on_path(path_x, path_v, counter[0], 3 * held + i, share, clock[0])
        gap[i * width + held] = x[k] + dt * speed - goal


_ROW = """
#if defined(__CUDA_ARCH__)
    typedef double V;
    const int LANES = 1;
#else
    typedef double V __attribute__((vector_size(32), aligned(8)));
    const int LANES = 4;
#endif
    const int width = pull.shape[1];
    const double* row = &pull.data[(long long)held * width];
    V sum[3] = {V{}, V{}, V{}};
    for (int j = 0; j < width; j += LANES)
        for (int i = 0; i < 3; ++i) sum[i] += *(const V*)&row[j] * *(const V*)&gap.data[i * width + j];
    for (int i = 0; i < 3; ++i) {
#if defined(__CUDA_ARCH__)
        force.data[3 * node + i] -= sum[i];
#else
        force.data[3 * node + i] -= (sum[i][0] + sum[i][1]) + (sum[i][2] + sum[i][3]);
#endif
    }
"""
_LANES = 4  # rows are padded to whole vectors


@wp.func_native(_ROW)
def pull_node(
    held: int,
    node: int,
    pull: wp.array2d[wp.float64],
    gap: wp.array[wp.float64],
    force: wp.array[wp.float64],
) -> None: ...


@wp.kernel(enable_backward=False)
def pull_to_path(
    # model
    nodes: wp.array[wp.int32],
    pull: wp.array2d[wp.float64],
    # in
    gap: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Pull one node."""
    held = wp.tid()
    pull_node(held, nodes[held], pull, gap, force)


def _part(held: HeldNodes, which: Array) -> HeldNodes:
    return HeldNodes(held.nodes[which], held.positions[:, which], held.velocities[:, which])
