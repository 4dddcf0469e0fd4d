"""Discrete elastic rods: problems of one chain, integrated side by side (:mod:`physworld.engine.rods.kernels`).

A rod whose rest shape nobody knows starts where it was measured, or, where too few of its points are seen for that,
from the shape in which it hangs still: it is then let settle under strong drag before the run. Terms (contacts,
effects) push the nodes; with them a run is launched substep by substep instead of as a whole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.hands import Openings
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.rods.chain import Chain
from physworld.engine.rods.kernels import (
    OPENING,
    SCALARS,
    SHRUNK,
    enter_interval,
    next_substep,
    run_rods,
)
from physworld.errors import BlewUp, CFLViolation, ParticlesLeftTheGrid, SceneUnsupported, SimulationError
from physworld.materials.cable import CableLaw

STEP_SHARE = 0.006
"""Time step over sqrt(L / g), the time in which the rod falls about its length: 1.9 ms for a metre."""
_GRAVITY = 9.81
_MODE_SHARE = 0.3  # of the second mode's period over 2 pi
_SECOND_MODE = 22.03  # (beta_2 L)^2 of a clamped rod
_STRETCH_RELAXATION_S = 1e-3
_LEAST_TORSION = 0.02  # GJ / EI; a curved rod without torsion has no directors
_TERM_SHARE = 0.5  # of a term's own limit of the time step
_SETTLE_TIME, _SETTLE_KNOTS, _SETTLE_DRAG, _SETTLE_RELAXATION = 19.0, 13, 1.9, 0.16  # in units of sqrt(L / g)
_GYRATION = 1.0 / np.sqrt(2.0)  # radius of gyration of a round section about its axis, over its radius
_TINY = 1e-12
_REACH = 50.0  # of the rod's length: where a node cannot be


@dataclass(frozen=True, eq=False)
class Sections:
    """What a rod's sections do beside its centre line.

    Attributes:
        natural: curvatures about the two directors and twist that the rod has by itself, at the parent of every node
            [1/m], (n, 3).
        radius_m: of the section, for its inertia about the axis.
        edges: that grips hold, by the node at which they end, (E,).
        turns: angles by which the grips turn them about their tangents since the start, at the knots [rad], (T, E).
        settles: the run begins with the rod hanging still.
        driven: curvatures [1/m] and stretch that chambers or tendons add to the rest shape, at the knots, (T, 3); None:
            nothing is driven.
    """

    natural: Array
    radius_m: float
    edges: Array
    turns: Array
    settles: bool = False
    driven: Array | None = None


class DiscreteRods:
    """Copies of one rod, side by side: other numbers, the same chain, grips' nodes and times.

    Args:
        problems: with a :class:`Chain`, a :class:`CableLaw` and their ``sections``; terms only where there is one
            problem.
        time_step_s: forced time step [s], or None for one by the rod's length and stiffness.

    Raises:
        SceneUnsupported: a body or a law of another kind, or terms beside others.
        CFLViolation: a forced time step beyond what a term allows.
    """

    def __init__(self, problems: Sequence[Problem], time_step_s: float | None = None) -> None:
        first = problems[0]
        lattice = first.lattice
        laws = [p.law for p in problems if isinstance(p.law, CableLaw)]
        if not isinstance(lattice, Chain) or len(laws) < len(problems):
            names = sorted({p.law.name for p in problems})
            raise SceneUnsupported(
                f"a discrete rod needs a chain and the law cable, got a body of dimension {lattice.dim} and {names}"
            )
        sections = [p.sections for p in problems if p.sections is not None]
        if len(sections) < len(problems):
            raise SceneUnsupported(
                f"{len(problems)} rods without sections: nothing says how their directors are held"
            )
        if len(problems) > 1 and any(p.terms for p in problems):
            raise SceneUnsupported(
                f"{len(problems)} rods side by side, some of them with terms: these run alone"
            )
        self.problems, self.chain, self.laws = list(problems), lattice, laws
        self.sections = sections
        self.terms = [term.bind(first) for term in first.terms]
        limit = self._term_limit()
        self.asked_step_s = time_step_s
        if time_step_s is not None and time_step_s > limit:
            raise CFLViolation(
                f"time step {time_step_s:.3g} s exceeds the limit {limit:.3g} s of what acts on the rod"
            )
        self.time_step_s = min(self._own_step(), limit) if time_step_s is None else time_step_s

    def run(
        self,
        x: Array,
        v: Array,
        held: Sequence[HeldNodes],
        times: Array,
        progress: Callable[[int, int], None] | None = None,
    ) -> list[Array | SimulationError]:
        """Nodal positions of every copy at ``times``, (T, n, 3) [m], or why they cannot be trusted.

        Args:
            x, v: nodal positions [m] and velocities [m/s] at the first time, (n, 3).
            held: prescribed nodes of each copy, or of all of them; their paths are given at ``times``.
            times: (T,) [s], strictly increasing.
            progress: called with (frames done, frames in all) before and after; may raise to stop.

        Raises:
            SceneUnsupported: an edge has no length at the start.
        """
        self._check_start(x)
        if held[0].hands and len(self.problems) > 1:
            return [
                DiscreteRods([one], self.time_step_s).run(x, v, [held[k % len(held)]], times, progress)[0]
                for k, one in enumerate(self.problems)
            ]
        if progress is not None:
            progress(0, len(times))
        launch = Launch(self, x, v, held, times)
        if self.sections[0].settles:
            launch.settle()
        out = launch.stepwise(progress) if self.terms or held[0].hands else launch.whole()
        if progress is not None:
            progress(len(times), len(times))
        size = float(self.chain.lengths.sum())
        return [_trusted(tracks, x, size, self.time_step_s) for tracks in out]

    def _check_start(self, x: Array) -> None:
        lengths = np.linalg.norm(x[1:] - x[self.chain.parent[1:]], axis=1)
        share = lengths / self.chain.lengths[1:]
        if not share.min() > SHRUNK:
            edge = int(np.argmin(np.where(np.isfinite(share), share, -1.0)))
            raise SceneUnsupported(
                f"edge {edge} of {len(share)} is {lengths[edge]:.3g} m long at the start, at rest "
                f"{self.chain.lengths[edge + 1]:.3g} m: it has no direction"
            )

    @property
    def stage_s(self) -> float:
        """Time that one evaluation of forces advances [s]: the step, which has one."""
        return self.time_step_s

    @property
    def fall_s(self) -> float:
        """sqrt(L / g), the time in which the rod falls about its length [s]; g is Earth's at least."""
        gravity = max(float(np.linalg.norm(self.problems[0].gravity_m_s2)), _GRAVITY)
        return float(np.sqrt(self.chain.distances.max() / gravity))

    def _own_step(self) -> float:
        length = float(self.chain.distances.max())
        speed = max(np.sqrt(_columns(p)["bending"] / p.law.density) for p in self.problems)
        mode = _SECOND_MODE * speed / length**2
        return float(min(STEP_SHARE * self.fall_s, _MODE_SHARE / mode))

    def _term_limit(self) -> float:
        square = sum(term.frequency_rad_s**2 for term in self.terms)
        rate = sum(term.friction_per_s for term in self.terms)
        limits = [2.0 / np.sqrt(square)] if square > 0 else []
        limits += [2.0 / rate] if rate > 0 else []
        return _TERM_SHARE * float(min(limits, default=np.inf))


