"""Forces beside a body's own: what a contact or an effect adds to the nodes every substep.

A :class:`Term` is a description; :meth:`Term.bind` gives it device arrays for one problem. Its launches are part of
the captured graph, so a bound term allocates its arrays once and keeps them.

A term with memory (relaxation, plastic strain) starts afresh where the counter reads frame 0, substep 0: one bound
term serves any number of runs.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Protocol

import warp as wp

from physworld.arrays import Array
from physworld.errors import NotDifferentiable

if TYPE_CHECKING:
    from physworld.engine.problem import Problem


class BoundTerm(Protocol):
    """A term whose arrays live on a device.

    Attributes:
        frequency_rad_s: what the term adds to the fastest mode, sqrt of stiffness over mass (0 for none). Squares of
            frequencies add up in the stable time step.
        friction_per_s: fastest damping rate that it adds (0 for none). Rates add up in the stable time step.
        memory: arrays that one substep leaves for the next; a gradient keeps and restores them.
        differentiable: whether gradients may pass through it.
        multiplies: scales the internal forces instead of adding to them; such a term comes first.
    """

    frequency_rad_s: float = 0.0
    friction_per_s: float = 0.0
    memory: tuple[wp.array, ...] = ()
    differentiable: bool = True
    multiplies: bool = False

    def begin(self, times: Array) -> None:
        """A run over the frames ``times`` (T,) [s] starts: for terms that need the absolute time. May raise."""
        return None

    def pace(self, time_step_s: float) -> None:
        """Substeps have this length [s] from now on: for terms that are implicit."""
        return None

    def check(self, time_s: float) -> None:
        """A frame ended at ``time_s``: raises a :class:`physworld.errors.SimulationError` if it cannot be trusted."""
        return None

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the forces of one substep.

        Args:
            x, v: nodal positions [m] and velocities [m/s], (3n,) float64.
            clock: (frame interval [s], 1/dt [1/s], dt [s]) float64.
            counter: (frame, substep, substeps) int32.
            force: forces [N], to be added to, (3n,) float64.
        """
        ...


class Term(Protocol):
    """Something that acts on the nodes of a problem."""

    def bind(self, problem: Problem) -> BoundTerm:
        """Device arrays for this problem; called once for each formulation that integrates it."""
        ...


def refuse_undifferentiable(terms: Iterable[BoundTerm]) -> None:
    """Whether gradients may pass through all of these terms.

    Raises:
        NotDifferentiable: they may not through one of them.
    """
    for number, term in enumerate(terms):
        if not getattr(term, "differentiable", True):
            raise NotDifferentiable(
                f"term {number}, {type(term).__name__.removeprefix('Bound')}, has no derivative: fit by "
                "simulations alone, or leave it out"
            )
