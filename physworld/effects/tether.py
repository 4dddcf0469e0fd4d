"""A hidden tether: a spring from a fixed anchor to the centroid of some material.

    F = -k (1 - l / |d|) d        d = centroid - anchor, l rest length; pulls and pushes

The force is spread over the material as the centroid's weights, so it does the work of the spring. Where nothing is
given the tether holds the middle of the end that is farthest from the grips, wherever the twin has it; the anchor is
where that started, and l is 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.effects.base import Effect, Mirror, Shape, Strength, Variant
from physworld.effects.places import (
    body_size,
    gravity_size,
    middle_of_free_end,
    region_shares,
    region_weights,
)
from physworld.engine.problem import Problem
from physworld.engine.terms.term import BoundTerm
from physworld.engine.total.node_kernels import weighted_sum
from physworld.engine.updated.terms import ParticleBody

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_RADIUS = 0.1  # of the body's size
_SHORTEST = 0.05  # length of a tether on its other side over the one at rest


@wp.kernel
def pull_of_tether(
    # model
    nodes: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    anchor: wp.vec3d,
    stiffness: wp.float64,
    rest_length: wp.float64,
    # in
    x: wp.array[wp.float64],
    # out
    force: wp.array[wp.float64],
) -> None:
    """Add the spring's force to the nodes of its region, in one thread: there are few."""
    gap = weighted_sum(x, nodes, weights, 0, nodes.shape[0]) - anchor
    length = wp.length(gap) + wp.float64(1.0e-12)
    pull = -stiffness * (wp.float64(1.0) - rest_length / length) * gap
    for k in range(nodes.shape[0]):
        for i in range(3):
            force[3 * nodes[k] + i] += weights[k] * pull[i]


@dataclass(frozen=True)
class TetherTerm:
    """Term of :class:`Tether`: region (k,), (k,), the particles' shares in it (P,), anchor (3,) [m]."""

    nodes: Array
    weights: Array
    shares: Array
    anchor: Array
    stiffness_n_m: float
    rest_length_m: float

    def bind(self, problem: Problem) -> BoundTether:
        """Device arrays."""
        return self._bound(problem, self.nodes, self.weights)

    def on_particles(self, body: ParticleBody) -> BoundTether:
        """Device arrays for particles in the place of nodes; the mass that moves at once is still that of the nodes."""
        shares = self.shares[body.solid]
        region = np.flatnonzero(shares)
        return self._bound(body.problem, region, shares[region])

    def _bound(self, problem: Problem, numbers: Array, weights: Array) -> BoundTether:
        device = problem.device
        inputs = [
            wp.array(numbers, dtype=wp.int32, device=device),
            wp.array(weights, dtype=wp.float64, device=device),
            wp.vec3d(*self.anchor), wp.float64(self.stiffness_n_m), wp.float64(self.rest_length_m),
        ]  # fmt: skip
        inverse_mass = float(np.sum(self.weights**2 / problem.nodal_mass()[self.nodes]))
        return BoundTether(inputs, device, float(np.sqrt(self.stiffness_n_m * inverse_mass)))


@dataclass(frozen=True)
class BoundTether(BoundTerm):
    """The region on the device."""

    inputs: list[Any]
    device: str
    frequency_rad_s: float

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the tether's force [N]."""
        wp.launch(pull_of_tether, dim=1, inputs=[*self.inputs, x], outputs=[force], device=self.device)