class Launch:
    """Device arrays of one run.

    Args:
        rods: the copies and their numbers.
        x: nodes at the start (n, 3) [m], the same in every copy.
        v: their velocities (n, 3) [m/s].
        held: led nodes and their paths; one for all copies or one for each.
        times: of the frames (T,) [s].
    """

    def __init__(
        self, rods: DiscreteRods, x: Array, v: Array, held: Sequence[HeldNodes], times: Array
    ) -> None:
        self.rods, self.times = rods, np.asarray(times, dtype=float)
        self.device = rods.problems[0].device
        chain, sections = rods.chain, rods.sections
        copies, count = len(sections), len(chain.parent)
        self.shape = (copies, count)
        self._openings, self._opens = Openings(held[0], self.times, count), bool(held[0].hands)
        if self._opens:
            opened = self._openings
            held = [HeldNodes(opened.nodes, opened.positions, opened.velocities)]
        numbers = self._openings.slots
        edges = _numbers(sections[0].edges, count)
        directors = directors_along(chain, x)
        self.model = [
            self._array(np.maximum(chain.parent, 0), wp.int32), self._array(chain.lengths),
            self._array(numbers, wp.int32), self._array(edges, wp.int32),
        ]  # fmt: skip
        self.path = [
            self._array(np.stack([one.positions for one in held]), wp.vec3d),
            self._array(np.stack([one.velocities for one in held]), wp.vec3d),
            self._array(np.stack([s.turns for s in sections][: len(held)])),
            self._array(np.stack([_driven(p, len(self.times)) for p in rods.problems]), wp.vec3d),
        ]
        start = np.where((numbers >= 0)[:, None], 0.0, v)
        now = numbers[held[0].nodes] >= 0
        start[held[0].nodes[now]] = held[0].velocities[0, now]

        def copied(values: Array, dtype: type) -> wp.array:
            return self._array(np.broadcast_to(values, (copies, *values.shape)), dtype)

        self.state = [
            copied(x, wp.vec3d), copied(start, wp.vec3d), copied(directors, wp.vec3d),
            self._zeros(wp.float64), self._zeros(wp.float64, 2), copied(joint_angles(chain, x), wp.float64),
        ]  # fmt: skip
        self.start = self._array(np.broadcast_to(start, (copies, *start.shape)), wp.vec3d)
        self.push = self._zeros(wp.vec3d)
        kinds = [wp.vec3d, wp.float64, wp.mat33d, wp.mat33d, wp.mat33d, wp.vec3d, *[wp.float64] * 4]
        self.scratch = [self._zeros(kind) for kind in kinds]

    def whole(self) -> Array:
        """The run in one launch: positions at the times, (C, T, n, 3)."""
        steps = self._steps(self.times)
        return self._go(self._numbers_of(), self.times, steps, self.path)

    def stepwise(self, progress: Callable[[int, int], None] | None) -> Array:
        """The run of one rod substep by substep, with its terms."""
        for frame in range(len(self.times) - 1):
            self.interval(frame)
            if progress is not None:
                progress(frame + 1, len(self.times))
        found: Array = self._out.numpy()
        return found

    def interval(self, frame: int) -> Array:
        """Bring one rod from ``times[frame]`` to the next time; its nodes then, (n, 3) [m].

        The first call is of frame 0. A frame may be integrated again, with paths that were written meanwhile
        (``self.path``).
        """
        if frame == 0:
            self._begin()
        elif self._opens and self._openings.enter(frame, self.state[0].numpy()[0]):
            self.model[2].assign(self._openings.slots)
            for array, path in zip(
                self.path, (self._openings.positions, self._openings.velocities), strict=False
            ):
                array.assign(path[None])
        count = int(self._counts[frame])
        for term in self.rods.terms:
            term.pace(float(self.times[frame + 1] - self.times[frame]) / count)
        wp.launch(
            enter_interval, dim=1, inputs=[frame, *self._ticks], outputs=[self._part, self._counter, self._clock],
            device=self.device,
        )  # fmt: skip
        for _ in range(count):
            wp.capture_launch(self._substep)
        for term in self.rods.terms:
            term.check(float(self.times[frame + 1]))
        nodes: Array = self.state[0].numpy()[0].copy()
        return nodes

    def _begin(self) -> None:
        """What the intervals of one rod share: its substep is recorded once and replayed."""
        terms, flat = self.rods.terms, [_flat(array) for array in (self.state[0], self.state[1], self.push)]
        self._clock = wp.zeros(3, dtype=wp.float64, device=self.device)
        self._counter = wp.zeros(3, dtype=wp.int32, device=self.device)
        self._part = wp.zeros(4, dtype=wp.int32, device=self.device)
        self._counts = self._steps(self.times)
        self._ticks = self._array(self.times), self._array(self._counts, wp.int32)
        self._out = wp.zeros((1, len(self.times), self.shape[1]), dtype=wp.vec3d, device=self.device)
        for term in terms:
            term.begin(self.times)
        inputs = [
            *self.model,
            *self._numbers_of(),
            *self._ticks,
            *self.path,
            self.push,
            self._part,
            *self.state,
        ]
        with wp.ScopedCapture(device=self.device) as capture:
            self.push.zero_()
            for term in terms:
                term.launch(flat[0], flat[1], self._clock, self._counter, flat[2])
            wp.launch(
                run_rods, dim=1, inputs=[*inputs, *self.scratch], outputs=[self._out], device=self.device
            )
            wp.launch(next_substep, dim=1, outputs=[self._part, self._counter], device=self.device)
        self._substep = capture.graph

    def settle(self) -> None:
        """Let the rods come to rest under their grips as these are at the first time, without friction or creep."""
        times = np.linspace(0.0, _SETTLE_TIME * self.rods.fall_s, _SETTLE_KNOTS)
        numbers = self._numbers_of(settling=True)
        still = [
            self._array(np.repeat(array.numpy()[:, :1], len(times), axis=1), array.dtype)
            for array in self.path
        ]
        still[1].zero_()
        self._go(numbers, times, self._steps(times), still)
        wp.copy(self.state[1], self.start)
        for memory in (self.state[3], self.state[4]):
            memory.zero_()

    def _go(self, numbers: list[wp.array], times: Array, steps: Array, path: list[wp.array]) -> Array:
        copies, count = self.shape
        out = wp.zeros((copies, len(times), count), dtype=wp.vec3d, device=self.device)
        wp.launch(
            run_rods, dim=copies,
            inputs=[*self.model, *numbers, self._array(times), self._array(steps, wp.int32), *path, self.push,
                    self._array(np.array([0, len(steps), 0, steps.max()]), wp.int32), *self.state, *self.scratch],
            outputs=[out], device=self.device,
        )  # fmt: skip
        found: Array = out.numpy()
        return found

    def _steps(self, times: Array) -> Array:
        return np.maximum(1, np.ceil(np.diff(times) / self.rods.time_step_s - 1e-9)).astype(np.int32)

    def _numbers_of(self, settling: bool = False) -> list[wp.array]:
        """Masses, stiffnesses, natural curvatures, scalars and gravity of every copy."""
        problems, chain = self.rods.problems, self.rods.chain
        columns = [_columns(p) for p in problems]
        factors = [_edge_factors(chain, p.stiffness_factor) for p in problems]
        stretching = np.stack([c["stretching"] * f for c, f in zip(columns, factors, strict=True)])
        bending = np.stack([c["bending"] * f for c, f in zip(columns, factors, strict=True)])
        torsion = np.stack(
            [
                max(law.torsion_ratio, _LEAST_TORSION) * b
                for law, b in zip(self.rods.laws, bending, strict=True)
            ]
        )
        return [
            self._array(np.stack([p.nodal_mass() for p in problems])),
            self._array(stretching),
            self._array(np.repeat(bending[..., None], 2, axis=2)),
            self._array(torsion),
            self._array(np.stack([s.natural for s in self.rods.sections])),
            self._array(np.stack([_scalars(p, self.rods.fall_s if settling else None) for p in problems])),
            self._array(np.stack([np.asarray(p.gravity_m_s2, dtype=float) for p in problems]), wp.vec3d),
        ]

    def _zeros(self, dtype: type, depth: int = 0) -> wp.array:
        return wp.zeros((*self.shape, depth) if depth else self.shape, dtype=dtype, device=self.device)

    def _array(self, values: Array, dtype: type = wp.float64) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)


