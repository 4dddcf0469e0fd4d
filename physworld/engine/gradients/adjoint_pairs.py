"""What a scalar does to the forces: two neighbouring ways of forces, launched beside the reverse pass.

For a scalar theta that enters the forces in whatever way, the share of its derivative that goes through the forces of a
run is the sum over substeps of w . (f(theta_high) - f(theta_low)) / (theta_high - theta_low), with w the derivative by
the forces and both at the positions, velocities and memories of the run itself. Memories that the two leave behind
count with the derivative by them.
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from physworld.arrays import Array
from physworld.engine.gradients.adjoint_kernels import add_memory_work, add_work, load_row
from physworld.engine.gradients.adjoint_terms import Memory, Reverse, flat
from physworld.engine.gradients.soft_grips_derivatives import SoftGripsChange
from physworld.engine.terms.term import BoundTerm
from physworld.engine.total.forces import InternalForces
from physworld.engine.total.friction import FrictionForces


@dataclass(frozen=True)
class ForceSide:
    """One of the two.

    Attributes:
        internal: internal forces, or None where they do not change.
        friction: that part of them which the run takes in stages, likewise; ``internal`` is without it then.
        terms: those that change, each with its place among the terms of the run (None: the run has none like it).
    """

    internal: InternalForces | None
    terms: tuple[tuple[int | None, BoundTerm], ...]
    friction: FrictionForces | None = None


class ForcePair:
    """High and low side; ``work`` is the derivative of L along high - low after a reverse pass.

    ``springs`` is the change of the stiffness of grips that hold softly.
    """

    def __init__(self, high: ForceSide, low: ForceSide, springs: SoftGripsChange | None = None) -> None:
        self._sides, self._springs = (high, low), springs

    def prepare(self, now: Reverse, x_previous: wp.array, times: Array, memories: list[list[Memory]]) -> None:
        """Take the arrays of a reverse pass.

        Args:
            now: its state and derivatives.
            x_previous: nodal positions of the substep before [m], (3n,).
            times: frames of the run, (T,) [s].
            memories: of the run's terms, as they were in every substep.
        """
        self._now, self._x_previous, self._memories = now, x_previous, memories
        self._forces = [wp.zeros_like(now.x) for _ in self._sides]
        self._scratch = wp.zeros_like(now.x)
        self._total = wp.zeros_like(now.mass_bar)
        for side in self._sides:
            for _, term in side.terms:
                term.begin(times)
        self._flat = [
            [[flat(array) for array in getattr(term, "memory", ())] for _, term in side.terms]
            for side in self._sides
        ]

    @property
    def work(self) -> float:
        """Sum over the substeps that were taken back."""
        return float(self._total.numpy().sum())

    def prepare_friction(self) -> None:
        """Friction is that at the positions of this substep from now on."""
        for side in self._sides:
            if side.friction is not None:
                side.friction.prepare(self._now.x)

    def add_friction_work(self, y: wp.array, u: wp.array) -> None:
        """One stage: friction at the velocities ``y`` (3n,) [m/s], with ``u`` (3n,) the derivatives by its forces."""
        if all(side.friction is None for side in self._sides):
            return
        for side, force in zip(self._sides, self._forces, strict=True):
            if side.friction is not None:
                side.friction.launch(y, force)
        outputs = [*self._forces, self._total]
        wp.launch(add_work, dim=len(self._total), inputs=[u], outputs=outputs, device=y.device)

    def add_work(self) -> None:
        """One substep; part of the captured graph, before the derivatives by memories are taken back."""
        now = self._now
        for side, force, memories in zip(self._sides, self._forces, self._flat, strict=True):
            if side.internal is not None:
                side.internal.launch(self._x_previous, now.clock, self._scratch)  # friction remembers these
                side.internal.launch(now.x, now.clock, force)
            for (place, term), arrays in zip(side.terms, memories, strict=True):
                if place is not None:
                    for memory, array in zip(self._memories[place], arrays, strict=True):
                        wp.launch(
                            load_row, dim=len(array), inputs=[now.offset, now.counter, memory.rows],
                            outputs=[array], device=array.device,
                        )  # fmt: skip
                term.launch(now.x, now.v, now.clock, now.counter, force)
        if self._springs is not None:
            self._springs.add(now, self._forces[0])
        wp.launch(
            add_work, dim=len(self._total), inputs=[now.force_bar],
            outputs=[*self._forces, self._total], device=now.x.device,
        )  # fmt: skip
        for number, (place, _) in enumerate(self._sides[0].terms):
            if place is None:
                continue
            for k, memory in enumerate(self._memories[place]):
                arrays = [side[number][k] for side in self._flat]
                wp.launch(
                    add_memory_work, dim=len(memory.bar), inputs=[memory.bar, *arrays], outputs=[self._total],
                    device=now.x.device,
                )  # fmt: skip