@dataclass(frozen=True)
class Tether(Effect):
    """``stiffness_n_m``: k; ``anchor_x_m`` …; ``attach_x_m`` …, ``radius_m``: the material; ``rest_length_m``: l."""

    name = "tether"
    title = "hidden tether"
    equation = "F = -k (1 - l / |d|) d"
    kind = "force"
    gates = ("stiffness_n_m",)
    instead = "look for a cable or a contact near the place it points to"

    stiffness_n_m: float = 0.0
    anchor_x_m: float | None = None
    anchor_y_m: float | None = None
    anchor_z_m: float | None = None
    attach_x_m: float | None = None
    attach_y_m: float | None = None
    attach_z_m: float | None = None
    radius_m: float | None = None
    rest_length_m: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to a thousand times the weight over the size; the anchor within three sizes of the free end."""
        size, end = body_size(twin), middle_of_free_end(twin)
        scale = float(twin.particle_mass.sum()) * gravity_size(twin) / size
        return (
            Strength("stiffness_n_m", "N/m", 0.0, 1e3 * scale, 0.02 * scale),
            *(
                Strength(f"anchor_{a}_m", "m", c - 3 * size, c + 3 * size, 0.02 * size, gate=False, start=c)
                for a, c in zip("xyz", end, strict=True)
            ),
            Strength("rest_length_m", "m", 0.0, 3 * size, 0.02 * size, gate=False),
        )

    @classmethod
    def variants(cls, twin: Twin) -> list[Variant]:
        """Relaxed springs from the middle of the free end in every direction: axes, and the diagonals between them.

        The anchor stands in the room; which material is tied is left to each recording's twin.
        """
        end, reach = middle_of_free_end(twin), body_size(twin)
        axes = np.eye(3)
        ways = [*axes]
        for i, j in ((0, 1), (0, 2), (1, 2)):
            ways += [axes[i] + axes[j], axes[i] - axes[j]]
        variants = []
        for way in ways:
            unit = way / np.linalg.norm(way)
            anchor = end + reach * unit
            fixed = {f"anchor_{a}_m": float(p) for a, p in zip("xyz", anchor, strict=True)}
            fixed["rest_length_m"] = reach
            label = "towards " + " ".join(f"{p:+.0f}" for p in np.sign(np.round(way, 6)))
            shapes = tuple(f"anchor_{a}_m" for a in "xyz")
            variants.append(Variant(("stiffness_n_m",), label, fixed, shapes))
        return variants

    @classmethod
    def mirror(cls, twin: Twin) -> Mirror:
        """To the tether that pushes from the other side with the force of one that pulls, or the other way round.

        What tells the two apart is how a spring's force turns with it, which is of second order.
        """
        end = middle_of_free_end(twin)

        def other_side(shape: Shape) -> Shape:
            way, rest = np.array([shape[f"anchor_{a}_m"] for a in "xyz"]) - end, shape["rest_length_m"]
            length = max(float(np.linalg.norm(way)), 1e-9)
            other = end - way / length * max(2.0 * rest - length, _SHORTEST * rest)
            return shape | {f"anchor_{a}_m": float(p) for a, p in zip("xyz", other, strict=True)}

        return other_side

    def places(self, twin: Twin) -> tuple[Array, Array]:
        """Anchor and centre of the material at the start [m], (3,) each."""
        end = middle_of_free_end(twin)
        given = [(self.attach_x_m, self.attach_y_m, self.attach_z_m)]
        given.append((self.anchor_x_m, self.anchor_y_m, self.anchor_z_m))
        attach = np.array([c if value is None else value for value, c in zip(given[0], end, strict=True)])
        anchor = np.array([c if value is None else value for value, c in zip(given[1], attach, strict=True)])
        return anchor, attach

    def placed(self, twin: Twin) -> Tether:
        """With the places of anchor and material on this twin."""
        ends = zip(("anchor", "attach"), self.places(twin), strict=True)
        return replace(
            self, **{f"{e}_{a}_m": float(c) for e, end in ends for a, c in zip("xyz", end, strict=True)}
        )

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds the term."""
        anchor, attach = self.places(twin)
        radius = _RADIUS * body_size(twin) if self.radius_m is None else self.radius_m
        nodes, weights = region_weights(twin, attach, radius)
        shares = region_shares(twin, attach, radius)
        term = TetherTerm(nodes, weights, shares, anchor, self.stiffness_n_m, self.rest_length_m)
        return replace(problem, terms=(*problem.terms, term))
