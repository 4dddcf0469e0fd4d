"""Reverse mode through the total Lagrangian engine: gradients of any function of a run's positions.

    run = Adjoint(problem).run(x, v, held, times);  gradient = run.gradient(dL/dx at the frames)

The forward pass keeps the velocities before every substep (positions follow from them), in double precision while that
fits the memory that may be used, else in single; where even that is too much it keeps whole states at the frames only
and runs every frame a second time when the reverse pass comes to it. The reverse pass takes the substeps back one by
one (:mod:`physworld.engine.gradients.adjoint_kernels`), in a captured graph like the forward one.

Internal forces: :class:`physworld.engine.gradients.tangent.InternalTangent`. Strong friction, which a run takes in
stages, is taken back through them, with the forces of every substep kept too:
:mod:`physworld.engine.gradients.adjoint_stages`. Terms:
:mod:`physworld.engine.gradients.adjoint_terms`. Scalars that change many things at once:
:mod:`physworld.engine.gradients.gradient`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.gradients.adjoint_kernels import keep_row
from physworld.engine.gradients.adjoint_pairs import ForcePair
from physworld.engine.gradients.adjoint_reverse import Gradient, ReversePass
from physworld.engine.gradients.adjoint_terms import Memory, memories_of
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.term import BoundTerm, refuse_undifferentiable
from physworld.engine.total.formulation import Run, TotalLagrangian

MEMORY_MB = 100.0


class Adjoint:
    """A problem whose runs can be differentiated.

    Args:
        problem: what is integrated.
        time_step_s: forced time step [s], or None for the stable one.
        memory_mb: what a run may keep for its gradient; beyond it every frame is run twice.

    Raises:
        CFLViolation: the forced time step exceeds the stable limit.
        NotDifferentiable: a term has no derivative.
    """

    def __init__(
        self, problem: Problem, time_step_s: float | None = None, memory_mb: float = MEMORY_MB
    ) -> None:
        self.problem = problem
        self.memory_mb = memory_mb
        self.recorder = _Recorder()
        self.solver = TotalLagrangian(replace(problem, terms=(*problem.terms, self.recorder)), time_step_s)
        refuse_undifferentiable(self.solver.terms)

    @property
    def time_step_s(self) -> float:
        """Largest time step [s]; frames are divided evenly."""
        return self.solver.time_step_s

    def run(
        self,
        x: Array,
        v: Array,
        held: HeldNodes,
        times: Array,
        progress: Callable[[int, int], None] | None = None,
    ) -> RecordedRun:
        """Integrate and keep what a gradient needs: arguments and errors of :meth:`TotalLagrangian.run`.

        Args:
            x, v, held, times, progress: as in :meth:`TotalLagrangian.run`.
        """
        return RecordedRun(self, x, v, held, np.asarray(times, dtype=float), progress)


class RecordedRun:
    """A run that has been made.

    Attributes:
        nodes: positions at the frames [m], (T, n, 3).
        problem, solver: what was integrated, and the solver that did it.
        held, times, velocity: its arguments.
        substeps: of every frame, (T - 1,).
        stages: of friction in the substeps of every frame, (T - 1,); 0 where it is explicit.
        history: velocities before every substep, one a row; offset: first row of every frame.
        forces: those beside friction in every substep, likewise, where friction is taken in stages; else None.
        memories: of every term.
        twice: whether the gradient runs every frame again.
        nbytes: memory kept for the gradient.

    Args:
        adjoint: problem, solver and recorder.
        x: nodes at the start (n, 3) [m].
        v: their velocities (n, 3) [m/s].
        held: nodes that are led, and their paths.
        times: of the frames (T,) [s].
        progress: called with (frames done, frames in all); may raise to stop.
    """

    def __init__(
        self,
        adjoint: Adjoint,
        x: Array,
        v: Array,
        held: HeldNodes,
        times: Array,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self.problem, self.solver = adjoint.problem, adjoint.solver
        self.held, self.times, self.velocity = held, times, v
        solver, device, frames = adjoint.solver, adjoint.problem.device, len(times)
        self.substeps = np.array([solver.substeps_of(step) for step in np.diff(times)])
        terms = solver.terms[:-1]
        per_row = 8 * sum(a.numpy().size for term in terms for a in getattr(term, "memory", ()))
        rows, width = int(self.substeps.sum()) + 1, 3 * len(solver.mass)
        kept = width * (2 if solver.relaxed else 1)
        budget = adjoint.memory_mb * 1e6
        self.twice = rows * (4 * kept + per_row) > budget
        double = self.twice or rows * (8 * kept + per_row) <= budget
        if self.twice:
            rows = int(self.substeps.max()) + 1
        first = np.concatenate([[0], np.cumsum(self.substeps)])[:-1] * (not self.twice)
        self.offset = wp.array(first, dtype=wp.int32, device=device)
        self.memories = [memories_of(term, rows) for term in terms]
        flat_memories = [memory for part in self.memories for memory in part]
        dtype = wp.float64 if double else wp.float32
        self.history = wp.zeros((rows, width), dtype=dtype, device=device)
        self.forces = wp.zeros((rows, width), dtype=dtype, device=device) if solver.relaxed else None
        adjoint.recorder.prepare(self.history, self.forces, self.offset, flat_memories)
        self._run = Run(solver, x, v, held, times)
        self._checkpoints: list[_Checkpoint] = []
        self.nodes = np.empty((frames, *x.shape))
        self.nodes[0] = x
        self.stages = np.zeros(frames - 1, dtype=int)
        for frame in range(frames - 1):
            if self.twice:
                self._checkpoints.append(_Checkpoint(self._run, solver, flat_memories))
            self.nodes[frame + 1] = self._run.advance(frame)
            self.stages[frame] = self._run.stages
            if progress is not None:
                progress(frame + 1, frames - 1)
        self._keep_last(rows - 1)
        self.nbytes = (
            rows * kept * (8 if double else 4)
            + sum(memory.nbytes for memory in flat_memories)
            + self.nodes.nbytes
            + sum(point.nbytes for point in self._checkpoints)
        )

    @property
    def bound_terms(self) -> tuple[BoundTerm, ...]:
        """The problem's terms on the device."""
        return self.solver.terms[:-1]

    def gradient(self, seed: Array, pairs: Sequence[ForcePair] = ()) -> Gradient:
        """Derivatives of L from those by the positions at the frames, ``seed`` (T, n, 3).

        Args:
            seed: dL/dx; that by the first frame counts for ``Gradient.x`` only.
            pairs: two ways of forces; ``Gradient.works`` has the derivative of L along their difference.

        Raises:
            NotDifferentiable: a term has no backward pass.
        """
        if seed.shape != self.nodes.shape:
            raise ValueError(f"derivatives of shape {seed.shape} for positions of shape {self.nodes.shape}")
        return ReversePass(self, seed, pairs).result()

    def refill(self, frame: int) -> None:
        """Run a frame again from its checkpoint: the history holds its substeps then."""
        memories = [memory for part in self.memories for memory in part]
        self._checkpoints[frame].put_back(self._run, self.solver, memories)
        self._run.advance(frame, int(self.stages[frame]))
        self._keep_last(int(self.substeps[frame]))

    def _keep_last(self, row: int) -> None:
        """The velocities after the last substep follow those before it."""
        self.history[row].assign(self._run.v.numpy())


class _Recorder(BoundTerm):
    """The last of the terms: adds no force, keeps velocities, memories and, where friction has stages, forces."""

    def bind(self, problem: Problem) -> _Recorder:
        return self

    def prepare(
        self, history: wp.array, forces: wp.array | None, offset: wp.array, memories: list[Memory]
    ) -> None:
        """Where the next run goes."""
        self._rows, self._offset, self._memories = (history, forces), offset, memories

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        for values, rows in zip((v, force), self._rows, strict=True):
            if rows is not None:
                inputs = [self._offset, counter, values]
                wp.launch(keep_row, dim=len(v), inputs=inputs, outputs=[rows], device=v.device)
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
            memory.rows[0].assign(kept)
