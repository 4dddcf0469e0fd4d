"""Plastic flow: strain beyond the yield point stays.

    solid   s = 2 mu (dev E - p)    |s| <= sqrt(2/3) Y + 2 mu h g    S -= 2 mu p       (E Green strain, p plastic part)
    sheet   |k - p| <= k_y + h g    M -= C p                                           (bending only)
    rod     |kappa - p| <= k_y + h g    moment -= B p                                  (p turns with the tangent)

g is the plastic strain that has been gathered; the return is radial (Green and Naghdi 1965 for the additive split;
Simo and Hughes ch. 3 for the return). The strengths vanish where the body is elastic: 1/Y for a solid and the bend
radius 1/k_y, above which a thin body stays elastic, for sheets and rods. Small to moderate strains; the elastic law
carries the volume. Material that flows far belongs to the updated Lagrangian form.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from physworld.effects.base import Effect, Strength
from physworld.effects.places import body_size, gravity_size
from physworld.mpm.stress import StressTerm
from physworld.mpm.stress_kernels import rod_model, sheet_model, solid_model
from physworld.mpm.total_lagrangian import Problem

if TYPE_CHECKING:
    from physworld.twin import Twin

_MODELS = {
    3: solid_model(
        r"""
        const V mean = (E[0] + E[1] + E[2]) * (1.0f / 3.0f);
        V e[6], size = V{} + 1e-20f;
        for (int k = 0; k < 6; ++k) {
            if (first) STATE(k) = V{};
            e[k] = (k < 3 ? E[k] - mean : E[k]) - STATE(k);
            size += (k < 3 ? 1.0f : 2.0f) * e[k] * e[k];
        }
        if (first) STATE(6) = V{};
        size = ROOT(size);
        const V flow = POSITIVE(size - PARAMETER(1) - PARAMETER(2) * STATE(6)) * (1.0f / (1.0f + PARAMETER(2)));
        STATE(6) += flow;
        for (int k = 0; k < 6; ++k) {
            STATE(k) += flow * e[k] / size;
            S[k] = -FIELD(0) * PARAMETER(0) * STATE(k);
        }
    """,
        rows=7,
    ),
    2: sheet_model(
        r"""
        V e[3], size = V{} + 1e-20;
        for (int k = 0; k < 3; ++k) {
            if (first) STATE(k) = V{};
            e[k] = strain[3 + k] - STATE(k);
            size += (k < 2 ? 1.0 : 2.0) * e[k] * e[k];
        }
        if (first) STATE(3) = V{};
        size = ROOT(size);
        const V flow = POSITIVE(size - PARAMETER(1) - PARAMETER(2) * STATE(3)) * (1.0 / (1.0 + PARAMETER(2)));
        STATE(3) += flow;
        for (int k = 0; k < 3; ++k) STATE(k) += flow * e[k] / size;
        const double nu = PARAMETER(3);
        const V stiffness = -FIELD(0) * PARAMETER(0);
        stress[3] = stiffness * (STATE(0) + nu * STATE(1));
        stress[4] = stiffness * (STATE(1) + nu * STATE(0));
        stress[5] = stiffness * (1.0 - nu) * STATE(2);
    """,
        rows=4,
    ),
    1: rod_model(
        r"""
        CARRY(3, 4, 5);
        V e[3], size = V{} + 1e-20;
        for (int i = 0; i < 3; ++i) {
            if (first) STATE(3 + i) = V{};
            e[i] = kappa[i] - STATE(3 + i);
            size += e[i] * e[i];
        }
        if (first) STATE(6) = V{};
        size = ROOT(size);
        const V flow = POSITIVE(size - PARAMETER(1) - PARAMETER(2) * STATE(6)) * (1.0 / (1.0 + PARAMETER(2)));
        STATE(6) += flow;
        for (int i = 0; i < 3; ++i) {
            STATE(3 + i) += flow * e[i] / size;
            moment[i] = -FIELD(0) * PARAMETER(0) * STATE(3 + i);
        }
        for (int i = 0; i < 3; ++i) torque[i] = -CROSS(moment, kappa, i);
    """,
        rows=7,
    ),
}


@dataclass(frozen=True)
class Plasticity(Effect):
    """``inverse_yield_per_pa``: 1/Y of a solid; ``yield_radius_m``: 1/k_y of a sheet or rod; ``hardening``: h."""

    name = "plasticity"
    title = "plastic flow"
    equation = "|2 mu (dev E - p)| <= sqrt(2/3) Y"
    kind = "stress"
    gates = ("inverse_yield_per_pa", "yield_radius_m")

    inverse_yield_per_pa: float = 0.0
    yield_radius_m: float = 0.0
    hardening: float = 0.0

    @property
    def derived(self) -> dict[str, tuple[float, str]]:
        """The yield point itself."""
        found = {}
        if self.inverse_yield_per_pa:
            found["yield_pa"] = (1.0 / self.inverse_yield_per_pa, "Pa")
        if self.yield_radius_m:
            found["yield_curvature_per_m"] = (1.0 / self.yield_radius_m, "1/m")
        return found

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """A solid's probe yields at a third of the stress under which its own weight bends it, rho g L^2 / h."""
        hardening = Strength("hardening", "1", 0.0, 10.0, 0.05, gate=False)
        if twin.lattice.dim == 3:
            slender = body_size(twin) / float(np.ptp(twin.particles_start, axis=0).min())
            soft = 1.0 / (twin.density * gravity_size(twin) * body_size(twin) * slender)
            return (Strength("inverse_yield_per_pa", "1/Pa", 0.0, 100.0 * soft, soft), hardening)
        size = body_size(twin)
        return (Strength("yield_radius_m", "m", 0.0, 20.0 * size, size), hardening)

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds the plastic part of the stress."""
        law, h = problem.law, self.hardening
        if twin.lattice.dim == 3:
            if not self.inverse_yield_per_pa:
                return problem
            mu = law.lame[0]
            numbers: tuple[float, ...] = (2 * mu, np.sqrt(2 / 3) / self.inverse_yield_per_pa / (2 * mu), h)
        else:
            if not self.yield_radius_m:
                return problem
            stiffness = law.bending_n_m if twin.lattice.dim == 2 else law.bending_n_m2
            numbers = (stiffness, 1.0 / self.yield_radius_m, h, getattr(law, "poissons_ratio", 0.0))
        term = StressTerm(_MODELS[twin.lattice.dim], numbers, frequency_rad_s=0.0)
        return replace(problem, terms=(*problem.terms, term))
