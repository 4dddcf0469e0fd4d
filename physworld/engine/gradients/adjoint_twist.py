"""The reverse pass of twist: d(w . f)/dx, and w . f itself for the derivative by the torsional stiffness.

Twist forces are minus the gradient of an energy, so d(w . f)/dx is the change of the forces with the nodes along w,
found in closed form (:mod:`physworld.engine.thin.twist_kernels`). The angle of the last substep only counts turns:
nothing is differentiated through it. How the grips turn is given; a scalar that changes it is differenced as every
other term is (:mod:`physworld.engine.gradients.gradient`).
"""

from __future__ import annotations

import warp as wp

from physworld.arrays import Array
from physworld.engine.gradients.adjoint_terms import Memory, Reverse
from physworld.engine.thin.twist import BoundTwist
from physworld.engine.thin.twist_kernels import push_twisted_along, turn_spans_along


class TwistAdjoint:
    """One bound twist's reverse pass."""

    def __init__(self, term: BoundTwist, memories: list[Memory]) -> None:
        self._term, self._memories = term, memories
        points, device = len(term.span_of), term.device
        self._along_rate = wp.zeros(points, dtype=wp.vec3d, device=device)
        self._moment_rate = wp.zeros(term.spans, dtype=wp.float64, device=device)
        self._by_log_stiffness = wp.zeros(term.spans, dtype=wp.float64, device=device)

    @property
    def log_stiffness(self) -> Array:
        """Derivatives by the logarithms of the particles' stiffness, (P,): their sum is that by GJ's logarithm."""
        slopes: Array = self._by_log_stiffness.numpy() @ self._term.shares
        return slopes

    def take_back(self, now: Reverse) -> None:
        """Add the products to ``now.x_bar``."""
        term, state = self._term, self._term.state
        for memory in self._memories:
            memory.put_back(now.offset, now.counter)
        term.turn(now.x, now.clock, now.counter)
        rates = [self._along_rate, self._moment_rate]
        wp.launch(
            turn_spans_along, dim=term.spans,
            inputs=[term.begins, *term.rows, term.compliance, *state.geometry, state.moment, now.force_bar],
            outputs=[*rates, self._by_log_stiffness], device=term.device,
        )  # fmt: skip
        wp.launch(
            push_twisted_along, dim=len(term.span_of),
            inputs=[term.begins, term.span_of, *term.rows, *state.geometry, state.moment, *rates, now.force_bar],
            outputs=[now.x_bar], device=term.device,
        )  # fmt: skip
