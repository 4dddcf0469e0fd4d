"""The box of grid nodes around a moving body: placed on an unbounded lattice, moved and resized as the body moves.

The nodes' places in space never change, only which of them exist, so moving the box changes no result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.errors import ParticlesLeftTheGrid, UnstableSimulation

MAX_NODES = 4_000_000
_SPARE_CELLS = 1  # beyond the rim: a box is moved when a particle enters the rim
_GROWTH = 1.5


@dataclass(frozen=True)
class GridLattice:
    """All places that a node may have: ``origin`` is a corner of a cell [m], (3,), ``spacing`` the cell [m], (3,)."""

    origin: Array
    spacing: Array


class GridBox:
    """Nodes around the particles, with room for moves.

    Attributes:
        device_box: first cell (3), nodes (3), rim, as the kernels read it.
        nodes: how many nodes the allocated arrays hold.
    """

    def __init__(self, lattice: GridLattice, device: str) -> None:
        self._lattice = lattice
        self._device = device
        self.device_box = wp.zeros(7, dtype=wp.int32, device=device)
        self.nodes = 0
        self.counts = np.zeros(3, dtype=int)

    def enclose(self, x: Array, rim: int, time: float) -> bool:
        """Place the box around positions ``x`` (P, 3) [m] with ``rim`` cells to move into before the next look.

        Returns:
            whether the arrays must grow: the box has more nodes than ``nodes`` allowed so far.

        Raises:
            UnstableSimulation: a position is not finite.
            ParticlesLeftTheGrid: the box would need more than ``MAX_NODES`` nodes.
        """
        low, high = x.min(axis=0), x.max(axis=0)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            bad = int((~np.isfinite(x)).any(axis=1).sum())
            raise UnstableSimulation(f"{bad} of {len(x)} particles are not finite at t = {time:.4f} s")
        room = 1 + rim + _SPARE_CELLS
        first = np.floor((low - self._lattice.origin) / self._lattice.spacing) - room
        last = np.floor((high - self._lattice.origin) / self._lattice.spacing) + room
        counts = last - first + 1
        if np.prod(counts) > MAX_NODES or np.abs(first).max() > 2**30:
            raise ParticlesLeftTheGrid(
                f"the particles span {np.array2string(high - low, precision=3)} m at t = {time:.4f} s: "
                f"{np.prod(counts):.3g} grid nodes, more than {MAX_NODES}"
            )
        self.counts = counts.astype(int)
        self.device_box.assign(np.concatenate([first, counts, [rim]]).astype(np.int32))
        nodes = int(np.prod(self.counts))
        if nodes <= self.nodes:
            return False
        self.nodes = int(_GROWTH * nodes) if self.nodes else nodes
        return True
