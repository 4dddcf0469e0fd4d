"""Adhesion to the ground: a traction that pulls the surface down until it has come off.

    traction = Y max(0, 1 - gap / d) for gap > 0, Y below        (gap: height of the surface above the ground)

A linear cohesive law; its work per area is Y d / 2. The ground's own pressure and friction stay as they are. Where thin
bodies touch the ground, a sheet does with its area and a rod with its diameter times its length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from physworld.effects.base import Effect, Strength
from physworld.effects.ground_friction import no_ground
from physworld.effects.places import body_size, gravity_size
from physworld.engine.lattice.bspline import GAUSS_POINTS
from physworld.engine.problem import Problem
from physworld.engine.terms.contact import GroundContact, surface_points
from physworld.engine.terms.term import BoundTerm
from physworld.engine.total.node_kernels import weighted_sum
from physworld.engine.updated.terms import ParticleBody
from physworld.errors import SceneUnsupported

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@wp.kernel
def adhesion(
    # model
    row_start: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    area: wp.array[wp.float64],
    surface: wp.array[wp.float64],
    traction: wp.float64,
    reach: wp.float64,
    # in
    x: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Pull one surface point towards the ground."""
    point = wp.tid()
    here = weighted_sum(x, columns, weights, row_start[point], row_start[point + 1])
    gap = wp.max(here[2] - surface[point], wp.float64(0.0))
    if gap < reach:
        pull = traction * area[point] * (wp.float64(1.0) - gap / reach)
        for k in range(row_start[point], row_start[point + 1]):
            wp.atomic_add(force, 3 * columns[k] + 2, -weights[k] * pull)


@dataclass(frozen=True)
class AdhesionTerm:
    """Term of :class:`Adhesion` under a ground contact's points; ``width_m``: diameter of a rod, else 1."""

    ground: GroundContact
    traction_pa: float
    reach_m: float
    width_m: float

    def bind(self, problem: Problem) -> BoundAdhesion:
        """Device arrays."""
        points, areas = surface_points(problem.lattice)
        matrix, device = problem.lattice.interpolation(points), problem.device
        offsets = np.broadcast_to(self.ground.offsets, len(points))
        inputs = [
            wp.array(matrix.indptr, dtype=wp.int32, device=device),
            wp.array(matrix.indices, dtype=wp.int32, device=device),
            wp.array(matrix.data, dtype=wp.float64, device=device),
            wp.array(self.width_m * areas, dtype=wp.float64, device=device),
            wp.array(self.ground.height_m + offsets, dtype=wp.float64, device=device),
            wp.float64(self.traction_pa), wp.float64(self.reach_m),
        ]  # fmt: skip
        return BoundAdhesion(len(points), inputs, device)

    def on_particles(self, body: ParticleBody) -> BoundAdhesion:
        """Device arrays for particles in the place of the surface's points: those that come so near are the lowest.

        Raises:
            SceneUnsupported: the reach goes to the layer of particles above the lowest.
        """
        lattice, device, count = body.problem.lattice, body.problem.device, len(body.solid)
        dx, dy, dz = lattice.spacing
        if self.reach_m > 0.5 * dz:
            raise SceneUnsupported(
                f"{Adhesion.name} reaches {self.reach_m:.3g} m; in the updated Lagrangian form it may reach the lowest "
                f"particles only, {0.5 * dz:.3g} m"
            )
        inputs = [
            wp.array(np.arange(count + 1), dtype=wp.int32, device=device),
            wp.array(np.arange(count), dtype=wp.int32, device=device),
            wp.array(np.ones(count), dtype=wp.float64, device=device),
            wp.array(np.full(count, 0.25 * dx * dy), dtype=wp.float64, device=device),
            wp.array(np.full(count, self.ground.height_m + GAUSS_POINTS[0] * dz), dtype=wp.float64, device=device),
            wp.float64(self.traction_pa), wp.float64(self.reach_m),
        ]  # fmt: skip
        return BoundAdhesion(count, inputs, device)


@dataclass(frozen=True)
class BoundAdhesion(BoundTerm):
    """Surface points on the device. The traction falls with the gap: it adds no frequency."""

    points: int
    inputs: list[Any]
    device: str

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the tractions [N]."""
        wp.launch(adhesion, dim=self.points, inputs=[*self.inputs, x], outputs=[force], device=self.device)


@dataclass(frozen=True)
class Adhesion(Effect):
    """``traction_pa``: Y; ``reach_m``: d."""

    name = "adhesion"
    title = "adhesion to the ground"
    equation = "traction = Y max(0, 1 - gap / d)"
    kind = "boundary"
    gates = ("traction_pa",)

    traction_pa: float = 0.0
    reach_m: float = 0.002

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to a hundred times the pressure of the body's own weight."""
        weight = twin.density * gravity_size(twin) * body_size(twin)
        return (
            Strength("traction_pa", "Pa", 0.0, 100.0 * weight, 0.1 * weight),
            Strength("reach_m", "m", 1e-4, 0.05, 5e-4, gate=False, start=2e-3),
        )

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """A twin that touches no ground."""
        return no_ground(twin)

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds the term at the height of the contact as it stands."""
        grounds = [t for t in problem.terms if isinstance(t, GroundContact)]
        width = 2.0 * twin.body.thickness_m if twin.lattice.dim == 1 else 1.0
        added = [AdhesionTerm(t, self.traction_pa, self.reach_m, width) for t in grounds]
        return replace(problem, terms=(*problem.terms, *added))
