"""The reverse pass of a recorded run: its substeps are taken back one by one, in a captured graph.

What is carried back is the derivative of L by the positions and velocities before every substep; on the way w, that by
the forces, is multiplied with the derivatives of everything that makes forces. See
:mod:`physworld.engine.gradients.adjoint`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.captured import CHUNK, Chunk
from physworld.engine.gradients.adjoint_kernels import (
    count_back,
    last_positions,
    step_back,
    take_away,
    take_nodes_back,
    take_start_back,
)
from physworld.engine.gradients.adjoint_pairs import ForcePair
from physworld.engine.gradients.adjoint_stages import StagesBack
from physworld.engine.gradients.adjoint_terms import (
    Memory,
    RecordedAdjoint,
    Reverse,
    StressAdjoint,
    TermAdjoint,
    TwistAdjoint,
)
from physworld.engine.gradients.soft_grips_derivatives import SoftGripsAdjoint, SoftGripsGradient
from physworld.engine.gradients.tangent import InternalTangent
from physworld.engine.problem import Problem
from physworld.engine.terms.ground import BoundGround
from physworld.engine.terms.soft_grips import BoundSoftGrips
from physworld.engine.terms.term import BoundTerm
from physworld.engine.thin.twist import BoundTwist
from physworld.engine.total.stress import BoundStress

if TYPE_CHECKING:
    from physworld.engine.gradients.adjoint import RecordedRun


@dataclass(frozen=True)
class Gradient:
    """Derivatives of a scalar L of a run.

    Attributes:
        log_stiffness, log_density: by the logarithms of the particles' fields, (P,).
        twist: the share of twist in ``log_stiffness``, (P,): its sum is by the torsional stiffness' logarithm.
        log_friction: by the logarithms of the factors of the ground's friction, (P,); None in a run without that field.
        law: by the logarithm of every number of the law at every particle, (P, columns).
        columns: names of those numbers (:attr:`InternalTangent.parameters`).
        mass: by the nodal masses [1/kg], (n,).
        gravity: by the gravity vector, (3,).
        drag: by the drag rate.
        x, v: by the initial state, (n, 3).
        held_positions, held_velocities: by the prescribed paths, (T, H, 3).
        soft_grips: by grips that hold softly; None in a run without any.
        stresses: by numbers (k,) and fields (layers, P) of every stress beside the law, in the order of the terms;
            None for another term.
        works: of the force pairs that were given.
    """

    log_stiffness: Array
    log_density: Array
    twist: Array
    log_friction: Array | None
    law: Array
    columns: tuple[str, ...]
    mass: Array
    gravity: Array
    drag: float
    x: Array
    v: Array
    held_positions: Array
    held_velocities: Array
    soft_grips: SoftGripsGradient | None
    stresses: tuple[tuple[Array, Array] | None, ...]
    works: tuple[float, ...]


class ReversePass:
    """One reverse pass over a recorded run."""

    def __init__(self, run: RecordedRun, seed: Array, pairs: Sequence[ForcePair]) -> None:
        self._run, self._seed, self._pairs = run, seed, pairs
        self._problem, self._solver = run.problem, run.solver
        problem, solver, device = self._problem, self._solver, self._problem.device
        nodes, frames = len(solver.mass), len(run.times)

        def zeros(shape: Any, dtype: Any = wp.float64) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        size = 3 * nodes
        self._now = Reverse(
            x=zeros(size), v=zeros(size), clock=zeros(3), counter=zeros(3, wp.int32), offset=run.offset,
            pull=zeros(size), force_bar=zeros(size), x_bar=zeros(size), v_bar=zeros(size),
            mass_bar=zeros(nodes), drag_bar=zeros(nodes), gravity_bar=zeros(size),
        )  # fmt: skip
        self._x_previous, self._previous_bar, self._pending = zeros(size), zeros(size), zeros(size)
        self._earlier_dt = zeros(1)
        self._scaled = zeros(size)
        held = run.held
        width = max(3 * len(held.nodes), 1)
        self._path_bars = zeros((frames, width)), zeros((frames, width))
        slot = np.full(nodes, -1, dtype=np.int32)
        slot[held.nodes] = np.arange(len(held.nodes), dtype=np.int32)
        self._mass = wp.array(solver.mass, dtype=wp.float64, device=device)
        self._physics = [wp.vec3d(*problem.gravity_m_s2), wp.float64(problem.drag_per_s)]
        self._node_inputs = [
            self._mass, wp.array(slot, dtype=wp.int32, device=device), *self._physics, run.offset, run.history,
            self._now.clock, self._now.counter, self._earlier_dt, self._now.x,
        ]  # fmt: skip
        stiffness = problem.stiffness_factor
        stiffness = np.ones(problem.lattice.fill.size) if stiffness is None else stiffness
        self._tangent = InternalTangent(problem.lattice, problem.law, stiffness, problem.rest, device)
        self._law_bar = zeros(self._tangent.particles * len(self._tangent.parameters))
        self._viscous = problem.law.friction_law is not None
        terms = solver.terms[:-1]
        self._multiplier = terms[0] if terms and getattr(terms[0], "multiplies", False) else None
        soft = terms[-1] if terms and isinstance(terms[-1], BoundSoftGrips) else None
        self._soft = None if soft is None else SoftGripsAdjoint(soft, frames)
        self._terms = [
            None
            if term is self._multiplier or term is soft
            else adjoint_of(term, problem, self._now, memories)
            for term, memories in zip(terms, run.memories, strict=True)
        ]
        self._stages = None
        if run.forces is not None:
            self._stages = StagesBack(
                problem, solver.friction, self._node_inputs[:2], (run.history, run.forces), self._now,
                self._earlier_dt, self._x_previous, self._path_bars, self._tangent, self._law_bar, pairs,
            )  # fmt: skip
        for pair in pairs:
            pair.prepare(self._now, self._x_previous, run.times, run.memories)

    def result(self) -> Gradient:
        """Go back over all frames, then over the half step of the start."""
        run, now, device = self._run, self._now, self._problem.device
        chunks: dict[int, Chunk] = {}
        for frame in reversed(range(len(run.times) - 1)):
            self._enter(frame)
            stages = int(run.stages[frame])
            if stages not in chunks:
                chunks[stages] = Chunk(partial(self._substep, stages), device)
            for _ in range(int(run.substeps[frame]) // CHUNK):
                chunks[stages].launch()
        self._start()
        return self._collected(now)

    def _enter(self, frame: int) -> None:
        run, now, times = self._run, self._now, self._run.times
        if run.twice:
            run.refill(frame)
        steps = np.diff(times) / run.substeps
        interval, substeps, dt = times[frame + 1] - times[frame], int(run.substeps[frame]), steps[frame]
        now.clock.assign(np.array([interval, 1.0 / dt, dt]))
        now.counter.assign(np.array([frame, substeps - 1, substeps], dtype=np.int32))
        self._earlier_dt.assign(np.array([steps[frame - 1] if frame else 0.0]))
        for term in self._solver.terms:
            term.pace(dt)
        if self._stages is not None:
            self._stages.enter(dt, int(run.stages[frame]))
        now.x_bar.assign(now.x_bar.numpy() + self._seed[frame + 1].reshape(-1))
        start = wp.array(run.nodes[frame].reshape(-1), dtype=wp.float64, device=self._problem.device)
        first = int(run.offset.numpy()[frame])
        wp.launch(
            last_positions, dim=len(now.x), inputs=[start, run.history, first, substeps, wp.float64(dt)],
            outputs=[now.x], device=self._problem.device,
        )  # fmt: skip

    def _substep(self, stages: int) -> None:
        now, device = self._now, self._problem.device
        if self._stages is None:
            self._take_nodes_back()
        else:
            self._take_stages_back(self._stages, stages)
        self._take_terms_back()
        wp.launch(
            step_back, dim=len(now.x), inputs=[self._x_previous],
            outputs=[self._previous_bar, self._pending, now.x, now.x_bar], device=device,
        )  # fmt: skip
        wp.launch(count_back, dim=1, inputs=[now.counter], device=device)

    def _take_stages_back(self, taken: StagesBack, stages: int) -> None:
        """Nodes, grips that hold softly, and internal forces where friction has stages of its own."""
        now = self._now
        taken.take_back(stages)
        if self._viscous and self._soft is None:
            return
        self._scaled.zero_()
        if self._viscous:  # the elastic forces were taken along all of it, and owe what the grips change
            wp.copy(self._scaled, now.force_bar)
        if self._soft is not None:
            self._soft.take_back(now)
        inputs = [now.force_bar]
        wp.launch(take_away, dim=len(now.x), inputs=inputs, outputs=[self._scaled], device=now.x.device)
        self._tangent.apply(now.x, self._scaled, now.x_bar, self._law_bar)

    def _take_nodes_back(self) -> None:
        """The same with explicit friction."""
        now, device = self._now, self._problem.device
        wp.launch(
            take_nodes_back, dim=len(self._mass), inputs=self._node_inputs,
            outputs=[now.x_bar, now.v_bar, now.mass_bar, now.gravity_bar, now.drag_bar, *self._path_bars, now.v,
                     self._x_previous, now.pull, now.force_bar],
            device=device,
        )  # fmt: skip
        if self._soft is not None:
            self._soft.take_back(now)
        direction = self._internal_direction()
        if self._viscous:
            self._tangent.apply_with_friction(
                now.x, self._x_previous, now.clock, direction, now.x_bar, self._previous_bar, self._law_bar
            )
        else:
            self._tangent.apply(now.x, direction, now.x_bar, self._law_bar)

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
        """The half step back with which a run starts; then the state is the one that was given.

        With stages of friction there is none: the first stages are half a step.
        """
        run, now, device = self._run, self._now, self._problem.device
        now.x_bar.assign(now.x_bar.numpy() + self._pending.numpy() + self._seed[0].reshape(-1))
        if self._stages is not None:
            return
        now.counter.assign(np.array([0, 0, run.substeps[0]], dtype=np.int32))
        for memory in (m for part in run.memories for m in part):
            memory.bar.zero_()
        half = wp.clone(now.v)
        now.v.assign(np.ascontiguousarray(run.velocity, dtype=float).reshape(-1))
        self._x_previous.assign(now.x)
        dt = wp.float64(now.clock.numpy()[2])
        wp.launch(
            take_start_back, dim=len(self._mass), inputs=[self._mass, *self._physics, dt, now.v, half],
            outputs=[now.v_bar, now.mass_bar, now.gravity_bar, now.drag_bar, now.pull, now.force_bar],
            device=device,
        )  # fmt: skip
        if self._soft is not None:
            self._soft.take_back(now)
        self._tangent.apply(now.x, self._internal_direction(), now.x_bar, self._law_bar)
        self._take_terms_back()

    def _collected(self, now: Reverse) -> Gradient:
        problem, held = self._problem, self._run.held
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
        twisted = np.zeros_like(stiffness)
        for term in self._terms:
            if isinstance(term, TwistAdjoint):
                twisted = twisted + term.log_stiffness
        mass = now.mass_bar.numpy().copy()
        paths = [
            bar.numpy()[:, : 3 * len(held.nodes)].reshape(len(self._run.times), -1, 3).copy()
            for bar in self._path_bars
        ]
        return Gradient(
            log_stiffness=stiffness + twisted,
            twist=twisted,
            log_friction=self._by_log_friction(),
            log_density=_by_log_density(problem, mass),
            law=law,
            columns=columns,
            mass=mass,
            gravity=now.gravity_bar.numpy().reshape(-1, 3).sum(axis=0),
            drag=float(now.drag_bar.numpy().sum()),
            x=now.x_bar.numpy().reshape(-1, 3).copy(),
            v=now.v_bar.numpy().reshape(-1, 3).copy(),
            held_positions=paths[0],
            held_velocities=paths[1],
            soft_grips=None if self._soft is None else self._soft.collected(),
            stresses=stresses,
            works=tuple(pair.work for pair in self._pairs),
        )

    def _by_log_friction(self) -> Array | None:
        found: Array | None = None
        for bound, term in zip(self._solver.terms, self._terms, strict=False):
            if isinstance(bound, BoundGround) and isinstance(term, RecordedAdjoint):
                assert term.differentiated_bar is not None
                share: Array = bound.by_log_factor(term.differentiated_bar.numpy())
                found = share if found is None else found + share
        return found


def _by_log_density(problem: Problem, mass_bar: Array) -> Array:
    """Derivatives by the log densities of the particles, (P,), from those by the nodal masses (n,)."""
    lattice = problem.lattice
    particle_mass = problem.law.density * lattice.particle_measures
    if problem.density_factor is not None:
        particle_mass = particle_mass * problem.density_factor
    weights = lattice.table((0,) * lattice.dim)
    found: Array = particle_mass * (mass_bar[lattice.cell_nodes] @ weights).reshape(-1)
    return found


def adjoint_of(term: BoundTerm, problem: Problem, now: Reverse, memories: list[Memory]) -> TermAdjoint:
    """The reverse pass of a bound term whose ``begin`` has been called.

    Args:
        term: of the run.
        problem: the run's.
        now: state and derivatives of the reverse pass.
        memories: what the term carried from substep to substep, kept in the forward pass.

    Raises:
        NotDifferentiable: one of its kernels was compiled without a backward pass.
    """
    if isinstance(term, BoundStress):
        return StressAdjoint(term, problem, memories)
    if isinstance(term, BoundTwist):
        return TwistAdjoint(term, memories)
    return RecordedAdjoint(term, problem.nodal_mass(), now, memories)
