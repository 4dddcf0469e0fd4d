"""What a verification case is, and the bodies that they share.

A case runs the engine at several resolutions and returns one error each. Its *order* is the slope of log error against
log step; where the closed form is itself an idealisation of the body (beam theory of a solid), it is the order at which
successive results approach each other (Richardson), and the limit's distance from theory is stated apart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import curve_fit

from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.total.formulation import TotalLagrangian
from physworld.materials.laws import Law

GRAVITY = np.array([0.0, 0.0, -9.81])
CLAMP_REACH = 0.5 / np.sqrt(3.0)
"""Cells by which a held layer of splines acts beyond its face; see ``physworld/geometry/reference.py``."""
ROUND_OFF = 1e-6
"""Errors below this are rounding: no order is stated."""


@dataclass(frozen=True)
class Case:
    """One thing that is verified.

    Attributes:
        name: stable key.
        title: what is measured.
        theory: against what.
        refined: what is refined: "dx" (with dt), "dt".
        steps: resolutions, coarse to fine, the argument of ``error``.
        error: resolution to signed error, relative unless the title says otherwise.
        size: resolution to step size, up to a factor; None for 1 / resolution.
        limit: bound on the error at the finest resolution (of the limit, where ``exact`` is False).
        least_order: smallest order that is right; None where the error is rounding.
        exact: False where the closed form idealises.
        quick: how many resolutions a quick run takes.
        no_order: why none is stated, where ``least_order`` is None.
    """

    name: str
    title: str
    theory: str
    refined: str
    steps: tuple[float, ...]
    error: Callable[[float], float]
    limit: float
    least_order: float | None = None
    exact: bool = True
    size: Callable[[float], float] | None = None
    quick: int = 2
    no_order: str = "rounding"


@dataclass(frozen=True)
class Outcome:
    """A case that was run.

    Attributes:
        case: which.
        steps, errors: resolutions and errors.
        order: observed, or None where the errors are rounding or too few.
        extrapolated: error of the limit, where the case is not exact and has three resolutions.
    """

    case: Case
    steps: tuple[float, ...]
    errors: tuple[float, ...]
    order: float | None
    extrapolated: float | None

    @property
    def final(self) -> float:
        """The error that the case's limit bounds."""
        return self.errors[-1] if self.extrapolated is None else self.extrapolated

    @property
    def allowed(self) -> float:
        """The case's limit, scaled by its order where a quick run stopped at a coarser step."""
        case = self.case
        if case.least_order is None or self.extrapolated is not None:
            return case.limit
        size = case.size or (lambda step: 1.0 / step)
        return case.limit * (size(self.steps[-1]) / size(case.steps[-1])) ** max(case.least_order, 2.0)

    @property
    def passed(self) -> bool:
        """Error and order are as good as the case wants."""
        least = self.case.least_order
        return abs(self.final) <= self.allowed and (
            least is None or self.order is None or self.order >= least
        )


def run_case(case: Case, quick: bool = False) -> Outcome:
    """Run a case at all its resolutions, or at its coarsest ones."""
    steps = case.steps[: case.quick] if quick else case.steps
    errors = tuple(float(case.error(step)) for step in steps)
    size = case.size or (lambda step: 1.0 / step)
    sizes = np.array([size(step) for step in steps])
    order, extrapolated = observed_order(sizes, np.array(errors), case.exact)
    return Outcome(case, steps, errors, order, extrapolated)


def observed_order(
    sizes: np.ndarray, errors: np.ndarray, exact: bool = True
) -> tuple[float | None, float | None]:
    """Order of convergence and, where theory is not exact, the limit's error.

    Args:
        sizes: step sizes, coarse to fine; of constant ratio where ``exact`` is False.
        errors: signed errors against theory.
        exact: whether the errors go to zero.
    """
    if len(errors) < 2 or np.abs(errors).max() < ROUND_OFF:
        return None, None
    if exact:
        if np.any(errors == 0):
            return None, None
        return float(np.polyfit(np.log(sizes), np.log(np.abs(errors)), 1)[0]), None
    if len(errors) < 3:
        return None, None
    before, after = errors[-3] - errors[-2], errors[-2] - errors[-1]
    if before * after <= 0:
        return None, float(errors[-1])
    ratio = sizes[-2] / sizes[-1]
    order = float(np.log(before / after) / np.log(ratio))
    return order, float(errors[-1] - after / (ratio**order - 1))