def directors_along(chain: Chain, x: Array) -> Array:
    """A director of every edge at nodal positions ``x`` (n, 3) [m], carried along the rod without twist, (n, 3)."""
    tangents = _tangents(chain, x)
    directors = np.zeros_like(x)
    for node in range(1, len(x)):
        before, t = chain.parent[node], tangents[node]
        if before == 0:
            across = _cross(t, np.eye(3)[np.argmin(np.abs(t))])
            directors[node] = across / np.linalg.norm(across)
            continue
        s, d = tangents[before], directors[before]
        axis = _cross(s, t)
        once = _cross(axis, d)
        directors[node] = d + once + _cross(axis, once) / max(1.0 + s @ t, _TINY)
    directors[0] = directors[1]
    return directors


def _tangents(chain: Chain, x: Array) -> Array:
    """Unit vectors of the edges, by the node at which they end, (n, 3); zero at the first node."""
    found = np.zeros_like(x)
    edges = x[1:] - x[chain.parent[1:]]
    found[1:] = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    return found


def _cross(a: Array, b: Array) -> Array:
    """Of two vectors (3,); numpy's own takes twenty times as long."""
    (a0, a1, a2), (b0, b1, b2) = a.tolist(), b.tolist()
    return np.array((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0))


def joint_angles(chain: Chain, x: Array) -> Array:
    """Curvatures of every joint about the two directors at nodal positions ``x`` (n, 3) [m], as angles (n, 2) [rad].

    Directors are those of :func:`directors_along`; a joint stands at the parent of its node.
    """
    directors, tangents, found = directors_along(chain, x), _tangents(chain, x), np.zeros((len(x), 2))
    nodes = np.flatnonzero(chain.parent > 0)
    middles = chain.parent[nodes]
    before, after, first, last = tangents[middles], tangents[nodes], directors[middles], directors[nodes]
    open_ = np.maximum(1.0 + np.sum(before * after, axis=1), OPENING)
    binormal = 2.0 * np.cross(before, after) / open_[:, None]
    second = np.cross(before, first) + np.cross(after, last)
    found[nodes, 0] = 0.5 * np.sum(binormal * second, axis=1)
    found[nodes, 1] = -0.5 * np.sum(binormal * (first + last), axis=1)
    return found


