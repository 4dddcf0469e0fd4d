"""Ropes recorded by an engine that is not ours: PyElastica's Cosserat rods (stretch, shear, bending, twist), undamped.

A rope hangs from a hand that moves and turns its first two elements, or between two of them. A camera sees points
on its surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import elastica
import numpy as np
from elastica.timestepper.symplectic_steppers import PositionVerlet
from scipy.spatial.transform import Rotation

from benchmarks.peers.finite_elements import Acting, Floats, Place

_HELD = 2  # elements
_SAFETY = 0.1  # of an element's length over the speed of stretching waves
_INSTANT_S = 1e-6


class _World(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing):
    """One rod, its hand and its forces."""


class _Hand(elastica.ConstraintBase):
    """Nodes and elements of an end that follow a place."""

    def __init__(self, *start: Floats, place: Place, first: int, **keywords: object) -> None:
        super().__init__(**keywords)
        self.nodes = np.stack(start[: _HELD + 1], axis=-1)
        self.frames = np.stack(start[_HELD + 1 :], axis=-1)
        self.held, self.elements = slice(first, first + _HELD + 1), range(first, first + _HELD)
        self.place, self.centre = place, self.nodes[:, -1:] if first else self.nodes[:, :1]

    def constrain_values(self, system: elastica.CosseratRod, time: float) -> None:
        """Where they are."""
        turn, shift = self.place(time)
        places = turn @ (self.nodes - self.centre) + self.centre + shift[:, None]
        system.position_collection[:, self.held] = places
        for k, element in enumerate(self.elements):
            system.director_collection[..., element] = self.frames[..., k] @ turn.T

    def constrain_rates(self, system: elastica.CosseratRod, time: float) -> None:
        """How they move."""
        (turn, shift), (later, moved) = self.place(time), self.place(time + _INSTANT_S)
        rate = ((later - turn) @ (self.nodes - self.centre) + (moved - shift)[:, None]) / _INSTANT_S
        system.velocity_collection[:, self.held] = rate
        spin = Rotation.from_matrix(later @ turn.T).as_rotvec() / _INSTANT_S
        for element in self.elements:
            system.omega_collection[:, element] = system.director_collection[..., element] @ spin


class _Field(elastica.NoForces):
    """Gravity and what acts beside it, by mass, and a tether."""

    def __init__(self, acting: Acting, tied: Floats) -> None:
        super().__init__()
        self.acting, self.tied = acting, tied

    def apply_forces(self, system: elastica.CosseratRod, time: float = 0.0) -> None:
        """Add them [N]."""
        acting, v = self.acting, system.velocity_collection
        pull = acting.linear_drag_per_s + acting.quadratic_drag_per_m * np.linalg.norm(v, axis=0)
        steady = acting.gravity_m_s2 if acting.push is None else acting.gravity_m_s2 + acting.push(time)
        system.external_forces += system.mass * (steady[:, None] - pull * v)
        if acting.tether_n_m:
            reach = acting.anchor - system.position_collection @ self.tied
            length = float(np.linalg.norm(reach))
            tension = acting.tether_n_m * (length - acting.tether_rest_m) * reach / length
            system.external_forces += np.outer(tension, self.tied)


@dataclass(frozen=True)
class Rope:
    """A straight rope of ``elements`` that starts at ``top`` (3,) [m] and goes along ``way`` (3,).

    Attributes:
        young_pa, poisson, density_kg_m3: of the material.
    """

    length_m: float
    radius_m: float
    top: Floats
    way: Floats
    young_pa: float
    poisson: float
    density_kg_m3: float
    elements: int = 40

    @property
    def along(self) -> Floats:
        """Unit vector, (3,)."""
        return self.way / np.linalg.norm(self.way)

    @property
    def nodes(self) -> Floats:
        """At rest (n + 1, 3) [m]."""
        return self.top + np.linspace(0.0, self.length_m, self.elements + 1)[:, None] * self.along

    @property
    def held(self) -> Floats:
        """Nodes in the hand, (3, 3) [m]."""
        return self.nodes[: _HELD + 1]

    def record(
        self, acting: Acting, place: Place, times: Floats, seen: Floats, far: Place | None = None
    ) -> Floats:
        """Points (T, N, 3) [m] at evenly spaced ``times`` [s], undeformed and at rest at the first.

        Args:
            place: how the hand moves, which turns about the end.
            seen: of every point its share of the length and its angle about the axis [rad], (N, 2).
            far: how a hand at the other end moves; None: it is free.
        """
        side = np.cross(self.along, [1.0, 0.0, 0.0] if abs(self.along[0]) < 0.9 else [0.0, 1.0, 0.0])
        rod = elastica.CosseratRod.straight_rod(
            self.elements, self.top, self.along, side / np.linalg.norm(side), self.length_m, self.radius_m,
            density=self.density_kg_m3, youngs_modulus=self.young_pa,
            shear_modulus=self.young_pa / (2.0 * (1.0 + self.poisson)),
        )  # fmt: skip
        near = np.linalg.norm(self.nodes - acting.attach, axis=1) <= acting.tether_radius_m
        tied = np.where(near, rod.mass, 0.0) / max(float(rod.mass[near].sum()), 1e-30)
        world = _World()
        world.append(rod)
        ends = [(place, 0)] + ([] if far is None else [(far, self.elements - _HELD)])
        for hand, first in ends:
            world.constrain(rod).using(
                _Hand, place=hand, first=first,
                constrained_position_idx=tuple(range(first, first + _HELD + 1)),
                constrained_director_idx=tuple(range(first, first + _HELD)),
            )  # fmt: skip
        world.add_forcing_to(rod).using(_Field, acting, tied)
        world.finalize()
        gap = float(times[1] - times[0])
        element = self.length_m / self.elements
        steps = int(np.ceil(gap * np.sqrt(self.young_pa / self.density_kg_m3) / (_SAFETY * element)))
        stepper, time, frames = PositionVerlet(), np.float64(0.0), [self._points(rod, seen)]
        for _ in times[1:]:
            for _ in range(steps):
                time = stepper.step(world, time, np.float64(gap / steps))
            frames.append(self._points(rod, seen))
        found = np.stack(frames)
        if not np.isfinite(found).all():
            raise FloatingPointError(f"the recording blew up at steps of {gap / steps:.3g} s")
        return found

    def _points(self, rod: elastica.CosseratRod, seen: Floats) -> Floats:
        place = seen[:, 0] * self.elements
        element = np.minimum(place.astype(int), self.elements - 1)
        share = (place - element)[:, None]
        nodes, frames = rod.position_collection.T, np.moveaxis(rod.director_collection, 2, 0)[element]
        out = np.cos(seen[:, 1:]) * frames[:, 0] + np.sin(seen[:, 1:]) * frames[:, 1]
        return (1.0 - share) * nodes[element] + share * nodes[element + 1] + self.radius_m * out
