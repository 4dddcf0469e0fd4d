"""Updated Lagrangian material point method (MLS-MPM, Hu et al. 2018): material that flows, parts and touches itself.

    particles to grid, forces and boundaries on the grid, grid to particles, return mapping        symplectic Euler

Particles are the quadrature points of the reference lattice and carry everything; the grid is thrown away each
substep. Where two parts of a body share grid nodes they share one velocity: they cannot pass through one another, stick
while they press, and begin to feel one another one to one and a half cells apart (self-contact through the grid).

It integrates the same :class:`~physworld.engine.problem.Problem` as the total Lagrangian form, for solids:
gravity, drag, grips, fields of stiffness and density, contacts, and the terms that have a form on particles
(:mod:`physworld.engine.updated.terms`); others are refused by name. The transfers damp (``docs/engine.md``): elastic
bodies belong to the other form.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
import warp as wp
from scipy.sparse.linalg import splu

from physworld.arrays import Array
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.total.stability import stable_time_step
from physworld.engine.updated.grid_box import GridLattice
from physworld.engine.updated.grips import ParticleGrips, particle_grips
from physworld.engine.updated.run import ParticleRun, Particles
from physworld.engine.updated.stress import ParticleStress, padded
from physworld.engine.updated.terms import ParticleBody, ParticleTerms
from physworld.engine.updated.transfer import Apic, Transfer
from physworld.errors import CFLViolation, SceneUnsupported
from physworld.materials.plastic import Plasticity
from physworld.materials.solid import SolidLaw

_LIMIT = 0.9  # stable dt in units of dx / c, measured on the full lattice (tests/unit/engine)
_SAFETY = 0.45  # share of the limit that is used: dt = 0.4 dx / c
_CROSSING = 0.4  # share of a cell that the fastest particle may be expected to cross in a substep
_GRAIN_SHARE = 0.99  # of a velocity that the grid does not see, kept a substep (Fei et al. 2021)
_OPENING = 0.999  # elastic volume ratio of grains above which ASFLIP lets them part
_SMOOTHING = 1e-9  # of fitted nodes: felt only by what particles do not see
_AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


class UpdatedLagrangian:
    """Integrates a problem; see the module's text.

    Args:
        problem: the body and what acts on it.
        time_step_s: forced time step [s], or None for the stable one.
        transfer: how particles and grid exchange velocities.
        plasticity: plastic flow, or None for the law's elastic solid.

    Raises:
        SceneUnsupported: the body is a sheet or a rod, or a term has no form on particles.
        CFLViolation: the forced time step exceeds the stable limit.
    """

    def __init__(
        self,
        problem: Problem,
        time_step_s: float | None = None,
        transfer: Transfer | None = None,
        plasticity: Plasticity | None = None,
    ) -> None:
        lattice, law = problem.lattice, problem.law
        if not isinstance(law, SolidLaw):
            raise SceneUnsupported(
                f"the updated Lagrangian form integrates solids, got a lattice of dimension {lattice.dim}"
            )
        self.problem, self.law = problem, law
        self.transfer = transfer if transfer is not None else Apic()
        self.plasticity = plasticity
        grains = plasticity is not None and plasticity.granular
        opening, share = self.transfer.separating_volume, self.transfer.velocity_share
        self.separating_volume = (_OPENING if grains else float("inf")) if opening is None else opening
        self.velocity_share = (_GRAIN_SHARE if grains else 1.0) if share is None else share
        self.solid = np.flatnonzero(lattice.particle_measures > 0)
        stiffness = _field(problem.stiffness_factor, self.solid)
        density = _field(problem.density_factor, self.solid)
        self.volume = lattice.particle_measures[self.solid]
        self.mass = law.density_kg_m3 * density * self.volume + self._hung()
        self._stiffness = stiffness
        self.grid = _grid_lattice(problem)
        cell = float(self.grid.spacing.min())
        speed = law.wave_speed_m_s * float(np.sqrt((stiffness / density).max()))
        friction = float((law.viscosity_pa_s * stiffness / (law.density_kg_m3 * density)).max())
        flows = plasticity is not None and plasticity.flows
        body = ParticleBody(problem, self.solid, self.mass, padded(len(self.solid)), flows)
        self.terms = ParticleTerms(body, self.grid)
        frequency = float(np.hypot(2 * speed / (_LIMIT * cell), self.terms.frequency_rad_s))
        rate = 2 * friction * (2 / (_LIMIT * cell)) ** 2 + self.terms.friction_per_s
        limit = stable_time_step(frequency, rate, safety=1.0)
        if time_step_s is not None and time_step_s > limit:
            raise CFLViolation(
                f"time step {time_step_s:.3g} s exceeds the stable {limit:.3g} s of pressure waves at {speed:.4g} m/s "
                f"in cells of {cell:.3g} m (viscosity {law.viscosity_pa_s:.3g} Pa s)"
            )
        self.time_step_s = time_step_s or stable_time_step(frequency, rate, safety=_SAFETY)
        self.crossing_limit = _CROSSING
        self.substeps = 0

    def run(
        self,
        x: Array,
        v: Array,
        held: HeldNodes,
        times: Array,
        progress: Callable[[int, int], None] | None = None,
    ) -> Array:
        """Nodes of the reference lattice fitted to the particles at ``times``, (T, n, 3) [m].

        The smoothest least-squares fit; where material has flowed the lattice means little, and :meth:`run_particles`
        is what to ask. Arguments and errors are those of :meth:`run_particles`.

        Args:
            x, v, held, times, progress: as in :meth:`run_particles`.
        """
        return self.fit_nodes(self.run_particles(x, v, held, times, progress))

    def run_particles(
        self,
        x: Array,
        v: Array,
        held: HeldNodes,
        times: Array,
        progress: Callable[[int, int], None] | None = None,
    ) -> Array:
        """Integrate from ``times[0]`` and record the particles at every time.

        Args:
            x, v: nodal positions [m] and velocities [m/s] at the first time, (n, 3).
            held: prescribed nodes; their paths are given at ``times``.
            times: (T,) [s], strictly increasing.
            progress: called with (frames done, frames in all) once a frame; may raise to stop.

        Returns:
            positions [m] of the particles with material (``solid``), (T, P, 3) float64.

        Raises:
            UnstableSimulation: a state is not finite, or a deformation gradient inverted.
            CFLViolation: a particle crossed more than a cell in a substep.
            ContactFailed: material came too deep into a collider.
            ParticlesLeftTheGrid: the particles span more than the grid may hold.
        """
        return self.prepare(x, v, held).record(times, progress)

    def prepare(self, x: Array, v: Array, held: HeldNodes) -> ParticleRun:
        """A run at its first time, from nodal positions and velocities (n, 3)."""
        start = x.copy()
        # A grip that is turned or shifted is so from the first frame on.
        start[held.nodes] = held.positions[0]
        return ParticleRun(self, self._start(start, v), self.stress(), self.grips(held))

    def grips(self, held: HeldNodes) -> ParticleGrips:
        """The particles that the held nodes grip. Raises SceneUnsupported where a grip lets go."""
        if held.hands:
            raise SceneUnsupported(
                f"{len(held.hands)} grips let go, which the updated Lagrangian form does not follow"
            )
        return particle_grips(self.problem.lattice, self.solid, held.nodes, held.positions, held.velocities)

    def fit_nodes(self, particles: Array) -> Array:
        """Nodes (T, n, 3) whose splines pass nearest to the particles (T, P, 3)."""
        lattice = self.problem.lattice
        rows = lattice.interpolation(lattice.particle_coordinates[self.solid])
        bends = lattice.second_differences()
        factor = splu((rows.T @ rows + _SMOOTHING * bends.T @ bends).tocsc())
        flat = particles.transpose(1, 0, 2).reshape(len(self.solid), -1)
        nodes: Array = factor.solve(rows.T @ flat).reshape(len(lattice.nodes), -1, 3).transpose(1, 0, 2)
        return nodes

    def stress(self) -> ParticleStress:
        """A fresh stress state of the particles."""
        return ParticleStress(self.law, self.plasticity, self.volume, self._stiffness, self.problem.device)

    def _hung(self) -> Array:
        """Masses [kg], (P,), of the loads that hang from the lattice's nodes: each goes to the material around it."""
        added = self.problem.added_mass
        if added is None:
            return np.zeros(len(self.solid))
        lattice = self.problem.lattice
        rows = lattice.interpolation(lattice.particle_coordinates[self.solid]).multiply(self.volume[:, None])
        return np.asarray(rows @ (added / np.maximum(np.asarray(rows.sum(axis=0)).ravel(), 1e-30)))

    def _at_particles(self, nodal: Array, orders: tuple[int, int, int] = (0, 0, 0)) -> Array:
        """Values at the particles, (P, 3), of a nodal field (n, 3), differentiated ``orders`` times in cells."""
        lattice = self.problem.lattice
        table = lattice.table(orders)
        values: Array = np.einsum("cai,ap->cpi", nodal[lattice.cell_nodes], table, optimize=True).reshape(
            -1, 3
        )[self.solid]
        return values

    def _gradient(self, nodal: Array) -> Array:
        """Gradients at the particles in the reference body, (P, 3, 3), of a nodal field (n, 3)."""
        slopes = [self._at_particles(nodal, axis) for axis in _AXES]
        return np.stack(slopes, axis=-1) / self.problem.lattice.spacing

    @cached_property
    def _rest_inverse(self) -> Array:
        return np.linalg.inv(self._gradient(self.problem.rest))

    def _start(self, x: Array, v: Array) -> Particles:
        device, shape = self.problem.device, self._gradient(x)
        C = self._gradient(v) @ np.linalg.inv(shape)
        F = shape @ self._rest_inverse
        room = padded(len(self.solid))
        F = np.concatenate([F, np.repeat(np.eye(3)[None], room - len(F), axis=0)])
        C = np.concatenate([C, np.zeros((room - len(C), 3, 3))])
        return Particles(
            x=wp.array(self._at_particles(x).reshape(-1), dtype=wp.float64, device=device),
            v=wp.array(self._at_particles(v).reshape(-1).astype(np.float32), dtype=wp.float32, device=device),
            C=wp.array(C.reshape(-1).astype(np.float32), dtype=wp.float32, device=device),
            F=wp.array(np.ascontiguousarray(F), dtype=wp.mat33d, device=device),
            stress=wp.zeros(6 * room, dtype=wp.float32, device=device),
        )


def _field(factor: Array | None, solid: Array) -> Array:
    return np.ones(len(solid)) if factor is None else np.asarray(factor, dtype=float)[solid]


def _grid_lattice(problem: Problem) -> GridLattice:
    """The grid continues the reference lattice where the body lies along the world's axes; else it is cubic.

    Cell faces that lie on the faces of a box or of a grip stay there.
    """
    lattice = problem.lattice
    shift = problem.rest - lattice.node_coordinates
    if np.abs(shift - shift[0]).max() < 1e-6 * lattice.spacing.max():
        return GridLattice(lattice.origin + shift[0], lattice.spacing)
    size = float(np.prod(lattice.spacing) ** (1 / 3))
    return GridLattice(problem.rest.min(axis=0), np.full(3, size))
