"""Several recordings of one rod in one search: the numbers of the object, and each recording's own rest shape."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.calibrate.parameters import Parameter
from physworld.calibrate.recordings import SAYS_NOTHING, Agreement, agreement_of, of_recording, twin_at
from physworld.calibrate.rod_parameters import DRIVE, SHAPE
from physworld.calibrate.rod_search import RodSearch, off_priors
from physworld.engine.rods.chain import Chain
from physworld.errors import SceneUnsupported
from physworld.twin.twin import Twin


class SharedRodSearch(RodSearch):
    """Launches of a calibration over several recordings; one of every recording counts as one: see :class:`RodSearch`.

    Residuals stand one recording after the other, each in the deviations that its model leaves and that frames which
    err alike leave: ``sigma`` and ``together`` are 1.
    """

    def __init__(self, parts: Sequence[RodSearch]) -> None:
        """``parts``: the recordings' own searches, the one that leads first."""
        lead = parts[0]
        super().__init__(lead.scene, lead.twin, lead.limit, lead.progress, lead.cancelled)
        self.parts, self.sigma, self.together = list(parts), 1.0, 1.0
        ends = zip(*(part.windows for part in parts), strict=True)
        self._ends = {own[0]: own for own in ends}

    @property
    def left(self) -> Any:
        """Of every recording what the model leaves [m]."""
        return [part.sigma for part in self.parts]

    @left.setter
    def left(self, left: Any) -> None:
        for part, sigma in zip(self.parts, left, strict=True):
            part.sigma = sigma

    def settle(self, unknowns: Sequence[Parameter], theta: Array, end: int) -> None:
        """Take what the model leaves of every recording: see :meth:`RodSearch.settle`."""
        for k, (part, last) in enumerate(zip(self.parts, self._ends[end], strict=True)):
            places = of_recording(unknowns, k)
            part.settle([unknowns[p] for p in places], theta[places], last)
        self.simulations += 1

    def launched(
        self, unknowns: Sequence[Parameter], places: Sequence[Array], end: int
    ) -> list[Array | None]:
        """Weighted residuals of all recordings at places (p,); None where one of them cannot be trusted."""
        self.simulations += 1
        found = []
        for k, (part, last) in enumerate(zip(self.parts, self._ends[end], strict=True)):
            weight = 1.0 / (part.sigma * np.sqrt(part.together))
            twins = [twin_at(part.twin, unknowns, place, k) for place in places]
            found.append([None if r is None else weight * r for r in part.residuals(twins, last)])
        return [
            np.concatenate([r for r in several if r is not None])
            if all(r is not None for r in several)
            else None
            for several in zip(*found, strict=True)
        ]

    def rms(self, residual: Array, end: int) -> float:
        """Root mean square [m] of weighted residuals."""
        squares = [
            part.sigma**2 * part.together * float(np.sum(residual[rows] ** 2))
            for part, rows in zip(self.parts, self._rows(end), strict=True)
        ]
        return float(np.sqrt(sum(squares) / len(residual)))

    def agreement(
        self, unknowns: Sequence[Parameter], theta: Array, residual: Array, jacobian: Array
    ) -> tuple[Agreement, ...]:
        """Whether the recordings agree on the object's numbers: see :meth:`RodSearch.agreement`."""
        _, prior = off_priors(unknowns, theta)
        shifted = []
        for k, rows in enumerate(self._rows(self.end)):
            places = of_recording(unknowns, k)
            slope = jacobian[rows][:, places]
            covariance = np.linalg.inv(slope.T @ slope + np.diag(prior[places] ** 2))
            shift = -covariance @ slope.T @ residual[rows]
            deviation = np.sqrt(np.diag(covariance))
            deviation[deviation * prior[places] > SAYS_NOTHING] = np.inf
            shifted.append((places, shift, deviation))
        return agreement_of(unknowns, theta, shifted)

    def _rows(self, end: int) -> list[slice]:
        """Where the residuals of every recording stand."""
        counts = [
            3 * int(part.scene.visible[1:last].sum())
            for part, last in zip(self.parts, self._ends[end], strict=True)
        ]
        edges = np.cumsum([0, *counts])
        return [slice(first, last) for first, last in pairwise(edges)]


def require_alike(twins: Sequence[Twin]) -> None:
    """Raises SceneUnsupported where recordings of a branched rod have other points: what a branch has is its edges'."""
    lattices = [twin.lattice for twin in twins if isinstance(twin.lattice, Chain)]
    branched = any(len(lattice.branches) for lattice in lattices)
    if branched and any(not np.array_equal(lattices[0].parent, lattice.parent) for lattice in lattices):
        counts = ", ".join(str(len(lattice.parent)) for lattice in lattices)
        raise SceneUnsupported(
            f"recordings of one branched rod have the same points along it; these have {counts} nodes"
        )


def of_a_recording(name: str) -> bool:
    """Whether a number belongs to its recording: how the rod lay and was gripped, and what drives it from inside."""
    branch_stands = name.startswith("branch_") and "_angle_" in name
    return branch_stands or name.startswith((*SHAPE, DRIVE))
