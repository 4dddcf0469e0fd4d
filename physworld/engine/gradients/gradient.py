"""Derivatives of a run by scalars that enter it in many places, and of tracked points by the nodes.

A scalar theta (a law's modulus, the strength of an effect) changes fields, gravity, drag, masses, grips, laws and terms
on the host, by code that costs nothing beside a run. Its two neighbours, :class:`Setting` high and low, are compared
piece by piece: what differs in arrays is multiplied with the derivatives of
:class:`physworld.engine.gradients.adjoint.Gradient`; what differs in forces is launched beside the reverse pass
(:mod:`physworld.engine.gradients.adjoint_pairs`). One reverse pass serves any number of scalars.

The time step is that of the run: it is not differentiated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.gradients.adjoint import RecordedRun
from physworld.engine.gradients.adjoint_pairs import ForcePair, ForceSide
from physworld.engine.gradients.adjoint_reverse import Gradient
from physworld.engine.gradients.soft_grips_derivatives import SoftGripsChange, same_soft_grips
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.soft_grips import BoundSoftGrips, SoftGrips
from physworld.engine.terms.term import BoundTerm
from physworld.engine.total.forces import InternalForces
from physworld.engine.total.friction import FrictionForces
from physworld.engine.total.stress import BoundStress
from physworld.errors import NotDifferentiable


class Setting(Protocol):
    """What is integrated: :class:`physworld.twin.twin.Integration` is one."""

    @property
    def problem(self) -> Problem:
        """The body and what acts on it."""
        ...

    @property
    def velocity(self) -> Array:
        """Nodal velocities at the first time [m/s], (n, 3)."""
        ...

    @property
    def held(self) -> HeldNodes:
        """Prescribed nodes and their paths."""
        ...


@dataclass(frozen=True)
class Direction:
    """Two neighbours of a run along a scalar, ``width`` of it apart."""

    high: Setting
    low: Setting
    width: float


def gradients(
    run: RecordedRun, seed: Array, directions: Mapping[str, Direction]
) -> tuple[Gradient, dict[str, float]]:
    """Derivatives of a scalar L of a run by everything, and by each of the scalars.

    Args:
        run: the run.
        seed: dL/dx at the frames, (T, n, 3).
        directions: neighbours of the run by the name of the scalar.

    Raises:
        NotDifferentiable: a scalar changes what nodes are held, or has memory that the run does not have.
    """
    bound = run.bound_terms
    compared = {
        name: _Comparison(run.problem, bound, d, run.solver.relaxed) for name, d in directions.items()
    }
    pairs = [comparison.pair for comparison in compared.values() if comparison.pair is not None]
    gradient = run.gradient(seed, pairs)
    works = iter(gradient.works)
    found = {}
    for name, comparison in compared.items():
        work = next(works) if comparison.pair is not None else 0.0
        found[name] = (comparison.host_share(gradient) + work) / directions[name].width
    return gradient, found


class _Comparison:
    """One scalar's two neighbours, told apart by where they differ."""

    def __init__(
        self, base: Problem, terms: tuple[BoundTerm, ...], direction: Direction, relaxed: bool
    ) -> None:
        self._base, self._d = base, direction
        high, low = direction.high.problem, direction.low.problem
        if not np.array_equal(direction.high.held.nodes, direction.low.held.nodes):
            raise NotDifferentiable(
                f"{len(direction.high.held.nodes)} nodes are held on one side and {len(direction.low.held.nodes)} on "
                "the other: holding nodes is not smooth"
            )
        self._soft = same_soft_grips((base, high, low))[1:]
        self._by_columns = _moduli_alone_differ(base, high, low)
        self._stresses: list[tuple[int, Array, Array]] = []
        sides = self._matched(terms, high, low)
        grows = any(_multiplies(term) for side in sides for _, term in side)
        launched = grows or not (self._by_columns or same_internal_forces(high, low))
        if launched:
            self._by_columns = False
        if launched and not grows and terms and _multiplies(terms[0]):
            sides = (
                ((0, high.terms[0].bind(high)), *sides[0]),
                ((0, low.terms[0].bind(low)), *sides[1]),
            )
        self.pair: ForcePair | None = None
        springs = self._springs(terms)
        if launched or any(sides) or springs is not None:
            self.pair = ForcePair(
                _side(high, sides[0], launched, relaxed), _side(low, sides[1], launched, relaxed), springs
            )

    def _springs(self, terms: tuple[BoundTerm, ...]) -> SoftGripsChange | None:
        """How the stiffness of soft grips differs."""
        if not self._soft:
            return None
        change = self._soft[0].stiffness - self._soft[1].stiffness
        own = next(term for term in terms if isinstance(term, BoundSoftGrips))
        return SoftGripsChange(own, change) if np.any(change) else None

    def host_share(self, g: Gradient) -> float:
        """Derivatives by arrays times the arrays' differences."""
        high, low = self._d.high, self._d.low
        p, q = high.problem, low.problem
        total = float(g.gravity @ (np.asarray(p.gravity_m_s2) - np.asarray(q.gravity_m_s2)))
        total += g.drag * (p.drag_per_s - q.drag_per_s)
        total += float(np.sum(g.v * (high.velocity - low.velocity)))
        total += float(np.sum(g.held_positions * (high.held.positions - low.held.positions)))
        total += float(np.sum(g.held_velocities * (high.held.velocities - low.held.velocities)))
        total += float(g.mass @ (p.nodal_mass() - q.nodal_mass()))
        if g.soft_grips is not None:
            total += g.soft_grips.along(*(grips.held for grips in self._soft))
        if self._by_columns:
            base = self._base.law.columns.values()
            change = np.array([*p.law.columns.values()]) - np.array([*q.law.columns.values()])
            for column, value, step in zip(g.law.T, base, change, strict=True):
                if step != 0.0:
                    total += float(column.sum()) * step / value
            factors = [
                np.zeros(len(g.law)) if s.stiffness_factor is None else np.log(s.stiffness_factor)
                for s in (p, q)
            ]
            total += float((g.log_stiffness - g.twist) @ (factors[0] - factors[1]))  # twist is launched
        for place, numbers, fields in self._stresses:
            bars = g.stresses[place]
            assert bars is not None
            total += float(bars[0] @ numbers) + float(np.sum(bars[1] * fields))
        return total

    def _matched(
        self, terms: tuple[BoundTerm, ...], high: Problem, low: Problem
    ) -> tuple[tuple[tuple[int | None, BoundTerm], ...], tuple[tuple[int | None, BoundTerm], ...]]:
        """Terms whose forces differ, each with its place in the run; stresses go by their numbers where they can."""
        terms = tuple(t for t in terms if not isinstance(t, BoundSoftGrips))  # last; by their own gradient
        bound = tuple([t.bind(p) for t in p.terms if not isinstance(t, SoftGrips)] for p in (high, low))
        kinds = [[_kind(t) for t in side] for side in (terms, *bound)]
        lists: tuple[list[tuple[int | None, BoundTerm]], ...] = ([], [])
        if kinds[0] == kinds[1] == kinds[2]:
            for place, (known, one, two) in enumerate(zip(terms, *bound, strict=True)):
                if isinstance(known, BoundStress) and _same_numbers(one.inputs[:-2], two.inputs[:-2]):
                    fields = one.fields.numpy().astype(float) - two.fields.numpy()
                    if self._by_columns:  # the stiffness factor in the first field is in log_stiffness
                        fields[: len(fields) // (len(fields) // high.lattice.fill.size)] = 0.0
                    fields = fields.reshape(-1, high.lattice.fill.size)
                    self._stresses.append(
                        (place, one.numbers.numpy().astype(float) - two.numbers.numpy(), fields)
                    )
                elif not _same_term(one, two):
                    lists[0].append((place, one))
                    lists[1].append((place, two))
            return tuple(lists[0]), tuple(lists[1])
        for side, others, mine in ((bound[0], bound[1], lists[0]), (bound[1], bound[0], lists[1])):
            for term in side:
                if any(_kind(term) == _kind(other) and _same_term(term, other) for other in others):
                    continue
                if getattr(term, "memory", ()):
                    raise NotDifferentiable(
                        f"a {type(term).__name__} with memory that the run does not have: give the run a small strength"
                    )
                mine.append((None, term))
        return tuple(lists[0]), tuple(lists[1])


def _multiplies(term: BoundTerm) -> bool:
    return getattr(term, "multiplies", False)


def _kind(term: BoundTerm) -> Any:
    return id(term.model) if isinstance(term, BoundStress) else type(term)


def _same_term(one: BoundTerm, two: BoundTerm) -> bool:
    """Whether two bound terms of a kind have equal numbers throughout."""
    first, second = vars(one), vars(two)
    skipped = {"frequency_rad_s", "friction_per_s", "memory", "state", "times"}
    return all(_same(first[name], second[name]) for name in first if name not in skipped)


def _same_numbers(one: list[Any], two: list[Any]) -> bool:
    return len(one) == len(two) and all(_same(a, b) for a, b in zip(one, two, strict=True))


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, wp.array):
        return a.shape == b.shape and np.array_equal(a.numpy(), b.numpy())
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, list | tuple):
        return _same_numbers(list(a), list(b))
    if hasattr(a, "__dict__") and type(a).__module__.startswith("physworld"):
        return type(a) is type(b) and all(_same(v, vars(b).get(k)) for k, v in vars(a).items())
    return bool(np.all(a == b))


