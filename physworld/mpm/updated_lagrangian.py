"""Updated Lagrangian material point method (MLS-MPM, Hu et al. 2018): material that flows, parts and touches itself.

    particles to grid, forces and boundaries on the grid, grid to particles, return mapping        symplectic Euler

Particles are the quadrature points of the reference lattice and carry everything; the grid is thrown away each
substep. Where two parts of a body share grid nodes they share one velocity: they cannot pass through one another, stick
while they press, and begin to feel one another one to one and a half cells apart (self-contact through the grid).

It integrates the same :class:`~physworld.mpm.total_lagrangian.Problem` as the total Lagrangian form, for solids:
gravity, drag, grips, ground, fields of stiffness and density; other terms act on a lattice's nodes and are refused.
The transfers damp (``docs/engine.md``): elastic bodies belong to the other form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy.sparse.linalg import splu

from physworld.errors import CFLViolation, ParticlesLeftTheGrid, SceneUnsupported, UnstableSimulation
from physworld.materials.laws import SolidLaw
from physworld.materials.plastic import DruckerPrager, Plasticity
from physworld.mpm.bspline import GAUSS_POINTS
from physworld.mpm.contact import GroundContact
from physworld.mpm.grid_box import GridBox, GridLattice
from physworld.mpm.grid_kernels import advance_grid, clear_gaps, measure_gaps, place_grips, scatter_grips
from physworld.mpm.node_kernels import advance_counter
from physworld.mpm.particle_grips import ParticleGrips, particle_grips
from physworld.mpm.particle_stress import ParticleStress, padded
from physworld.mpm.stability import stable_time_step
from physworld.mpm.total_lagrangian import HeldNodes, Problem
from physworld.mpm.transfer import Apic, Transfer
from physworld.mpm.transfer_kernels import (
    ESCAPED,
    INVERTED,
    NOT_FINITE,
    RIM,
    grid_to_particles,
    particles_to_grid,
)

_CHUNK = 8  # substeps in one captured graph
_LIMIT = 0.9  # stable dt in units of dx / c, measured on the full lattice (tests/physics/test_updated_lagrangian.py)
_SAFETY = 0.45  # share of the limit that is used: dt = 0.4 dx / c
_CROSSING = 0.4  # share of a cell that the fastest particle may be expected to cross in a substep
_GRAIN_SHARE = 0.99  # of a velocity that the grid does not see, kept a substep (Fei et al. 2021)
_OPENING = 0.999  # elastic volume ratio of grains above which ASFLIP lets them part
_GROUP = 32  # particles that a thread takes in turn on a CPU: what a thread costs is shared
_INSTANT = 1e-12  # [s], in which the first stress is found
_SMOOTHING = 1e-9  # of fitted nodes: felt only by what particles do not see
_AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


@dataclass(frozen=True)
class Particles:
    """Device arrays of the particles' state: positions (3P,), velocities (3P,), C (9P,), F (P,), stress (6P,);

    the last three padded to a multiple of 8 particles.
    """

    x: wp.array
    v: wp.array
    C: wp.array
    F: wp.array
    stress: wp.array


class UpdatedLagrangian:
    """Integrates a problem; see the module's text.

    Args:
        problem: the body and what acts on it.
        time_step_s: forced time step [s], or None for the stable one.
        transfer: how particles and grid exchange velocities.
        plasticity: plastic flow, or None for the law's elastic solid.

    Raises:
        SceneUnsupported: the body is a sheet or a rod, or a term acts on the lattice's nodes.
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
        self.problem = problem
        self.ground = _ground(problem)
        self.transfer = transfer if transfer is not None else Apic()
        self.plasticity = plasticity
        grains = isinstance(plasticity, DruckerPrager)
        opening, share = self.transfer.separating_volume, self.transfer.velocity_share
        self.separating_volume = (_OPENING if grains else float("inf")) if opening is None else opening
        self.velocity_share = (_GRAIN_SHARE if grains else 1.0) if share is None else share
        self.solid = np.flatnonzero(lattice.particle_measures > 0)
        stiffness = _field(problem.stiffness_factor, self.solid)
        density = _field(problem.density_factor, self.solid)
        self.volume = lattice.particle_measures[self.solid]
        self.mass = law.density_kg_m3 * density * self.volume
        self._stiffness = stiffness
        self.grid = _grid_lattice(problem)
        cell = float(self.grid.spacing.min())
        speed = law.wave_speed_m_s * float(np.sqrt((stiffness / density).max()))
        friction = float((law.viscosity_pa_s * stiffness / (law.density_kg_m3 * density)).max())
        frequency, rate = 2 * speed / (_LIMIT * cell), 2 * friction * (2 / (_LIMIT * cell)) ** 2
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
        x: np.ndarray,
        v: np.ndarray,
        held: HeldNodes,
        times: np.ndarray,
        progress: Callable[[int, int], None] | None = None,
    ) -> np.ndarray:
        """Nodes of the reference lattice fitted to the particles at ``times``, (T, n, 3) [m].

        The smoothest least-squares fit; where material has flowed the lattice means little, and :meth:`run_particles`
        is what to ask. Arguments and errors are those of :meth:`run_particles`.
        """
        return self.fit_nodes(self.run_particles(x, v, held, times, progress))

    def run_particles(
        self,
        x: np.ndarray,
        v: np.ndarray,
        held: HeldNodes,
        times: np.ndarray,
        progress: Callable[[int, int], None] | None = None,
    ) -> np.ndarray:
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
            ParticlesLeftTheGrid: the particles span more than the grid may hold.
        """
        return self.prepare(x, v, held).record(times, progress)

    def prepare(self, x: np.ndarray, v: np.ndarray, held: HeldNodes) -> ParticleRun:
        """A run at its first time, from nodal positions and velocities (n, 3)."""
        return ParticleRun(self, self._start(x, v), self.stress(), self.grips(held))

    def grips(self, held: HeldNodes) -> ParticleGrips:
        """The particles that the held nodes grip."""
        return particle_grips(self.problem.lattice, self.solid, held.nodes, held.positions, held.velocities)

    def fit_nodes(self, particles: np.ndarray) -> np.ndarray:
        """Nodes (T, n, 3) whose splines pass nearest to the particles (T, P, 3)."""
        lattice = self.problem.lattice
        rows = lattice.interpolation(lattice.particle_coordinates[self.solid])
        bends = lattice.second_differences()
        factor = splu((rows.T @ rows + _SMOOTHING * bends.T @ bends).tocsc())
        flat = particles.transpose(1, 0, 2).reshape(len(self.solid), -1)
        return factor.solve(rows.T @ flat).reshape(len(lattice.nodes), -1, 3).transpose(1, 0, 2)

    def stress(self) -> ParticleStress:
        """A fresh stress state of the particles."""
        return ParticleStress(
            self.problem.law, self.plasticity, self.volume, self._stiffness, self.problem.device
        )

    def _start(self, x: np.ndarray, v: np.ndarray) -> Particles:
        lattice, device = self.problem.lattice, self.problem.device
        coordinates = lattice.particle_coordinates[self.solid]
        value = lattice.interpolation(coordinates)
        slopes = [lattice.interpolation(coordinates, axis) for axis in _AXES]

        def gradient(nodal: np.ndarray) -> np.ndarray:
            return np.stack([slope @ nodal for slope in slopes], axis=-1)

        shape, rest = gradient(x), gradient(self.problem.rest)
        C = gradient(v) @ np.linalg.inv(shape)
        F = shape @ np.linalg.inv(rest)
        room = padded(len(self.solid))
        F = np.concatenate([F, np.repeat(np.eye(3)[None], room - len(F), axis=0)])
        C = np.concatenate([C, np.zeros((room - len(C), 3, 3))])
        return Particles(
            x=wp.array((value @ x).reshape(-1), dtype=wp.float64, device=device),
            v=wp.array((value @ v).reshape(-1).astype(np.float32), dtype=wp.float32, device=device),
            C=wp.array(C.reshape(-1).astype(np.float32), dtype=wp.float32, device=device),
            F=wp.array(np.ascontiguousarray(F), dtype=wp.mat33d, device=device),
            stress=wp.zeros(6 * room, dtype=wp.float32, device=device),
        )


class ParticleRun:
    """One integration: device arrays of the grid, the captured substeps, the checks."""

    def __init__(
        self, engine: UpdatedLagrangian, particles: Particles, stress: ParticleStress, grips: ParticleGrips
    ) -> None:
        device = engine.problem.device
        self.engine, self.device, self.particles = engine, device, particles
        self.stress = stress
        self.gripped = len(grips.particles)
        self.grip_arrays = grips.upload(device)
        self.goal = wp.zeros(max(self.gripped, 1), dtype=wp.vec3d, device=device)
        self.box = GridBox(engine.grid, device)
        self.mass = wp.array(engine.mass.astype(np.float32), dtype=wp.float32, device=device)
        self.clock = wp.zeros(3, dtype=wp.float64, device=device)
        self.counter = wp.zeros(3, dtype=wp.int32, device=device)
        self.flags = wp.zeros(4, dtype=wp.int32, device=device)
        self.extremes = wp.zeros(1, dtype=wp.float32, device=device)
        self.crossing = 0.0
        self.graph = None
        instant = wp.array([_INSTANT, 1.0 / _INSTANT, _INSTANT], dtype=wp.float64, device=device)
        stress.launch(particles.F, particles.C, particles.stress, instant, self.flags)

    def record(self, times: np.ndarray, progress: Callable[[int, int], None] | None) -> np.ndarray:
        """Particles at ``times``, (T, P, 3); see :meth:`UpdatedLagrangian.run_particles`."""
        engine, frames = self.engine, len(times)
        recorded = np.empty((frames, len(engine.solid), 3))
        recorded[0] = self._positions()
        for frame in range(frames - 1):
            interval = float(times[frame + 1] - times[frame])
            chunks = max(1, int(np.ceil(interval / (self._time_step(times[frame], interval) * _CHUNK))))
            dt = interval / (chunks * _CHUNK)
            self.clock.assign(np.array([interval, 1.0 / dt, dt]))
            self.counter.assign(np.array([frame, 0, chunks * _CHUNK], dtype=np.int32))
            self._enclose(times[frame])
            for chunk in range(chunks):
                wp.capture_launch(self.graph)
                engine.substeps += _CHUNK
                self._check(times[frame] + (chunk + 1) * _CHUNK * dt, dt)
            recorded[frame + 1] = self._positions()
            if progress is not None:
                progress(frame + 1, frames - 1)
        return recorded

    def released(self, held: HeldNodes) -> ParticleRun:
        """A run that goes on from here with other grips."""
        return ParticleRun(self.engine, self.particles, self.stress, self.engine.grips(held))

    def _positions(self) -> np.ndarray:
        return self.particles.x.numpy().reshape(-1, 3).copy()

    def _time_step(self, time: float, interval: float) -> float:
        """The stable step, or less where particles are fast: none should cross much of a cell in a substep."""
        engine = self.engine
        speeds = np.abs(self.particles.v.numpy().reshape(-1, 3)).max(axis=0)
        speeds = speeds + np.abs(engine.problem.gravity_m_s2) * interval
        crossed = float((speeds / engine.grid.spacing).max())
        if not np.isfinite(crossed):
            bad = int((~np.isfinite(self.particles.v.numpy().reshape(-1, 3))).any(axis=1).sum())
            raise UnstableSimulation(
                f"{bad} of {len(engine.solid)} velocities are not finite at t = {time:.4f} s"
            )
        step = min(engine.time_step_s, engine.crossing_limit / crossed) if crossed > 0 else engine.time_step_s
        self.crossing = crossed * step
        return step

    def _enclose(self, time: float) -> None:
        rim = max(1, int(np.ceil(2 * _CHUNK * self.crossing)))
        if self.box.enclose(self._positions(), rim, time) or self.graph is None:
            self._capture()
        self.flags.zero_()

    def _check(self, time: float, dt: float) -> None:
        flags, crossing = self.flags.numpy(), float(self.extremes.numpy()[0])
        engine = self.engine
        if flags[NOT_FINITE] or not np.isfinite(crossing):
            raise UnstableSimulation(
                f"a particle's state is not finite at t = {time:.4f} s with time step {dt:.3g} s "
                f"(stable: {engine.time_step_s:.3g} s)"
            )
        if flags[INVERTED]:
            raise UnstableSimulation(
                f"a particle inverted by t = {time:.4f} s with time step {dt:.3g} s: its volume ratio fell below 0.02 "
                "or a stretch below 1e-4"
            )
        if crossing > 1.0:
            raise CFLViolation(
                f"a particle crossed {crossing:.3g} cells of {engine.grid.spacing.min():.3g} m in one substep of "
                f"{dt:.3g} s before t = {time:.4f} s"
            )
        if flags[ESCAPED]:
            raise ParticlesLeftTheGrid(
                f"a particle left the box of {tuple(self.box.counts.tolist())} nodes within {_CHUNK} substeps of "
                f"{dt:.3g} s before t = {time:.4f} s; the fastest crossed {crossing:.3g} cells a substep"
            )
        self.crossing = crossing
        self.extremes.zero_()
        if flags[RIM]:
            self._enclose(time)

    def _capture(self) -> None:
        nodes, device = self.box.nodes, self.device
        split, gripped, ground = self.engine.transfer.split, self.gripped > 0, self.engine.ground is not None

        def nodal(used: bool) -> wp.array:
            return wp.zeros(
                nodes + 1 if used else 1, dtype=wp.vec4f, device=device
            )  # a row reads one node more

        self.momentum, self.impulse, self.grip = nodal(True), nodal(split), nodal(gripped)
        self.velocity, self.velocity_old = nodal(True), nodal(split)
        self.gap = wp.zeros(self.box.columns if ground else 1, dtype=wp.float32, device=device)
        with wp.ScopedCapture(device=device) as capture:
            for _ in range(_CHUNK):
                self._substep()
        self.graph = capture.graph

    def _substep(self) -> None:
        engine, q, box = self.engine, self.particles, self.box.device_box
        problem, transfer, grid = engine.problem, engine.transfer, engine.grid
        ground, count, split = engine.ground, len(engine.solid), int(transfer.split)
        group = 1 if wp.get_device(self.device).is_cuda else _GROUP
        groups = -(-count // group)
        origin, inverse = wp.vec3d(*grid.origin), 1.0 / grid.spacing
        clear = -np.inf if ground is None else ground.height_m + grid.spacing[2]
        space = [wp.vec3f(*inverse), wp.vec3f(*grid.spacing)]

        def launch(kernel: object, dim: int, inputs: list, outputs: list) -> None:
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

        launch(
            particles_to_grid, groups,
            [group, count, self.mass, origin, *space, split, self.clock, box, q.x, q.v, q.C, q.stress],
            [self.momentum, self.impulse, self.flags],
        )  # fmt: skip
        if self.gripped:
            numbers, path_x, path_v, path_gradient = self.grip_arrays
            launch(
                scatter_grips, self.gripped,
                [numbers, self.mass, path_x, path_v, path_gradient, origin, wp.vec3d(*inverse), self.clock,
                 self.counter, box, q.x],
                [self.goal, self.grip, self.flags],
            )  # fmt: skip
        if ground is not None:
            launch(clear_gaps, self.box.columns, [box], [self.gap])
            launch(
                measure_gaps, count,
                [origin, wp.vec3d(*inverse), wp.float64(ground.height_m), ground.friction,
                 wp.float64(GAUSS_POINTS[0] * grid.spacing[2]),
                 wp.float64(2.5 * grid.spacing[2]), box],
                [q.x, q.v, self.gap],
            )  # fmt: skip
        launch(
            advance_grid, self.box.nodes,
            [wp.vec3f(*problem.gravity_m_s2), problem.drag_per_s, int(ground is not None),
             0.0 if ground is None else ground.friction, wp.float64(0.0 if ground is None else ground.height_m),
             wp.float64(grid.origin[2]), wp.float64(grid.spacing[2]), int(self.gripped > 0), self.clock, box, self.gap,
             self.momentum, self.impulse, self.grip],
            [self.velocity, self.velocity_old, split],
        )  # fmt: skip
        sharing = [split, engine.velocity_share, engine.separating_volume, wp.float64(clear)]
        launch(
            grid_to_particles, groups,
            [group, count, origin, *space, *sharing, self.clock, box, self.velocity, self.velocity_old,
             self.stress.ratio, q.x, q.v, q.C],
            [self.flags, self.extremes],
        )  # fmt: skip
        if self.gripped:
            launch(
                place_grips,
                self.gripped,
                [numbers, path_gradient, path_v, self.counter, self.goal],
                [q.x, q.v, q.C],
            )
        self.stress.launch(q.F, q.C, q.stress, self.clock, self.flags)
        launch(advance_counter, 1, [self.counter], [])


def _ground(problem: Problem) -> GroundContact | None:
    grounds = [term for term in problem.terms if isinstance(term, GroundContact)]
    others = [type(term).__name__ for term in problem.terms if not isinstance(term, GroundContact)]
    if others or len(grounds) > 1:
        raise SceneUnsupported(
            f"the updated Lagrangian form knows one ground and no other term on nodes, got {len(grounds)} and {others}"
        )
    return grounds[0] if grounds else None


def _field(factor: np.ndarray | None, solid: np.ndarray) -> np.ndarray:
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
