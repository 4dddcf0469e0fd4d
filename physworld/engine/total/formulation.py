"""Total Lagrangian material point method: particles carry the material, the nodal state stays on the grid.

    m_a dv_a/dt = f_a(x) + m_a g - m_a c v_a        x_a += dt v_a        (leapfrog, lumped mass)

Velocities live half a substep before the positions, which makes the scheme second order in dt.

Weights live in the reference configuration, so nothing is ever transferred between particles and grid and nothing is
damped by transfers (de Vaucorbeil, Nguyen, Hutchinson 2020). It cannot tear or flow: plastic flow, and solids that
touch themselves, belong to the updated Lagrangian form, which joins
behind the same :class:`physworld.engine.problem.Formulation`.

Substeps run in a captured graph; the host returns once a frame to record, to check and to report.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Literal, Protocol

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.captured import CHUNK, Chunk
from physworld.engine.hands import Openings
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.total.forces import InternalForces
from physworld.engine.total.friction import FrictionForces
from physworld.engine.total.node_kernels import advance_counter, advance_nodes
from physworld.engine.total.relaxation import MARGIN, Relaxation, stages_for
from physworld.engine.total.stability import Steps, fastest_frequency
from physworld.errors import BlewUp, CFLViolation, ParticlesLeftTheGrid, UnstableSimulation

_REACH = 1e3  # a node farther than this many body sizes from its start has left every workspace


class TotalLagrangian:
    """Integrates a problem; see the module's text.

    Args:
        problem: the body and what acts on it.
        time_step_s: forced time step [s], or None for the stable one.
        friction: "auto": in sub-steps of its own where explicit friction would shrink the time step more than
            :data:`physworld.engine.total.stability.EXPLICIT_SHRINK` times (drag: ``DRAG_SHRINK``), or a forced step
            asks for it; "explicit": never. With a term that multiplies the internal forces, and in a mesh of triangles,
            it is explicit.

    Attributes:
        relaxed: whether friction is sub-cycled (:mod:`physworld.engine.total.relaxation`).
        steps: the time steps that either way allows.
        asked_step_s: the forced time step [s], or None.
        friction: the law's, where it is sub-cycled; None otherwise.
        mean_velocity: at which the last step took its friction, (3n,) [m/s], where it is sub-cycled.

    Raises:
        CFLViolation: the forced time step exceeds the stable limit.
    """

    def __init__(
        self,
        problem: Problem,
        time_step_s: float | None = None,
        friction: Literal["auto", "explicit"] = "auto",
    ) -> None:
        lattice, law, device = problem.lattice, problem.law, problem.device
        particles = lattice.fill.size
        stiffness = np.ones(particles) if problem.stiffness_factor is None else problem.stiffness_factor
        self.problem, self.device, self.cell_m = problem, device, float(lattice.spacing.max())
        self.mass = problem.nodal_mass()
        self.forces = InternalForces(lattice, law, stiffness, problem.rest, device)
        cell = float(lattice.spacing.min())
        frequency = fastest_frequency(self.forces, problem.rest, self.mass, cell)
        rubbing, internal = law.friction_law, 0.0
        if rubbing is not None:
            damper = InternalForces(lattice, rubbing, stiffness, problem.rest, device)
            internal = fastest_frequency(damper, problem.rest, self.mass, cell) ** 2
        self.terms = tuple(term.bind(problem) for term in problem.terms)
        for term in self.terms:
            frequency = float(np.hypot(frequency, term.frequency_rad_s))
        rates = tuple(float(term.friction_per_s) for term in self.terms)
        steps = Steps(frequency, internal, float(problem.drag_per_s), rates)
        multiplied = any(getattr(term, "multiplies", False) for term in self.terms)
        allowed = friction == "auto" and not multiplied and lattice.smooth
        if time_step_s is None:
            relax = allowed and steps.relax
        else:
            relax = allowed and time_step_s > steps.explicit_s(1.0)
        limit = steps.relaxed_s(1.0) if relax else steps.explicit_s(1.0)
        if time_step_s is not None and time_step_s > limit:
            raise CFLViolation(
                f"time step {time_step_s:.3g} s exceeds the stable {limit:.3g} s of a body whose fastest mode has "
                f"{frequency:.4g} rad/s (wave speed {law.wave_speed_m_s:.4g} m/s, cell {lattice.spacing.min():.3g} m)"
            )
        self.steps, self.asked_step_s = steps, time_step_s
        self.time_step_s = time_step_s or (steps.relaxed_s() if relax else steps.explicit_s())
        self.relaxed, self.friction = relax, None
        if relax:
            self.forces = InternalForces(lattice, law.without_friction(), stiffness, problem.rest, device)
            if rubbing is not None:
                self.friction = FrictionForces(lattice, law, stiffness, problem.rest, device)
            self.mean_velocity = wp.zeros(3 * len(self.mass), dtype=wp.float64, device=device)
        self.substeps = 0

    @property
    def stage_s(self) -> float:
        """Time that one evaluation of its forces brings the body on [s]: the step, or a stage of its friction."""
        if not self.relaxed:
            return self.time_step_s
        rate = self.steps.internal_per_s + self.steps.drag_per_s
        return self.time_step_s / stages_for(MARGIN * self.time_step_s * rate)

    def run(
        self,
        x: Array,
        v: Array,
        held: HeldNodes,
        times: Array,
        progress: Callable[[int, int], None] | None = None,
    ) -> Array:
        """Integrate from ``times[0]`` and record the nodes at every time.

        Args:
            x, v: nodal positions [m] and velocities [m/s] at the first time, (n, 3).
            held: prescribed nodes; their paths are given at ``times``.
            times: (T,) [s], strictly increasing.
            progress: called with (frames done, frames in all) once a frame; may raise to stop.

        Returns:
            nodal positions [m], (T, n, 3) float64.

        Raises:
            UnstableSimulation: a cell inverted or a state is not finite.
            ParticlesLeftTheGrid: a node is absurdly far from its start.
        """
        run = Run(self, x, v, held, times)
        frames = len(times)
        recorded = np.empty((frames, *x.shape))
        recorded[0] = x
        for frame in range(frames - 1):
            recorded[frame + 1] = run.advance(frame)
            if progress is not None:
                progress(frame + 1, frames - 1)
        return recorded

    def substeps_of(self, interval: float) -> int:
        """Substeps that an interval between two frames takes."""
        return whole_chunks(interval, self.time_step_s)


class Stepped(Protocol):
    """What a run steps: one body, or several side by side.

    Attributes:
        device: of its arrays.
        mass: nodal masses [kg], (n,).
        cell_m: size of the largest cell [m].
        substeps: so far, of all runs.
    """

    device: str
    mass: Array
    cell_m: float
    substeps: int

    @property
    def forces(self) -> InternalForces:
        """The internal forces."""
        ...

    def substeps_of(self, interval: float) -> int:
        """Substeps that an interval between two frames takes."""
        ...


class SteppedRun(ABC):
    """One run on a device, frame by frame: what one body and several side by side have in common.

    Args:
        solver: what is stepped.
        x, v: nodal positions [m] and velocities [m/s] at the first time, (n, 3).
        held: prescribed nodes; their paths are given at ``times``.
        times: (T,) [s], strictly increasing.

    Attributes:
        x, v: the state, (3n,) float64 [m], [m/s]; velocities half a substep before the positions.
        clock, counter: (frame interval [s], 1/dt [1/s], dt [s]) and (frame, substep, substeps).
    """

    def __init__(self, solver: Stepped, x: Array, v: Array, held: HeldNodes, times: Array) -> None:
        device, nodes, frames = solver.device, len(solver.mass), len(times)
        self._openings, self._opens = Openings(held, times, nodes), bool(held.hands)
        count = len(self._openings.nodes)

        def upload(values: Array, dtype: type = wp.float64) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        self._stepped, self._start, self._times = solver, x, times
        self.x, self.v = upload(x.reshape(-1)), upload(v.reshape(-1))
        self.force = wp.zeros(3 * nodes, dtype=wp.float64, device=device)
        self.clock = wp.zeros(3, dtype=wp.float64, device=device)
        self.counter = wp.zeros(3, dtype=wp.int32, device=device)
        self._clocks = wp.zeros(3, dtype=wp.float64, device="cpu"), wp.zeros(3, dtype=wp.int32, device="cpu")
        self._size = float(np.ptp(x, axis=0).max()) + solver.cell_m
        paths = np.zeros((2, frames, max(3 * count, 1)))
        paths[0, :, : 3 * count] = self._openings.positions.reshape(frames, -1)
        paths[1, :, : 3 * count] = self._openings.velocities.reshape(frames, -1)
        slots = upload(self._openings.slots, wp.int32)
        self._nodes = [upload(solver.mass), slots, upload(paths[0]), upload(paths[1])]
        self._relaxation = self._relaxing()
        self._begin()
        forces = solver.forces
        forces.inverted.zero_()
        forces.launch(self.x, self.clock, self.force)  # remembers the first strains: no friction acts yet
        self.v.assign(self._half_a_step_back(v, times[1] - times[0]).reshape(-1))
        self.force.zero_()
        self._chunks: dict[int, Chunk] = {}

    @property
    def paths(self) -> tuple[wp.array, wp.array]:
        """Positions [m] and velocities [m/s] of the held nodes at the times, (T, 3k) each."""
        return self._nodes[2], self._nodes[3]

    def advance(self, frame: int, stages: int | None = None) -> Array:
        """Integrate from ``times[frame]`` to the next; positions there, (n, 3) [m].

        Args:
            frame: the frame's number.
            stages: of friction, where it is not explicit; None for as many as the body's shape asks for.

        Raises:
            UnstableSimulation: a cell inverted or a state is not finite.
            ParticlesLeftTheGrid: a node is absurdly far from its start.
            ContactFailed: material came too deep into a collider.
        """
        if self._opens and self._openings.enter(frame, self.x.numpy().reshape(-1, 3)):
            self._prescribe()
        substeps = self._set_clock(frame)
        chunk = self._chunk(stages)
        for _ in range(substeps // CHUNK):
            chunk.launch()
        self._stepped.substeps += substeps
        now: Array = self.x.numpy().reshape(-1, 3).copy()
        self._check(now, self._times[frame + 1])
        return now

    def _prescribe(self) -> None:
        """Bring what the grips prescribe to the device."""
        openings, frames = self._openings, len(self._times)
        self._nodes[1].assign(openings.slots)
        for array, path in zip(self.paths, (openings.positions, openings.velocities), strict=True):
            array.assign(path.reshape(frames, -1))

    def _chunk(self, asked: int | None) -> Chunk:
        """A chunk of substeps, captured once for every number of stages that friction takes."""
        stages, relaxation = 0, self._relaxation
        if relaxation is not None:
            if asked is None:
                relaxation.tune(self.x, float(self._clocks[0].numpy()[2]))
            else:
                relaxation.stages = asked
            stages = relaxation.stages
        if stages not in self._chunks:
            self._chunks[stages] = Chunk(self._substep, self._stepped.device)
        return self._chunks[stages]

    @property
    def stages(self) -> int:
        """Stages of friction in a substep of the last frame; 0 where it is explicit."""
        return 0 if self._relaxation is None else self._relaxation.stages

    def _substep(self) -> None:
        self._stepped.forces.launch(self.x, self.clock, self.force)
        self._launch_terms()
        self._launch_nodes()
        wp.launch(advance_counter, dim=1, inputs=[self.counter], device=self._stepped.device)

    def _set_clock(self, frame: int) -> int:
        interval = self._times[frame + 1] - self._times[frame]
        substeps = self._stepped.substeps_of(interval)
        dt = interval / substeps
        clock, counter = self._clocks
        clock.numpy()[:] = interval, 1.0 / dt, dt
        counter.numpy()[:] = frame, 0, substeps
        wp.copy(self.clock, clock)
        wp.copy(self.counter, counter)
        self._pace(dt)
        return substeps

    def _half_a_step_back(self, v: Array, interval: float) -> Array:
        """Velocities (n, 3) half a substep before the start, where a scheme of second order wants them.

        ``self.force`` holds the internal forces at the start; those of the terms are added.
        """
        solver = self._stepped
        dt = interval / self._set_clock(0)
        self._launch_terms()
        if self._relaxation is not None:
            return v  # its first step is half a step
        pull = self.force.numpy().reshape(-1, 3) / solver.mass[:, None]
        gravity, drag = self._fall()
        earlier: Array = v - 0.5 * dt * (pull + gravity - drag * v)
        return earlier

    @abstractmethod
    def _begin(self) -> None:
        """Terms start."""

    @abstractmethod
    def _pace(self, time_step_s: float) -> None:
        """Terms learn the length of the substeps [s]."""

    @abstractmethod
    def _launch_terms(self) -> None:
        """Terms add their forces."""

    @abstractmethod
    def _launch_nodes(self) -> None:
        """Nodes advance under the forces."""

    @abstractmethod
    def _fall(self) -> tuple[Array, Array | float]:
        """Gravity [m/s^2] and drag rate [1/s]; they fit velocities (n, 3)."""

    @abstractmethod
    def _relaxing(self) -> Relaxation | None:
        """Friction in sub-steps of its own, or None."""

    @abstractmethod
    def _check(self, now: Array, time: float) -> None:
        """Refuse positions (n, 3) [m] at ``time`` [s] that cannot be trusted."""


class Run(SteppedRun):
    """One run of one body: see :meth:`TotalLagrangian.run` for the arguments."""

    def __init__(self, solver: TotalLagrangian, x: Array, v: Array, held: HeldNodes, times: Array) -> None:
        self._solver = solver
        super().__init__(solver, x, v, held, times)

    def _begin(self) -> None:
        for term in self._solver.terms:
            term.begin(self._times)

    def _pace(self, time_step_s: float) -> None:
        for term in self._solver.terms:
            term.pace(time_step_s)

    def _launch_terms(self) -> None:
        for term in self._solver.terms:
            term.launch(self.x, self.v, self.clock, self.counter, self.force)

    def _launch_nodes(self) -> None:
        if self._relaxation is not None:
            self._relaxation.launch(self.x, self.v, self.force, self.clock, self.counter)
            return
        problem = self._solver.problem
        gravity, drag = wp.vec3d(*problem.gravity_m_s2), wp.float64(problem.drag_per_s)
        wp.launch(
            advance_nodes,
            dim=len(self._solver.mass),
            inputs=[*self._nodes, gravity, drag, self.clock, self.counter],
            outputs=[self.force, self.x, self.v],
            device=self._solver.device,
        )

    def _fall(self) -> tuple[Array, Array | float]:
        return self._solver.problem.gravity_m_s2, self._solver.problem.drag_per_s

    def _relaxing(self) -> Relaxation | None:
        solver = self._solver
        if not solver.relaxed:
            return None
        gravity, drag = self._fall()
        return Relaxation(self._nodes, solver.friction, gravity, float(drag), solver.mean_velocity)

    def _check(self, now: Array, time: float) -> None:
        solver, dt = self._solver, float(self._clocks[0].numpy()[2])
        inverted = int(np.count_nonzero(solver.forces.inverted.numpy()))
        check_state(now, self._start, inverted, self._size, time, dt)
        for term in solver.terms:
            term.check(time)


def whole_chunks(interval: float, time_step_s: float) -> int:
    """Substeps of at most ``time_step_s`` that an interval [s] takes: whole chunks."""
    return CHUNK * max(1, int(np.ceil(interval / (time_step_s * CHUNK))))


def run_again_if_blown_up(
    solver: TotalLagrangian,
    x: Array,
    v: Array,
    held: HeldNodes,
    times: Array,
    progress: Callable[[int, int], None] | None = None,
) -> Array:
    """:meth:`TotalLagrangian.run`, and once more at half the time step where the body blew up.

    The stable time step is the undeformed body's; strain may stiffen a body beyond it. Raises what ``run`` raises.

    Args:
        solver: with the time step of the first attempt.
        x, v: nodal positions [m] and velocities [m/s] at the first time, (n, 3).
        held: prescribed nodes; their paths are given at ``times``.
        times: (T,) [s], strictly increasing.
        progress: called with (frames done, frames in all) once a frame; may raise to stop.
    """
    try:
        return solver.run(x, v, held, times, progress)
    except BlewUp:
        return TotalLagrangian(solver.problem, 0.5 * solver.time_step_s).run(x, v, held, times, progress)


def check_state(now: Array, start: Array, inverted: int, size: float, time: float, dt: float) -> None:
    """Refuse nodal positions that cannot be trusted.

    Args:
        now, start: nodal positions of one body now and at its start [m], (n, 3).
        inverted: how many of its cells inverted.
        size: of the body at its start [m].
        time, dt: of the end of the frame, and the time step [s]; for the message.

    Raises:
        UnstableSimulation: a cell inverted or a state is not finite.
        ParticlesLeftTheGrid: a node is absurdly far from its start.
    """
    if inverted or not np.isfinite(now).all():
        kind = UnstableSimulation if np.isfinite(now).all() else BlewUp
        raise kind(
            f"the body inverted or blew up at t = {time:.4f} s with time step {dt:.3g} s ({inverted} cells inverted, "
            f"{int((~np.isfinite(now)).any(axis=1).sum())} of {len(now)} nodes not finite)"
        )
    farthest = float(np.abs(now - start).max())
    if farthest > _REACH * size:
        raise ParticlesLeftTheGrid(
            f"a node is {farthest:.3g} m from its start at t = {time:.4f} s; the body is {size:.3g} m long"
        )
