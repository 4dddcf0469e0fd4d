"""Bodies side by side: episodes of one lattice that differ in laws, fields, gravity, grips and what acts on them.

The cells and nodes of B bodies stand one body after another in the same arrays, so that a substep is one launch over
all cells and one over all nodes; what acts beside them (contacts, effects) is launched body by body on its share of the
arrays. Bodies share no node: one that blows up fills its own share with what is not finite, and no other.

All run with one time step, the smallest of theirs, and stop at the same times; a body whose times end before those of
others is left where its grips ended, and nothing of that is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.term import BoundTerm
from physworld.engine.total.forces import ForcesSideBySide
from physworld.engine.total.formulation import SteppedRun, check_state, whole_chunks
from physworld.engine.total.node_kernels import advance_nodes_side_by_side
from physworld.engine.total.stability import fastest_frequencies, stable_time_step
from physworld.errors import BatchRefused, CFLViolation, SimulationError

_SAME_CLOCK_S = 1e-9


class Batch:
    """Integrates several problems side by side; see the module's text.

    Args:
        problems: of one lattice, one kind of law, one device.
        time_step_s: forced time step [s], or None for the smallest of the stable ones.

    Attributes:
        time_steps_s: what each would take alone [s], (B,).
        time_step_s: what all take [s].

    Raises:
        BatchRefused: the problems do not fit side by side; the message says why.
        CFLViolation: the forced time step exceeds the stable limit of one of them.
    """

    def __init__(self, problems: Sequence[Problem], time_step_s: float | None = None) -> None:
        if not problems:
            raise BatchRefused("a batch needs at least one problem, got 0")
        first = problems[0]
        for number, problem in enumerate(problems):
            if not _same_lattice(first.lattice, problem.lattice):
                raise BatchRefused(f"problem {number} of {len(problems)} has another lattice than the first")
            if problem.device != first.device:
                raise BatchRefused(f"problem {number} is for {problem.device}, the first for {first.device}")
        self.problems, self.device, self.lattice = tuple(problems), first.device, first.lattice
        self.cell_m = float(first.lattice.spacing.max())
        self.masses = np.stack([problem.nodal_mass() for problem in problems])
        self.mass = self.masses.reshape(-1)
        ones = np.ones(first.lattice.fill.size)
        factors = [ones if p.stiffness_factor is None else p.stiffness_factor for p in problems]
        self.forces = ForcesSideBySide(
            self.lattice, [p.law for p in problems], factors, [p.rest for p in problems], self.device
        )
        self.terms = [tuple(term.bind(problem) for term in problem.terms) for problem in problems]
        frequencies, rates = self._fastest(factors)
        limits = [stable_time_step(f, r, safety=1.0) for f, r in zip(frequencies, rates, strict=True)]
        if time_step_s is not None and time_step_s > min(limits):
            worst = int(np.argmin(limits))
            raise CFLViolation(
                f"time step {time_step_s:.3g} s exceeds the stable {limits[worst]:.3g} s of body {worst} of "
                f"{len(problems)}, whose fastest mode has {frequencies[worst]:.4g} rad/s"
            )
        self.time_steps_s = np.array(
            [stable_time_step(f, r) for f, r in zip(frequencies, rates, strict=True)]
        )
        self.time_step_s = time_step_s or float(self.time_steps_s.min())
        self.substeps = 0

    def run(
        self,
        x: Sequence[Array],
        v: Sequence[Array],
        held: Sequence[HeldNodes],
        times: Sequence[Array],
        progress: Callable[[int, int], None] | None = None,
    ) -> list[Array | SimulationError]:
        """Integrate from the common start and record the nodes at every time.

        Args:
            x, v: nodal positions [m] and velocities [m/s] at the first time, (n, 3) for each body.
            held: prescribed nodes of each; their paths are given at its ``times``.
            times: (T,) [s] for each; all are the longest one or its beginning.
            progress: called with (frames done, frames in all) once a frame; may raise to stop all.

        Returns:
            for each body its nodal positions [m], (T, n, 3) float64, or the error for which it cannot be trusted:
            what :meth:`physworld.engine.total.formulation.TotalLagrangian.run` would have raised.

        Raises:
            BatchRefused: the bodies do not stop at the same times, or a grip lets go.
        """
        opening = sum(bool(own.hands) for own in held)
        if opening:
            raise BatchRefused(f"grips let go in {opening} of {len(held)} runs: they are integrated alone")
        longest = common_times(times)
        ends = [len(own) for own in times]
        run = _BatchRun(self, np.concatenate(x), np.concatenate(v), _joined(held, self, longest), longest)
        nodes = len(self.lattice.nodes)
        recorded = [np.empty((end, nodes, 3)) for end in ends]
        for body, frames in enumerate(recorded):
            frames[0] = x[body]
        for frame in range(len(longest) - 1):
            run.awaited = [end > frame + 1 for end in ends]
            if not any(w and error is None for w, error in zip(run.awaited, run.errors, strict=True)):
                break
            now = run.advance(frame).reshape(-1, nodes, 3)
            for body, frames in enumerate(recorded):
                if run.awaited[body]:
                    frames[frame + 1] = now[body]
            if progress is not None:
                progress(frame + 1, len(longest) - 1)
        return [
            frames if error is None else error for frames, error in zip(recorded, run.errors, strict=True)
        ]

    def substeps_of(self, interval: float) -> int:
        """Substeps that an interval between two frames takes."""
        return whole_chunks(interval, self.time_step_s)

    def _fastest(self, factors: list[Array]) -> tuple[Array, Array]:
        """Fastest frequencies [rad/s] and friction rates [1/s] of the bodies, (B,) each."""
        problems, cell = self.problems, float(self.lattice.spacing.min())
        rests = np.stack([problem.rest for problem in problems])
        frequencies = fastest_frequencies(self.forces, rests, self.masses, cell)
        rates = np.array([float(problem.drag_per_s) for problem in problems])
        frictions = {
            body: law
            for body, law in enumerate(problem.law.friction_law for problem in problems)
            if law is not None
        }
        rubbing = list(frictions)
        if rubbing:
            damper = ForcesSideBySide(
                self.lattice,
                [*frictions.values()],
                [factors[b] for b in rubbing],
                [*rests[rubbing]],
                self.device,
            )
            rates[rubbing] += fastest_frequencies(damper, rests[rubbing], self.masses[rubbing], cell) ** 2
        for body, terms in enumerate(self.terms):
            for term in terms:
                frequencies[body] = np.hypot(frequencies[body], term.frequency_rad_s)
                rates[body] += term.friction_per_s
        return frequencies, rates


class _BatchRun(SteppedRun):
    """A run of bodies side by side; each one's first error is kept and stops nothing.

    Attributes:
        errors: for each body, or None.
        awaited: for each body, whether the frame that is integrated is one of its own.
    """

    def __init__(self, batch: Batch, x: Array, v: Array, held: HeldNodes, times: Array) -> None:
        self.errors: list[SimulationError | None] = [None] * len(batch.problems)
        self.awaited = [True] * len(batch.problems)
        self._gravity = np.array([problem.gravity_m_s2 for problem in batch.problems], dtype=float)
        self._drag = np.array([problem.drag_per_s for problem in batch.problems], dtype=float)
        self._bodies = [
            wp.array(self._gravity, dtype=wp.vec3d, device=batch.device),
            wp.array(self._drag, dtype=wp.float64, device=batch.device),
        ]
        starts = x.reshape(len(batch.problems), -1, 3)
        self._sizes = [float(np.ptp(start, axis=0).max()) + batch.cell_m for start in starts]
        self._acting: list[tuple[tuple[BoundTerm, ...], list[wp.array]]] = []
        self._batch = batch
        super().__init__(batch, x, v, held, times)

    def _begin(self) -> None:
        batch, width = self._batch, 3 * len(self._batch.lattice.nodes)
        for body, terms in enumerate(batch.terms):
            try:
                for term in terms:
                    term.begin(self._times)
            except SimulationError as error:
                self.errors[body] = error
                continue
            share = slice(body * width, (body + 1) * width)
            self._acting.append((terms, [self.x[share], self.v[share], self.force[share]]))

    def _pace(self, time_step_s: float) -> None:
        for terms, _ in self._acting:
            for term in terms:
                term.pace(time_step_s)

    def _launch_terms(self) -> None:
        for terms, (x, v, force) in self._acting:
            for term in terms:
                term.launch(x, v, self.clock, self.counter, force)

    def _relaxing(self) -> None:
        return None

    def _launch_nodes(self) -> None:
        batch = self._batch
        wp.launch(
            advance_nodes_side_by_side,
            dim=len(batch.mass),
            inputs=[*self._nodes, *self._bodies, self.clock, self.counter, len(batch.lattice.nodes)],
            outputs=[self.force, self.x, self.v],
            device=batch.device,
        )

    def _fall(self) -> tuple[Array, Array]:
        nodes = len(self._batch.lattice.nodes)
        return np.repeat(self._gravity, nodes, axis=0), np.repeat(self._drag, nodes)[:, None]

    def _check(self, now: Array, time: float) -> None:
        batch, dt = self._batch, float(self._clocks[0].numpy()[2])
        bodies = len(batch.problems)
        inverted = np.count_nonzero(batch.forces.inverted.numpy().reshape(bodies, -1), axis=1)
        states, starts = now.reshape(bodies, -1, 3), self._start.reshape(bodies, -1, 3)
        for body in range(bodies):
            if self.errors[body] is not None or not self.awaited[body]:
                continue
            try:
                check_state(states[body], starts[body], int(inverted[body]), self._sizes[body], time, dt)
                for term in batch.terms[body]:
                    term.check(time)
            except SimulationError as error:
                self.errors[body] = error


def common_times(times: Sequence[Array]) -> Array:
    """The longest of the bodies' times, of which all others must be the beginning.

    Raises:
        BatchRefused: one of them is not.
    """
    longest = max(times, key=len)
    for body, own in enumerate(times):
        apart = np.abs(longest[: len(own)] - own)
        if apart.max() > _SAME_CLOCK_S:
            first = int(np.argmax(apart > _SAME_CLOCK_S))
            raise BatchRefused(
                f"bodies side by side stop at the same times; body {body} of {len(times)} stops at "
                f"{own[first]:.6g} s where the longest run stops at {longest[first]:.6g} s (stop {first})"
            )
    return longest


def _same_lattice(one: Lattice, other: Lattice) -> bool:
    return one is other or all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("origin", "spacing", "cells", "fill", "cell_nodes", "nodes")
    )


def _joined(held: Sequence[HeldNodes], batch: Batch, times: Array) -> HeldNodes:
    """Grips of all bodies; where a body's times end before ``times``, its grips stand still from then on."""
    nodes, positions, velocities = [], [], []
    for body, own in enumerate(held):
        missing = len(times) - len(own.positions)
        nodes.append(own.nodes + body * len(batch.lattice.nodes))
        positions.append(np.concatenate([own.positions, np.repeat(own.positions[-1:], missing, axis=0)]))
        velocities.append(np.concatenate([own.velocities, np.zeros((missing, *own.velocities.shape[1:]))]))
    return HeldNodes(
        np.concatenate(nodes), np.concatenate(positions, axis=1), np.concatenate(velocities, axis=1)
    )
