"""A clamp that holds more or less than declared, or at another angle.

    reach r > 0   the clamp goes r farther over the body: cells that it covers whole are held, in a cell that it
                  covers by a share the compliance falls by that share (to a quarter at most)
    reach r < 0   it lets go of |r|: the first free cell gives way as a cell that is |r| longer, 1 + |r| / dx
    angle         held material is turned about the grip's middle by a rotation vector in the undeformed body's axes

The clamp's cells stay where the lattice has them, so the reach is continuous but not smooth: scan it. A turn acts from
the first frame on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from physworld.arrays import Array
from physworld.effects.base import Calibrated, Effect, Strength, Variant
from physworld.effects.places import body_size, held_count
from physworld.engine.problem import Problem

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_LEAST_COMPLIANCE = 0.25
_STEP, _SPREAD = 0.25, 0.5  # cells: difference step, and deviation of what is known beforehand
REACH = "clamp_offset.reach_m"


@dataclass(frozen=True)
class ClampOffset(Effect):
    """``reach_m``: r; ``angle_x_rad`` …: rotation vector of the grip."""

    name = "clamp_offset"
    title = "reach and angle of the clamp"
    equation = "free length L - r; held material turned"
    kind = "boundary"
    gates = ("reach_m", "angle_x_rad", "angle_y_rad", "angle_z_rad")
    instead = "measure where the clamp's face is"

    reach_m: float = 0.0
    angle_x_rad: float = 0.0
    angle_y_rad: float = 0.0
    angle_z_rad: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Two cells or the thickness either way, a fifth of the body at most; angles up to 0.2 rad."""
        cell = float(twin.lattice.spacing.max())
        most = min(max(2.0 * cell, 2.0 * twin.body.half_thickness_m), 0.2 * body_size(twin))
        return (
            Strength("reach_m", "m", -most, most, 0.25 * min(cell, most)),
            *(Strength(f"angle_{axis}_rad", "rad", -0.2, 0.2, 0.005) for axis in "xyz"),
        )

    @classmethod
    def variants(cls, twin: Twin) -> list[Variant]:
        """Angles; the reach only where grips prescribe nodes: a reach within a cell is what softness is."""
        angles = Variant(("angle_x_rad", "angle_y_rad", "angle_z_rad"), "angle_x_rad")
        reach = [Variant(("reach_m",), "reach_m")] if twin.grip_softness == 0 else []
        return [*reach, angles]

    @classmethod
    def calibrated(cls, twin: Twin) -> Calibrated | None:
        """How far clamps hold, within a cell; of soft grips that is their softness, a mesh's lines lie on the faces.

        Within its thickness for a body thicker than its cells: what it does next to a clamp no plate and no rod does.
        """
        if twin.grip_softness > 0 or not twin.lattice.smooth or cls.refuses(twin) is not None:
            return None
        cell = max(float(twin.lattice.spacing.max()), 2.0 * twin.body.half_thickness_m)
        reach = next(s for s in cls.strengths(twin) if s.name == "reach_m")
        within = replace(reach, low=max(reach.low, -cell), high=min(reach.high, cell))
        return Calibrated(within, _STEP * cell, _SPREAD * cell)

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """A body that nobody holds, or that is held all over."""
        held = held_count(twin)
        if held == 0:
            return f"{held} nodes are held: no clamp"
        clamped = _held_cells(twin)
        if not clamped.any():
            return f"{held} nodes are held but no cell by half: the clamp has no face"
        free = int((~clamped).sum())
        return f"{free} cells are free: no room for a longer clamp" if free == 0 else None

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Stiffens or softens the material next to the clamp."""
        if self.reach_m == 0:
            return problem
        gap, cell = _gaps(twin)
        if self.reach_m > 0:
            covered = np.clip((self.reach_m - gap) / (0.5 * cell), 0.0, 1.0)
            factor = 1.0 / np.maximum(1.0 - covered, _LEAST_COMPLIANCE)
        else:
            factor = np.where((gap >= 0) & (gap < 0.75 * cell), 1.0 / (1.0 - self.reach_m / cell), 1.0)
        known = 1.0 if problem.stiffness_factor is None else problem.stiffness_factor
        return replace(problem, stiffness_factor=known * factor)

    def grips(self, twin: Twin) -> Twin:
        """Turns what is held and adds what a longer clamp covers, each node to the nearest grip."""
        start = twin.body.start.copy()
        turn = Rotation.from_rotvec([self.angle_x_rad, self.angle_y_rad, self.angle_z_rad])
        extra = _covered_nodes(twin, self.reach_m)
        tree = cKDTree(np.concatenate([twin.body.start[own] for own in twin.held_nodes]))
        owner = np.repeat(np.arange(len(twin.held_nodes)), [len(own) for own in twin.held_nodes])
        nearest = owner[tree.query(twin.body.start[extra])[1]] if len(extra) else np.empty(0, dtype=int)
        held = []
        for group, own in enumerate(twin.held_nodes):
            nodes = np.concatenate([own, extra[nearest == group]])
            if len(own):
                middle = twin.body.start[own].mean(axis=0)
                start[nodes] = middle + turn.apply(twin.body.start[nodes] - middle)
            held.append(nodes)
        return replace(twin, held_nodes=tuple(held), body=replace(twin.body, start=start))


def _held_cells(twin: Twin) -> Array:
    """Cells all of whose nodes are held, (C,) bool; where a clamp ends within the first cell, those that are half held.

    A clamp that is known by a few points near the body's face holds the nodes about them and no cell whole.
    """
    held = np.zeros(len(twin.lattice.nodes), dtype=bool)
    for nodes in twin.held_nodes:
        held[nodes] = True
    share = held[twin.lattice.cell_nodes].mean(axis=1)
    clamped: Array = share == 1.0 if np.any(share == 1.0) else share >= 0.5
    return clamped


def _gaps(twin: Twin) -> tuple[Array, float]:
    """Length of free material between the clamp and every particle's near edge [m], (P,), and the cell there [m].

    Particles stand for half a cell along the body each: 0 in the first half, dx/2 in the second, and so on.
    """
    lattice = twin.lattice
    inside = np.repeat(_held_cells(twin), lattice.fill.shape[1])
    places = lattice.particle_coordinates / lattice.spacing
    reach, nearest = cKDTree(places[inside]).query(places[~inside])
    step = np.abs(places[~inside] - places[inside][nearest])
    axis = int(np.bincount(np.argmax(step, axis=1), minlength=lattice.dim).argmax())
    cell = float(lattice.spacing[axis])
    gap = np.full(len(places), -np.inf)
    gap[~inside] = 0.5 * cell * (np.round(2.0 * reach) - 1.0)
    return gap, cell


def _covered_nodes(twin: Twin, reach: float) -> Array:
    if reach <= 0:
        return np.empty(0, dtype=int)
    gap, cell = _gaps(twin)
    whole = (gap + 0.5 * cell <= reach + 1e-12).reshape(twin.lattice.fill.shape).all(axis=1)
    held = np.concatenate(twin.held_nodes)
    return np.setdiff1d(np.unique(twin.lattice.cell_nodes[whole]), held)