def _columns(problem: Problem) -> dict[str, float]:
    return problem.law.columns


def _scalars(problem: Problem, settle_s: float | None) -> Array:
    """A row of the kernel's scalars; of a rod that settles with strong drag, no friction, and creep at its end.

    Args:
        problem: the rod.
        settle_s: sqrt(L / g) [s] of a rod that settles, else None.
    """
    law, sections = problem.law, problem.sections
    assert isinstance(law, CableLaw) and sections is not None
    row = np.zeros(SCALARS)
    relaxation = law.relaxation_s
    row[:3] = relaxation, relaxation, _STRETCH_RELAXATION_S
    row[3], row[4] = problem.drag_per_s, law.drag_normal_per_m
    row[5], row[6] = law.friction_per_m, law.friction_onset_per_m
    row[7], row[8] = law.creep_ratio, law.creep_s
    row[9] = _GYRATION * sections.radius_m
    if settle_s is not None:
        row[:2], row[3], row[5], row[8] = _SETTLE_RELAXATION * settle_s, _SETTLE_DRAG / settle_s, 0.0, 1e-3
    return row


def _driven(problem: Problem, knots: int) -> Array:
    """What is driven from inside at the knots, (T, 3)."""
    sections = problem.sections
    return np.zeros((knots, 3)) if sections is None or sections.driven is None else sections.driven


