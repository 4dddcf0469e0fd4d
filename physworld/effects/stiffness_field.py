"""A stiffness that varies over the body: low-rank, a slope along every material axis and one bump.

    log factor = sum_a s_a xi_a + b exp(-|xi - xi_0|^2 / (2 w^2))        xi in -1 … 1 over the body

The slopes have no mean, so they do not confound with the modulus itself. The factor multiplies every stiffness and
the law's friction. Material axes are the world's for a solid, the sheet's own, the arc length of a rod.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.effects.base import Effect, Strength, Variant
from physworld.effects.places import unit_coordinates
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.problem import Problem

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class LowRankField(Effect):
    """``slope_x`` …: s; ``bump``: b, at ``bump_x`` … (xi_0) with ``bump_width`` (w)."""

    equation = "log factor = s . xi + b exp(-|xi - xi_0|^2 / 2 w^2)"
    kind = "field"
    gates = ("slope_x", "slope_y", "slope_z", "bump")

    slope_x: float = 0.0
    slope_y: float = 0.0
    slope_z: float = 0.0
    bump: float = 0.0
    bump_x: float = 0.0
    bump_y: float = 0.0
    bump_z: float = 0.0
    bump_width: float = 0.3

    @classmethod
    def variants(cls, twin: Twin) -> list[Variant]:
        """A slope along the body's axes, and bumps along its longest."""
        axes = _AXES[: twin.lattice.dim]
        span = np.ptp(twin.lattice.particle_coordinates, axis=0)
        along = axes[int(np.argmax(span))]
        variants = [Variant(tuple(f"slope_{a}" for a in axes), "slope")]
        for place in (-0.5, 0.0, 0.5):
            fixed = {f"bump_{a}": 0.0 for a in axes} | {f"bump_{along}": place}
            variants.append(Variant(("bump",), f"bump at {place:+g}", fixed, (f"bump_{along}",)))
        return variants


@dataclass(frozen=True)
class StiffnessField(LowRankField):
    """A :class:`LowRankField` of every stiffness and of the law's friction."""

    name = "stiffness_field"
    title = "stiffness that varies over the body"

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Slopes and bumps up to a factor of e^1.5 either way."""
        return field_strengths(twin.lattice.dim)

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Multiplies the stiffness factor."""
        factor = np.exp(log_field(problem.lattice, self))
        known = 1.0 if problem.stiffness_factor is None else problem.stiffness_factor
        return replace(problem, stiffness_factor=known * factor)


def field_strengths(dim: int) -> tuple[Strength, ...]:
    """Strengths of a low-rank field over a body of dimension ``dim``."""
    axes = _AXES[:dim]
    return (
        *(Strength(f"slope_{a}", "1", -1.5, 1.5, 0.05) for a in axes),
        Strength("bump", "1", -1.5, 1.5, 0.05),
        *(Strength(f"bump_{a}", "1", -1.0, 1.0, 0.1, gate=False) for a in axes),
        Strength("bump_width", "1", 0.05, 1.0, 0.05, gate=False, start=0.3),
    )


def log_field(lattice: Lattice, effect: LowRankField) -> Array:
    """Log factor of every particle, (P,), of an effect with slopes and a bump."""
    xi = unit_coordinates(lattice)
    axes = _AXES[: lattice.dim]
    weight = lattice.particle_measures / lattice.particle_measures.sum()
    slopes = (xi - weight @ xi) @ np.array([getattr(effect, f"slope_{a}") for a in axes])
    strengths = effect.values
    centre = np.array([strengths[f"bump_{a}"] for a in axes], dtype=float)
    width, bump = float(strengths["bump_width"] or 1.0), float(strengths["bump"] or 0.0)
    logarithm: Array = slopes + bump * np.exp(-np.sum((xi - centre) ** 2, axis=1) / (2 * width**2))
    return logarithm