def clamped_lattice(
    free: float, sections: Sequence[float], counts: Sequence[int], reach: float = 0.0
) -> Lattice:
    """A box along the first axis, one gripped cell at its low end, whose clamp is at 0 and free end at ``free`` [m].

    ``counts`` are the free cells; ``reach`` moves the gripped cell's face that share of a cell into the clamp.
    """
    dx = free / (counts[0] - reach)
    low = np.array([-(1.0 + reach) * dx, *(0.0 for _ in sections)])
    return box_lattice(low, np.array([free - low[0], *sections]), (counts[0] + 1, *counts[1:]))


def rest_nodes(lattice: Lattice) -> np.ndarray:
    """Nodes of the undeformed body along the world's first axes, (n, 3)."""
    rest = np.zeros((len(lattice.nodes), 3))
    rest[:, : lattice.dim] = lattice.node_coordinates
    return rest


def hold(nodes: np.ndarray, rest: np.ndarray, frames: int) -> HeldNodes:
    """Nodes that stay where they are."""
    positions = np.repeat(rest[nodes][None], frames, axis=0)
    return HeldNodes(nodes, positions, np.zeros_like(positions))


def gripped(lattice: Lattice) -> np.ndarray:
    """Nodes that the first layer of cells touches."""
    return np.unique(lattice.cell_nodes[lattice.cells[:, 0] < 1])


def nowhere() -> np.ndarray:
    """No nodes."""
    return np.empty(0, dtype=int)


def run(
    lattice: Lattice,
    law: Law,
    times: np.ndarray,
    held: np.ndarray,
    *,
    gravity: np.ndarray = GRAVITY,
    start: np.ndarray | None = None,
    velocity: np.ndarray | None = None,
    time_step_s: float | None = None,
    **problem: object,
) -> np.ndarray:
    """Nodes over time (T, n, 3) from the undeformed shape at rest, or from ``start`` and ``velocity`` (n, 3)."""
    rest = rest_nodes(lattice)
    first = rest if start is None else start
    solver = TotalLagrangian(Problem(lattice, law, rest, gravity, **problem), time_step_s)  # type: ignore[arg-type]
    speed = np.zeros_like(rest) if velocity is None else velocity
    return solver.run(first, speed, hold(held, first, len(times)), times)


def path(lattice: Lattice, nodes: np.ndarray, coordinates: Sequence[float]) -> np.ndarray:
    """Path (T, 3) of one material point."""
    row = lattice.interpolation(np.array([coordinates]))
    return np.asarray(row @ nodes.transpose(1, 0, 2).reshape(nodes.shape[1], -1)).reshape(-1, 3)


def ringing(times: np.ndarray, signal: np.ndarray, guess: float) -> tuple[float, float, float]:
    """Mean, angular frequency [rad/s] and decay rate [1/s] of a damped cosine through ``signal`` (T,)."""
    mean, size = float(signal.mean()), float(np.ptp(signal)) / 2
    best: tuple[float, np.ndarray] | None = None
    for phase in (0.0, np.pi / 2, np.pi, -np.pi / 2):
        found, _ = curve_fit(
            lambda t, m, a, w, d, p: m + a * np.cos(w * t + p) * np.exp(-d * t),
            times, signal, [mean, size, guess, 0.0, phase], maxfev=20000,
        )  # fmt: skip
        fit = found[0] + found[1] * np.cos(found[2] * times + found[4]) * np.exp(-found[3] * times)
        misfit = float(np.sum((fit - signal) ** 2))
        if best is None or misfit < best[0]:
            best = misfit, found
    assert best is not None
    return float(best[1][0]), float(abs(best[1][2])), float(best[1][3])