def _edge_factors(chain: Chain, factor: Array | None) -> Array:
    """A field over the particles (P,) as one over the edges, by the node at which they end, (n,)."""
    factors = np.ones(len(chain.parent))
    if factor is not None:
        factors[1:] = np.asarray(factor).reshape(-1, 2).mean(axis=1)
    return factors


def _numbers(places: Array, count: int) -> Array:
    """Place of every node or edge in a list, (count,); -1 where it is not in it."""
    numbers = np.full(count, -1, dtype=np.int32)
    numbers[np.asarray(places, dtype=int)] = np.arange(len(places), dtype=np.int32)
    return numbers


def _flat(array: wp.array) -> wp.array:
    """The numbers of a (1, n) array of vectors as (3n,), the same memory."""
    return wp.array(
        ptr=array.ptr, dtype=wp.float64, shape=(3 * array.shape[1],), device=array.device, copy=False
    )


def _trusted(tracks: Array, start: Array, size: float, dt: float) -> Array | SimulationError:
    """Positions (T, n, 3), or why they cannot be trusted."""
    bad = ~np.isfinite(tracks).all(axis=(1, 2))
    if bad.any():
        return BlewUp(
            f"the rod blew up at frame {int(np.argmax(bad))} of {len(tracks)} with time step {dt:.3g} s"
        )
    farthest = float(np.abs(tracks - start).max())
    if farthest > _REACH * size:
        return ParticlesLeftTheGrid(
            f"a node went {farthest:.3g} m from its start; the rod is {size:.3g} m long"
        )
    return tracks
