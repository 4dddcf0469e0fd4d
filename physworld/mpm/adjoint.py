"""Reverse mode through the total Lagrangian engine: gradients of any function of a run's positions.

    run = Adjoint(problem).run(x, v, held, times);  gradient = run.gradient(dL/dx at the frames)

The forward pass keeps the velocities before every substep (positions follow from them), in double precision while that
fits the memory that may be used, else in single; where even that is too much it keeps whole states at the frames only
and runs every frame a second time when the reverse pass comes to it. The reverse pass takes the substeps back one by
one (:mod:`physworld.mpm.adjoint_kernels`), in a captured graph like the forward one.

Internal forces: :class:`physworld.mpm.tangent.InternalTangent`. Terms: :mod:`physworld.mpm.adjoint_terms`. Scalars that
change many things at once: :mod:`physworld.mpm.gradient`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from physworld.materials.laws import friction_law
from physworld.mpm.adjoint_kernels import (
    count_back,
    keep_velocities,
    last_positions,
    step_back,
    take_nodes_back,
    take_start_back,
)
from physworld.mpm.adjoint_pairs import ForcePair
from physworld.mpm.adjoint_terms import Memory, Reverse, StressAdjoint, adjoint_of, memories_of
from physworld.mpm.tangent import InternalTangent
from physworld.mpm.terms import BoundTerm
from physworld.mpm.total_lagrangian import HeldNodes, Problem, Run, TotalLagrangian

_CHUNK = 8  # substeps in one captured graph: a divisor of every frame's
MEMORY_MB = 100.0


@dataclass(frozen=True)
class Gradient:
    """Derivatives of a scalar L of a run.

    Attributes:
        log_stiffness, log_density: by the logarithms of the particles' fields, (P,).
        law: by the logarithm of every number of the law at every particle, (P, columns).
        columns: names of those numbers (:attr:`InternalTangent.parameters`).
        mass: by the nodal masses [1/kg], (n,).
        gravity: by the gravity vector, (3,).
        drag: by the drag rate.
        x, v: by the initial state, (n, 3).
        held_positions, held_velocities: by the prescribed paths, (T, H, 3).
        stresses: by numbers (k,) and fields (layers, P) of every stress beside the law, in the order of the terms;
            None for another term.
        works: of the force pairs that were given.
    """

    log_stiffness: np.ndarray
    log_density: np.ndarray
    law: np.ndarray
    columns: tuple[str, ...]
    mass: np.ndarray
    gravity: np.ndarray
    drag: float
    x: np.ndarray
    v: np.ndarray
    held_positions: np.ndarray
    held_velocities: np.ndarray
    stresses: tuple[tuple[np.ndarray, np.ndarray] | None, ...]
    works: tuple[float, ...]


class Adjoint:
    """A problem whose runs can be differentiated.

    Args:
        problem: what is integrated.
        time_step_s: forced time step [s], or None for the stable one.
        memory_mb: what a run may keep for its gradient; beyond it every frame is run twice.

    Raises:
        CFLViolation: the forced time step exceeds the stable limit.
    """

    def __init__(
        self, problem: Problem, time_step_s: float | None = None, memory_mb: float = MEMORY_MB
    ) -> None:
        self.problem = problem
        self.memory_mb = memory_mb
        self.recorder = _Recorder()
        self.solver = TotalLagrangian(replace(problem, terms=(*problem.terms, self.recorder)), time_step_s)

    @property
    def time_step_s(self) -> float:
        """Largest time step [s]; frames are divided evenly."""
        return self.solver.time_step_s

    def run(
        self,
        x: np.ndarray,
        v: np.ndarray,
        held: HeldNodes,
        times: np.ndarray,
        progress: Callable[[int, int], None] | None = None,
    ) -> RecordedRun:
        """Integrate and keep what a gradient needs: arguments and errors of :meth:`TotalLagrangian.run`."""
        return RecordedRun(self, x, v, held, np.asarray(times, dtype=float), progress)


class RecordedRun:
    """A run that has been made.

    Attributes:
        nodes: positions at the frames [m], (T, n, 3).
        twice: whether the gradient runs every frame again.
        nbytes: memory kept for the gradient.
    """

    def __init__(
        self,
        adjoint: Adjoint,
        x: np.ndarray,
        v: np.ndarray,
        held: HeldNodes,
        times: np.ndarray,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self._adjoint, self._held, self._times, self._v = adjoint, held, times, v
        solver, device, frames = adjoint.solver, adjoint.problem.device, len(times)
        self._substeps = np.array([solver.substeps_of(step) for step in np.diff(times)])
        terms = solver.terms[:-1]
        per_row = 8 * sum(a.numpy().size for term in terms for a in getattr(term, "memory", ()))
        rows, width = int(self._substeps.sum()) + 1, 3 * len(solver.mass)
        budget = adjoint.memory_mb * 1e6
        self.twice = rows * (4 * width + per_row) > budget
        double = self.twice or rows * (8 * width + per_row) <= budget
        if self.twice:
            rows = int(self._substeps.max()) + 1
        first = np.concatenate([[0], np.cumsum(self._substeps)])[:-1] * (not self.twice)
        self._offset = wp.array(first, dtype=wp.int32, device=device)
        self._memories = [memories_of(term, rows) for term in terms]
        flat_memories = [memory for part in self._memories for memory in part]
        self._history = wp.zeros((rows, width), dtype=wp.float64 if double else wp.float32, device=device)
        adjoint.recorder.prepare(self._history, self._offset, flat_memories)
        self._run = Run(solver, x, v, held, times)
        self._checkpoints: list[_Checkpoint] = []
        self.nodes = np.empty((frames, *x.shape))
        self.nodes[0] = x
        for frame in range(frames - 1):
            if self.twice:
                self._checkpoints.append(_Checkpoint(self._run, solver, flat_memories))
            self.nodes[frame + 1] = self._run.advance(frame)
            if progress is not None:
                progress(frame + 1, frames - 1)
        self._keep_last(rows - 1)
        self.nbytes = (
            self._history.size * (8 if double else 4)
            + sum(memory.nbytes for memory in flat_memories)
            + self.nodes.nbytes
            + sum(point.nbytes for point in self._checkpoints)
        )

    @property
    def problem(self) -> Problem:
        """What was integrated."""
        return self._adjoint.problem

    @property
    def bound_terms(self) -> tuple[BoundTerm, ...]:
        """The problem's terms on the device."""
        return self._adjoint.solver.terms[:-1]

    def gradient(self, seed: np.ndarray, pairs: Sequence[ForcePair] = ()) -> Gradient:
        """Derivatives of L from those by the positions at the frames, ``seed`` (T, n, 3).

        Args:
            seed: dL/dx; that by the first frame counts for ``Gradient.x`` only.
            pairs: two ways of forces; ``Gradient.works`` has the derivative of L along their difference.

        Raises:
            NotDifferentiable: a term has no backward pass.
        """
        if seed.shape != self.nodes.shape:
            raise ValueError(f"derivatives of shape {seed.shape} for positions of shape {self.nodes.shape}")
        return _ReversePass(self, seed, pairs).result()

    def _keep_last(self, row: int) -> None:
        """The velocities after the last substep follow those before it."""
        self._history.numpy()[row] = self._run.v.numpy()