def _side(
    problem: Problem, terms: tuple[tuple[int | None, BoundTerm], ...], launched: bool, relaxed: bool
) -> ForceSide:
    """One side of a pair: with internal forces if they are ``launched``, their friction apart if it is ``relaxed``."""
    if not launched:
        return ForceSide(None, terms)
    if not relaxed:
        return ForceSide(internal_forces(problem), terms)
    calm = replace(problem, law=problem.law.without_friction())
    friction = None
    if problem.law.friction_law is not None:
        factor = _factor(problem)
        friction = FrictionForces(problem.lattice, problem.law, factor, problem.rest, problem.device)
    return ForceSide(internal_forces(calm), terms, friction)


def internal_forces(problem: Problem) -> InternalForces:
    """Internal forces of a problem, with a memory of their own."""
    return InternalForces(problem.lattice, problem.law, _factor(problem), problem.rest, problem.device)


def _same_lattice(one: Problem, two: Problem) -> bool:
    a, b = one.lattice, two.lattice
    return a is b or (np.array_equal(a.spacing, b.spacing) and np.array_equal(one.rest, two.rest))


def _moduli_alone_differ(base: Problem, high: Problem, low: Problem) -> bool:
    """Whether internal forces differ by moduli, friction and stiffness field alone, all of them open in the run."""
    if not (_same_lattice(high, low) and high.law.shape == low.law.shape == base.law.shape):
        return False
    values = zip(*(p.law.columns.values() for p in (base, high, low)), strict=True)
    return all(a == b or known != 0.0 for known, a, b in values)


def same_internal_forces(high: Problem, low: Problem) -> bool:
    """Whether two problems have the same internal forces."""
    return (
        _same_lattice(high, low)
        and high.law.columns == low.law.columns
        and high.law.shape == low.law.shape
        and np.array_equal(_factor(high), _factor(low))
    )


def _factor(problem: Problem) -> Array:
    known = problem.stiffness_factor
    return np.ones(problem.lattice.fill.size) if known is None else known
