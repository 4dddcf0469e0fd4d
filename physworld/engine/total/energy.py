"""Energy ledger of a run: where every joule went, and how much the numerics lost.

    lost = - (change of kinetic + gravitational + elastic energy)
           + work of the grips + work of terms - taken by drag - taken by internal friction

Works are summed substep by substep inside the run by a meter that is the last of the problem's terms; stored energies
come from the laws' energy densities at the frames. A rope's twist is stored energy too, and its grips work by turning
its ends: that is summed from moment and turns, not from the energy. With no friction the remainder ``lost`` is the
integrator's own: a leapfrog step conserves energy up to a bounded oscillation of second order in dt.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.term import BoundTerm
from physworld.engine.thin.twist import Twist, TwistMeter
from physworld.engine.total.energy_kernels import keep_forces, sum_friction, sum_works
from physworld.engine.total.forces import InternalForces
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import SceneUnsupported

_AFTER_S = 1e-4  # the meter reads a frame when the next one starts: one more, this short, follows the last


@dataclass(frozen=True)
class EnergyLedger:
    """Energies at every frame [J], all (T,); works and losses are sums since the first frame.

    Attributes:
        times: frames [s].
        kinetic: sum of m v^2 / 2 over the nodes.
        gravitational: - sum of m g . x, zero at the first frame.
        elastic: stored by the law, twist included.
        grip_work: done by the prescribed nodes on the rest, and by turning a rope's ends.
        term_work: done by contacts and effects on the body (negative where they take energy).
        drag: taken by linear air drag.
        internal_friction: taken by the law's own friction.
    """

    times: Array
    kinetic: Array
    gravitational: Array
    elastic: Array
    grip_work: Array
    term_work: Array
    drag: Array
    internal_friction: Array

    @property
    def mechanical(self) -> Array:
        """Kinetic, gravitational and elastic energy together."""
        return self.kinetic + self.gravitational + self.elastic

    @property
    def lost(self) -> Array:
        """What the numerics lost (negative: gained) since the first frame."""
        accounted = self.grip_work + self.term_work - self.drag - self.internal_friction
        remainder: Array = accounted - (self.mechanical - self.mechanical[0])
        return remainder

    @property
    def turnover(self) -> float:
        """Scale of the energies that were exchanged: the largest kinetic energy, or span of another column."""
        columns = (
            self.kinetic, self.gravitational, self.elastic, self.grip_work, self.term_work,
            self.drag, self.internal_friction,
        )  # fmt: skip
        return max(float(np.ptp(column)) for column in columns)


def run_with_ledger(
    problem: Problem,
    x: Array,
    v: Array,
    held: HeldNodes,
    times: Array,
    *,
    time_step_s: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Array, EnergyLedger]:
    """Integrate a problem in the total Lagrangian form and account for its energy.

    Args:
        problem: what is integrated; its drag and its terms are accounted for apart.
        x, v: nodal positions [m] and velocities [m/s] at the first time, (n, 3).
        held: prescribed nodes at ``times``.
        times: (T,) [s].
        time_step_s: forced time step, or None for the stable one.
        progress: as in :meth:`TotalLagrangian.run`.

    Returns:
        Nodal positions (T, n, 3) [m], the same as without a ledger, and the ledger.

    Raises:
        SceneUnsupported: the body is a mesh of triangles, or a grip lets go.
        SimulationError: the run cannot be trusted.
    """
    if not problem.lattice.smooth:
        raise SceneUnsupported(
            f"the energy of {len(problem.lattice.cells)} cells of triangles: the ledger is of splines"
        )
    if held.hands:
        raise SceneUnsupported(f"{len(held.hands)} grips let go: the work of the grips is not kept")
    meter = _Meter(len(times))
    metered = replace(problem, terms=(_Marker(meter), *problem.terms, meter))
    solver = TotalLagrangian(metered, time_step_s)
    meter.watch(solver)
    after = np.append(times, times[-1] + _AFTER_S)
    longer = replace(
        held,
        positions=np.concatenate([held.positions, held.positions[-1:]]),
        velocities=np.concatenate([held.velocities, 0 * held.velocities[-1:]]),
    )
    nodes = solver.run(x, v, longer, after, progress)[:-1]
    work, velocity = meter.read()
    turning, twisted = meter.read_twist()
    rubbed = meter.read_friction()
    velocity[:, held.nodes] = held.velocities
    mass = solver.mass
    kinetic = 0.5 * np.einsum("n,tni->tn", mass, velocity**2)
    height = -np.einsum("n,tni,i->tn", mass, nodes - nodes[0], problem.gravity_m_s2)
    of_grips = (kinetic + height)[:, held.nodes]
    free = np.setdiff1d(np.arange(len(mass)), held.nodes)
    return nodes, EnergyLedger(
        times=np.asarray(times, dtype=float),
        kinetic=kinetic.sum(axis=1),
        gravitational=height.sum(axis=1),
        elastic=elastic_energy(problem, nodes) + twisted,
        grip_work=(of_grips - of_grips[0]).sum(axis=1)
        - (work[:, 2] + rubbed.sum(axis=1))[:, held.nodes].sum(axis=1)
        + turning,
        term_work=(work[:, 2] - work[:, 1] - work[:, 3]).sum(axis=1),
        drag=(work[:, 4] - rubbed[:, 1])[:, free].sum(axis=1),
        internal_friction=(work[:, 0] - work[:, 1] - rubbed[:, 0]).sum(axis=1),
    )


def elastic_energy(problem: Problem, nodes: Array) -> Array:
    """Energy stored by the law but for twist [J], (T,), at nodal positions (T, n, 3) [m]."""
    lattice, law = problem.lattice, problem.law
    measure = lattice.particle_measures
    if problem.stiffness_factor is not None:
        measure = measure * problem.stiffness_factor
    rows = [lattice.interpolation(lattice.particle_coordinates, order) for order in law.strain_orders]
    solid = measure > 0
    energies = np.empty(len(nodes))
    for frame, x in enumerate(nodes):
        moved = x - problem.rest if lattice.dim == 3 else x
        derivatives = np.stack([row @ moved for row in rows], axis=1)[solid]
        energies[frame] = measure[solid] @ law.energy_of(derivatives)
    return energies


class _Marker(BoundTerm):
    """The first of the terms: keeps the internal forces before anything else adds to them."""

    def __init__(self, meter: _Meter) -> None:
        self._meter = meter

    def bind(self, problem: Problem) -> _Marker:
        self._kept = self._meter.allocate(problem)
        return self

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        wp.launch(keep_forces, dim=len(force), inputs=[force], outputs=[self._kept], device=force.device)


class _Meter(BoundTerm):
    """The last of the terms: adds no force, sums the works of all that came before it."""

    def __init__(self, frames: int) -> None:
        self._frames = frames

    def allocate(self, problem: Problem) -> wp.array:
        """Device arrays; returns where the internal forces are kept."""
        n, device = len(problem.rest), problem.device

        def zeros(shape: object) -> wp.array:
            return wp.zeros(shape, dtype=wp.float64, device=device)

        particles = problem.lattice.fill.size
        stiffness = np.ones(particles) if problem.stiffness_factor is None else problem.stiffness_factor
        self._device = device
        self._elastic_law = InternalForces(
            problem.lattice, problem.law.without_friction(), stiffness, problem.rest, device
        )
        self._constants = [
            wp.array(problem.nodal_mass(), dtype=wp.float64, device=device),
            wp.vec3d(*problem.gravity_m_s2),
            wp.float64(problem.drag_per_s),
            wp.float64(0.5),
        ]
        self._internal, self._elastic = zeros(3 * n), zeros(3 * n)
        self._twist = zeros(3 * n)
        self._state = [self._elastic, self._twist, zeros(3 * n), zeros((4, 3 * n)), zeros(n), zeros((5, n))]
        self._outputs = [zeros((self._frames + 1, 5, n)), zeros((self._frames + 1, 3 * n))]
        twists = [term.bind(problem) for term in problem.terms if isinstance(term, Twist)]
        self._twists = [(twist, TwistMeter(twist, self._frames + 1)) for twist in twists]
        return self._internal

    def watch(self, solver: TotalLagrangian) -> None:
        """Learn how the solver integrates friction; where it does so after all terms, meter that apart."""
        self._relaxed = solver if solver.relaxed else None
        if solver.relaxed:
            n = len(solver.mass)
            self._constants[2:] = [wp.float64(0.0), wp.float64(0.0)]
            shapes = (3 * n, 3 * n, (2, n), (self._frames + 1, 2, n))
            self._friction = [wp.zeros(shape, dtype=wp.float64, device=self._device) for shape in shapes]

    def bind(self, problem: Problem) -> _Meter:
        return self

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        self._elastic_law.launch(x, clock, self._elastic)
        for twist, turning in self._twists:
            twist.launch(x, v, clock, counter, self._twist)
            turning.add(counter)
        if self._relaxed is not None:
            self._add_friction(self._relaxed, x, counter)
        wp.launch(
            sum_works,
            dim=len(x) // 3,
            inputs=[*self._constants, x, v, clock, counter, self._internal, force, *self._state],
            outputs=self._outputs,
            device=self._device,
        )

    def read(self) -> tuple[Array, Array]:
        """Works (T, 5, n) [J] and velocities (T, n, 3) [m/s] at the frames."""
        work, velocity = (array.numpy()[: self._frames] for array in self._outputs)
        return work.copy(), velocity.reshape(self._frames, -1, 3).copy()

    def _add_friction(self, solver: TotalLagrangian, x: wp.array, counter: wp.array) -> None:
        friction, mean = self._friction[0], solver.mean_velocity
        if solver.friction is not None:
            solver.friction.launch(mean, friction)
        drag = wp.float64(solver.problem.drag_per_s)
        wp.launch(
            sum_friction, dim=len(x) // 3,
            inputs=[self._constants[0], drag, x, self._state[2], counter, mean], outputs=self._friction,
            device=self._device,
        )  # fmt: skip

    def read_friction(self) -> Array:
        """Works of sub-cycled internal friction and drag at the frames [J], (T, 2, n); 0 where they are explicit."""
        if self._relaxed is None:
            return np.zeros((self._frames, 2, self._outputs[0].shape[2]))
        works: Array = self._friction[3].numpy()[: self._frames].copy()
        return works

    def read_twist(self) -> tuple[Array, Array]:
        """Work of grips that turn a rope's ends and energy of its twist at the frames [J], (T,) each."""
        found = [turning.read() for _, turning in self._twists]
        work, energy = (sum((f[k] for f in found), np.zeros(self._frames + 1)) for k in range(2))
        return work[: self._frames], energy[: self._frames]