class _ReversePass:
    """One reverse pass over a recorded run."""

    def __init__(self, run: RecordedRun, seed: np.ndarray, pairs: Sequence[ForcePair]) -> None:
        adjoint = run._adjoint
        self._run, self._seed, self._pairs = run, seed, pairs
        self._problem, self._solver = adjoint.problem, adjoint.solver
        problem, solver, device = self._problem, self._solver, self._problem.device
        nodes, frames = len(solver.mass), len(run._times)

        def zeros(shape: Any, dtype: Any = wp.float64) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        size = 3 * nodes
        self._now = Reverse(
            x=zeros(size), v=zeros(size), clock=zeros(3), counter=zeros(3, wp.int32), offset=run._offset,
            force_bar=zeros(size), x_bar=zeros(size), v_bar=zeros(size), mass_bar=zeros(nodes),
        )  # fmt: skip
        self._x_previous, self._previous_bar, self._pending = zeros(size), zeros(size), zeros(size)
        self._earlier_dt = zeros(1)
        self._gravity_bar, self._drag_bar, self._scaled = zeros(size), zeros(nodes), zeros(size)
        held = run._held
        width = max(3 * len(held.nodes), 1)
        self._path_bars = zeros((frames, width)), zeros((frames, width))
        slot = np.full(nodes, -1, dtype=np.int32)
        slot[held.nodes] = np.arange(len(held.nodes), dtype=np.int32)
        self._mass = wp.array(solver.mass, dtype=wp.float64, device=device)
        self._physics = [wp.vec3d(*problem.gravity_m_s2), wp.float64(problem.drag_per_s)]
        self._node_inputs = [
            self._mass, wp.array(slot, dtype=wp.int32, device=device), *self._physics, run._offset, run._history,
            self._now.clock, self._now.counter, self._earlier_dt, self._now.x,
        ]  # fmt: skip
        stiffness = problem.stiffness_factor
        stiffness = np.ones(problem.lattice.fill.size) if stiffness is None else stiffness
        self._tangent = InternalTangent(problem.lattice, problem.law, stiffness, problem.rest, device)
        self._law_bar = zeros(self._tangent.particles * len(self._tangent.parameters))
        self._viscous = friction_law(problem.law) is not None
        terms = solver.terms[:-1]
        self._multiplier = terms[0] if terms and getattr(terms[0], "multiplies", False) else None
        self._terms = [
            None if term is self._multiplier else adjoint_of(term, problem, self._now, memories)
            for term, memories in zip(terms, run._memories, strict=True)
        ]
        for pair in pairs:
            pair.prepare(self._now, self._x_previous, run._times, run._memories)

    def result(self) -> Gradient:
        """Go back over all frames, then over the half step of the start."""
        run, now, device = self._run, self._now, self._problem.device
        with wp.ScopedCapture(device=device) as capture:
            for _ in range(_CHUNK):
                self._substep()
        for frame in reversed(range(len(run._times) - 1)):
            self._enter(frame)
            for _ in range(int(run._substeps[frame]) // _CHUNK):
                wp.capture_launch(capture.graph)
        self._start()
        return self._collected(now)

    def _enter(self, frame: int) -> None:
        run, now, times = self._run, self._now, self._run._times
        if run.twice:
            run._checkpoints[frame].put_back(
                run._run, self._solver, [m for part in run._memories for m in part]
            )
            run._run.advance(frame)
            run._keep_last(int(run._substeps[frame]))
        steps = np.diff(times) / run._substeps
        interval, substeps, dt = times[frame + 1] - times[frame], int(run._substeps[frame]), steps[frame]
        now.clock.assign(np.array([interval, 1.0 / dt, dt]))
        now.counter.assign(np.array([frame, substeps - 1, substeps], dtype=np.int32))
        self._earlier_dt.assign(np.array([steps[frame - 1] if frame else 0.0]))
        now.x_bar.assign(now.x_bar.numpy() + self._seed[frame + 1].reshape(-1))
        start = wp.array(run.nodes[frame].reshape(-1), dtype=wp.float64, device=self._problem.device)
        first = int(run._offset.numpy()[frame])
        wp.launch(
            last_positions, dim=len(now.x), inputs=[start, run._history, first, substeps, wp.float64(dt)],
            outputs=[now.x], device=self._problem.device,
        )  # fmt: skip

    def _substep(self) -> None:
        now, device = self._now, self._problem.device
        wp.launch(
            take_nodes_back, dim=len(self._mass), inputs=self._node_inputs,
            outputs=[now.x_bar, now.v_bar, now.mass_bar, self._gravity_bar, self._drag_bar, *self._path_bars, now.v,
                     self._x_previous, now.force_bar],
            device=device,
        )  # fmt: skip
        direction = self._internal_direction()
        if self._viscous:
            self._tangent.apply_with_friction(
                now.x, self._x_previous, now.clock, direction, now.x_bar, self._previous_bar, self._law_bar
            )
        else:
            self._tangent.apply(now.x, direction, now.x_bar, self._law_bar)
        self._take_terms_back()
        wp.launch(
            step_back, dim=len(now.x), inputs=[self._x_previous],
            outputs=[self._previous_bar, self._pending, now.x, now.x_bar], device=device,
        )  # fmt: skip
        wp.launch(count_back, dim=1, inputs=[now.counter], device=device)

    def _internal_direction(self) -> wp.array:
        """w as the internal forces see it."""
        now = self._now
        if self._multiplier is None:
            return now.force_bar
        wp.copy(self._scaled, now.force_bar)
        self._multiplier.launch(now.x, now.v, now.clock, now.counter, self._scaled)
        return self._scaled

    def _take_terms_back(self) -> None:
        for pair in self._pairs:
            pair.add_work()
        for term in reversed(self._terms):
            if term is not None:
                term.take_back(self._now)

    def _start(self) -> None:
        """The half step back with which a run starts; then the state is the one that was given."""
        run, now, device = self._run, self._now, self._problem.device
        now.x_bar.assign(now.x_bar.numpy() + self._pending.numpy() + self._seed[0].reshape(-1))
        now.counter.assign(np.array([0, 0, run._substeps[0]], dtype=np.int32))
        for memory in (m for part in run._memories for m in part):
            memory.bar.zero_()
        half = wp.clone(now.v)
        now.v.assign(np.ascontiguousarray(run._v, dtype=float).reshape(-1))
        self._x_previous.assign(now.x)
        dt = wp.float64(now.clock.numpy()[2])
        wp.launch(
            take_start_back, dim=len(self._mass), inputs=[self._mass, *self._physics, dt, now.v, half],
            outputs=[now.v_bar, now.mass_bar, self._gravity_bar, self._drag_bar, now.force_bar], device=device,
        )  # fmt: skip
        self._tangent.apply(now.x, self._internal_direction(), now.x_bar, self._law_bar)
        self._take_terms_back()

    def _collected(self, now: Reverse) -> Gradient:
        problem, held = self._problem, self._run._held
        columns = self._tangent.parameters
        law = self._law_bar.numpy().reshape(-1, len(columns)).copy()
        stiffness = law[:, list(self._tangent.stiffness_columns)].sum(axis=1)
        stresses = tuple(
            (term.parameters_bar.numpy().copy(), term.fields_bar.numpy().reshape(-1, len(stiffness)).copy())
            if isinstance(term, StressAdjoint)
            else None
            for term in self._terms
        )
        own = problem.lattice.particle_measures * (
            1.0 if problem.stiffness_factor is None else problem.stiffness_factor
        )
        for part in stresses:
            if part is not None:  # the first field is the measure times the stiffness factor
                stiffness = stiffness + part[1][0] * own
        mass = now.mass_bar.numpy().copy()
        paths = [
            bar.numpy()[:, : 3 * len(held.nodes)].reshape(len(self._run._times), -1, 3).copy()
            for bar in self._path_bars
        ]
        return Gradient(
            log_stiffness=stiffness,
            log_density=_by_log_density(problem, mass),
            law=law,
            columns=columns,
            mass=mass,
            gravity=self._gravity_bar.numpy().reshape(-1, 3).sum(axis=0),
            drag=float(self._drag_bar.numpy().sum()),
            x=now.x_bar.numpy().reshape(-1, 3).copy(),
            v=now.v_bar.numpy().reshape(-1, 3).copy(),
            held_positions=paths[0],
            held_velocities=paths[1],
            stresses=stresses,
            works=tuple(pair.work for pair in self._pairs),
        )


class _Recorder:
    """The last of the terms: adds no force, keeps velocities and memories."""

    frequency_rad_s = 0.0
    friction_per_s = 0.0

    def bind(self, problem: Problem) -> _Recorder:
        return self

    def begin(self, times: np.ndarray) -> None:
        return None

    def check(self, time_s: float) -> None:
        return None

    def prepare(self, history: wp.array, offset: wp.array, memories: list[Memory]) -> None:
        """Where the next run goes."""
        self._history, self._offset, self._memories = history, offset, memories

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        wp.launch(
            keep_velocities, dim=len(v), inputs=[self._offset, counter, v], outputs=[self._history],
            device=v.device,
        )  # fmt: skip
        for memory in self._memories:
            memory.keep(self._offset, counter)


class _Checkpoint:
    """Everything that a frame starts from."""

    def __init__(self, run: Run, solver: TotalLagrangian, memories: list[Memory]) -> None:
        self._x, self._v = run.x.numpy().copy(), run.v.numpy().copy()
        self._friction = solver.forces.memory.numpy().copy()
        self._memories = [memory.now.numpy().copy() for memory in memories]
        self.nbytes = sum(a.nbytes for a in (self._x, self._v, self._friction, *self._memories))

    def put_back(self, run: Run, solver: TotalLagrangian, memories: list[Memory]) -> None:
        run.x.assign(self._x)
        run.v.assign(self._v)
        run.force.zero_()
        solver.forces.memory.assign(self._friction)
        for memory, kept in zip(memories, self._memories, strict=True):
            memory.now.assign(kept)
            memory.rows.numpy()[0] = kept


def _by_log_density(problem: Problem, mass_bar: np.ndarray) -> np.ndarray:
    """Derivatives by the log densities of the particles, (P,), from those by the nodal masses (n,)."""
    lattice = problem.lattice
    name = {3: "density_kg_m3", 2: "density_kg_m2", 1: "density_kg_m"}[lattice.dim]
    particle_mass = getattr(problem.law, name) * lattice.particle_measures
    if problem.density_factor is not None:
        particle_mass = particle_mass * problem.density_factor
    weights = lattice.table((0,) * lattice.dim)
    return particle_mass * (mass_bar[lattice.cell_nodes] @ weights).reshape(-1)
