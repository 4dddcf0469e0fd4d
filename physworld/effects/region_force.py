"""A constant force on some material: a wire that pulls, a draught on one end, a magnet.

    F on the centroid of the material that starts within ``radius_m`` of (``x_m``, ``y_m``, ``z_m``)

Where no place is given it is the end that is farthest from the grips.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.effects.base import Effect, Strength
from physworld.effects.places import body_size, free_end, gravity_size, region_shares, region_weights
from physworld.engine.problem import Problem
from physworld.engine.terms.term import BoundTerm
from physworld.engine.updated.terms import ParticleBody

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_RADIUS = 0.1  # of the body's size


@wp.kernel
def push_nodes(
    # model
    nodes: wp.array[wp.int32],
    push: wp.array[wp.vec3d],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Add a fixed force to one node of the region."""
    k = wp.tid()
    for i in range(3):
        force[3 * nodes[k] + i] += push[k][i]


@dataclass(frozen=True)
class RegionForceTerm:
    """Term of :class:`RegionForce`: nodes (k,) and their forces (k, 3) [N]; forces on particles (P, 3) [N]."""

    nodes: Array
    push: Array
    particle_push: Array

    def bind(self, problem: Problem) -> BoundRegionForce:
        """Device arrays."""
        device = problem.device
        return BoundRegionForce(
            wp.array(self.nodes, dtype=wp.int32, device=device),
            wp.array(self.push, dtype=wp.vec3d, device=device),
        )

    def on_particles(self, body: ParticleBody) -> BoundRegionForce:
        """Device arrays for particles in the place of nodes."""
        device, push = body.problem.device, self.particle_push[body.solid]
        pushed = np.flatnonzero(push.any(axis=1))
        return BoundRegionForce(
            wp.array(pushed, dtype=wp.int32, device=device),
            wp.array(push[pushed], dtype=wp.vec3d, device=device),
        )


@dataclass(frozen=True)
class BoundRegionForce(BoundTerm):
    """The region on the device."""

    nodes: wp.array
    push: wp.array

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the forces [N]."""
        inputs = [self.nodes, self.push]
        wp.launch(push_nodes, dim=len(self.nodes), inputs=inputs, outputs=[force], device=self.nodes.device)


@dataclass(frozen=True)
class RegionForce(Effect):
    """``force_x_n`` …: F [N]; ``x_m`` …, ``radius_m``: the material."""

    name = "region_force"
    title = "hidden force on a region"
    equation = "F constant on a region's centroid"
    kind = "force"
    gates = ("force_x_n", "force_y_n", "force_z_n")

    force_x_n: float = 0.0
    force_y_n: float = 0.0
    force_z_n: float = 0.0
    x_m: float | None = None
    y_m: float | None = None
    z_m: float | None = None
    radius_m: float | None = None

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to the body's weight, anywhere on the body."""
        weight = float(twin.particle_mass.sum()) * gravity_size(twin)
        low, high = twin.particles_start.min(axis=0), twin.particles_start.max(axis=0)
        step = 0.05 * body_size(twin)
        return (
            *(Strength(f"force_{a}_n", "N", -weight, weight, 5e-3 * weight) for a in "xyz"),
            *(
                Strength(f"{a}_m", "m", lo - step, hi + step, step, gate=False, start=c)
                for a, lo, hi, c in zip("xyz", low, high, free_end(twin), strict=True)
            ),
        )

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds the term."""
        given = (self.x_m, self.y_m, self.z_m)
        centre = np.array(
            [c if value is None else value for value, c in zip(given, free_end(twin), strict=True)]
        )
        radius = _RADIUS * body_size(twin) if self.radius_m is None else self.radius_m
        nodes, weights = region_weights(twin, centre, radius)
        force = [self.force_x_n, self.force_y_n, self.force_z_n]
        particle_push = np.outer(region_shares(twin, centre, radius), force)
        term = RegionForceTerm(nodes, np.outer(weights, force), particle_push)
        return replace(problem, terms=(*problem.terms, term))
