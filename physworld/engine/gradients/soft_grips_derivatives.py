"""The reverse pass of soft grips; the formulas are in
:mod:`physworld.engine.gradients.soft_grips_derivative_kernels`.

The springs see the forces of everything else, for they are implicit. So a reverse pass takes them back before anything
else of a substep.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.gradients.adjoint_terms import Reverse
from physworld.engine.gradients.soft_grips_derivative_kernels import (
    gather_nodes,
    take_grips_back,
)
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.soft_grips import BoundSoftGrips, SoftGrips, distance_from_path, pull_to_path
from physworld.errors import NotDifferentiable


@dataclass(frozen=True)
class SoftGripsGradient:
    """Derivatives of a scalar L of a run by the paths of the nodes that soft grips hold, (T, k, 3)."""

    positions: Array
    velocities: Array

    def along(self, high: HeldNodes, low: HeldNodes) -> float:
        """Change of L from one neighbour's paths to another's."""
        total = float(np.sum(self.positions * (high.positions - low.positions)))
        return total + float(np.sum(self.velocities * (high.velocities - low.velocities)))


class SoftGripsAdjoint:
    """The reverse pass of one bound term of a run with ``frames`` frames."""

    def __init__(self, term: BoundSoftGrips, frames: int) -> None:
        count, device = term.pull.shape[0], term.device
        self._term, self._frames = term, frames
        self._own = wp.array(np.arange(count), dtype=wp.int32, device=device)
        self._minus_q = wp.zeros(3 * count, dtype=wp.float64, device=device)
        self._path_bars = [wp.zeros((frames, 3 * count), dtype=wp.float64, device=device) for _ in range(2)]

    def take_back(self, now: Reverse) -> None:
        """From the derivatives by all forces to those by the others'; before these are taken back."""
        term, count = self._term, len(self._own)
        nodes, mass, _, _, _, drag, width = term.model
        inputs = [nodes, width, now.force_bar]
        wp.launch(gather_nodes, dim=count, inputs=inputs, outputs=[term.gap], device=term.device)
        inputs = [self._own, term.pull, term.gap]
        wp.launch(pull_to_path, dim=count, inputs=inputs, outputs=[self._minus_q], device=term.device)
        wp.launch(
            take_grips_back, dim=count, inputs=[nodes, mass, drag, now.clock, now.counter, now.v, now.pull],
            outputs=[self._minus_q, now.force_bar, now.x_bar, now.v_bar, now.mass_bar, now.gravity_bar,
                     now.drag_bar, *self._path_bars],
            device=term.device,
        )  # fmt: skip

    def collected(self) -> SoftGripsGradient:
        """What the substeps that were taken back add up to."""
        return SoftGripsGradient(
            *(bar.numpy().reshape(self._frames, -1, 3).copy() for bar in self._path_bars)
        )


class SoftGripsChange:
    """What another stiffness of the springs does to the forces of a run, to be launched beside its reverse pass.

    Args:
        term: the run's.
        change: of the stiffness, (k, k) [N/m].
    """

    def __init__(self, term: BoundSoftGrips, change: Array) -> None:
        self._term = term
        self._change = wp.array(_padded(change, term), dtype=wp.float64, device=term.device)
        nodes, mass, *rest = term.model
        self._model = [nodes, wp.ones_like(mass), *rest]

    def add(self, now: Reverse, force: wp.array) -> None:
        """Add -dK r to ``force`` (3n,) [N], with ``now.force_bar`` the derivatives by the others' forces."""
        term, count = self._term, self._term.pull.shape[0]
        inputs = [*self._model, now.clock, now.counter, now.x, now.v, now.pull]
        wp.launch(distance_from_path, dim=count, inputs=inputs, outputs=[term.gap], device=term.device)
        inputs = [term.model[0], self._change, term.gap]
        wp.launch(pull_to_path, dim=count, inputs=inputs, outputs=[force], device=term.device)


def same_soft_grips(problems: Sequence[Problem]) -> list[SoftGrips]:
    """The soft grips of a run and its neighbours, one each; none where all gripped nodes are prescribed.

    Raises:
        NotDifferentiable: only some have them, or they hold other nodes.
    """
    found = [term for p in problems for term in p.terms if isinstance(term, SoftGrips)]
    if found and len(found) != len(problems):
        raise NotDifferentiable("a scalar changes whether grips hold softly")
    for other in found[1:]:
        if not np.array_equal(found[0].held.nodes, other.held.nodes):
            raise NotDifferentiable(
                f"a scalar changes which nodes grips hold softly: {len(found[0].held.nodes)} of the run, "
                f"{len(other.held.nodes)} beside it"
            )
    return found


def _padded(matrix: Array, term: BoundSoftGrips) -> Array:
    rows = np.zeros(term.pull.shape)
    rows[:, : len(matrix)] = matrix
    return rows
