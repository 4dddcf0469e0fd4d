"""Plastic flow: strain beyond the yield point stays.

    solid   S += mu (Cp^-1 - 1)     |mu dev b| <= sqrt(2/3) Y + mu h g,  b = F Cp^-1 F^T
    sheet   M -= C p                |k - p| <= k_y + h g                                  (bending only)
    rod     moment -= B p           |kappa - p| <= k_y + h g                              (p turns with the tangent)

Cp is the plastic right Cauchy-Green strain, det Cp = 1, p a plastic curvature, g what has flowed; the return is radial
(Simo and Hughes, box 9.1). With a neo-Hookean law the solid's form is exact at finite strain, with others to first
order. The strengths vanish where the body is elastic: 1/Y for a solid, and the bend radius 1/k_y above which a sheet
or rod stays elastic. A body that tears, melts or touches itself belongs to the updated Lagrangian form.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from physworld.effects.base import Effect, Strength
from physworld.effects.places import body_size, gravity_size
from physworld.engine.problem import Problem
from physworld.engine.total.stress import StressTerm
from physworld.engine.total.stress_kernels import rod_model, sheet_model, solid_model
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import SheetLaw
from physworld.materials.solid import SolidLaw

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_MODELS = {
    3: solid_model(
        r"""
        V G[6], B[9], A[9], cof[9], b[6], e[6], D[9];   // G = Cp^-1 - 1, B = Cp^-1, b = F B F^T
        if (first) for (int k = 0; k < 7; ++k) STATE(k) = V{};
        for (int k = 0; k < 6; ++k) G[k] = STATE(k);
        const int at[9] = {0, 5, 4, 5, 1, 3, 4, 3, 2}, row[6] = {0, 1, 2, 1, 0, 0}, column[6] = {0, 1, 2, 2, 2, 1};
        for (int k = 0; k < 9; ++k) B[k] = G[at[k]] + (k % 4 ? 0.0f : 1.0f);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                A[3 * i + j] = F[3 * i] * B[j] + F[3 * i + 1] * B[3 + j] + F[3 * i + 2] * B[6 + j];
                const int r = (i + 1) % 3, s = (i + 2) % 3, c = (j + 1) % 3, d = (j + 2) % 3;
                cof[3 * i + j] = F[3 * r + c] * F[3 * s + d] - F[3 * r + d] * F[3 * s + c];
            }
        for (int k = 0; k < 6; ++k) {
            const int i = 3 * row[k], j = 3 * column[k];
            b[k] = A[i] * F[j] + A[i + 1] * F[j + 1] + A[i + 2] * F[j + 2];
        }
        const V mean = (b[0] + b[1] + b[2]) * (1.0f / 3.0f);
        V size = V{} + 1e-20f;
        for (int k = 0; k < 6; ++k) {
            e[k] = k < 3 ? b[k] - mean : b[k];
            size += (k < 3 ? 1.0f : 2.0f) * e[k] * e[k];
        }
        size = ROOT(size);
        const V filled = FIELD(0) / (FIELD(0) + 1e-30f);
        const V flow = POSITIVE(size - PARAMETER(1) - PARAMETER(2) * STATE(6)) * (filled / (1.0f + PARAMETER(2)));
        STATE(6) += flow;
        const V J = POSITIVE(F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2] - 0.02f) + 0.02f;
        const V share = flow / (size * J * J);
        for (int i = 0; i < 3; ++i)   // B -= (flow / size) F^-1 e F^-T, F^-1 = cof^T / J
            for (int j = 0; j < 3; ++j)
                D[3 * i + j] = e[at[3 * i]] * cof[j] + e[at[3 * i + 1]] * cof[3 + j] + e[at[3 * i + 2]] * cof[6 + j];
        for (int k = 0; k < 6; ++k) {
            const int i = row[k], j = column[k];
            G[k] -= share * (cof[i] * D[j] + cof[3 + i] * D[3 + j] + cof[6 + i] * D[6 + j]);
        }
        // det B = 1 by one step of Newton, where it flowed: det(1 + G) - 1 = tr G + second invariant + det G
        const V minors = G[0] * G[1] + G[1] * G[2] + G[0] * G[2] - G[3] * G[3] - G[4] * G[4] - G[5] * G[5];
        const V trace = G[0] + G[1] + G[2];
        const V det = G[0] * (G[1] * G[2] - G[3] * G[3]) - G[5] * (G[5] * G[2] - G[3] * G[4])
                      + G[4] * (G[5] * G[3] - G[1] * G[4]);
        const V excess = (trace + minors + det) / (3.0f + 2.0f * trace + minors) * (flow / (flow + 1e-20f));
        for (int k = 0; k < 6; ++k) {
            if (k < 3) G[k] -= excess;
            STATE(k) = G[k];
            S[k] = FIELD(0) * PARAMETER(0) * G[k];
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
        const V stiffness = -FIELD(0) * PARAMETER(0);   // with C11, C22, C12 and C33 over it
        stress[3] = stiffness * (PARAMETER(3) * STATE(0) + PARAMETER(5) * STATE(1));
        stress[4] = stiffness * (PARAMETER(4) * STATE(1) + PARAMETER(5) * STATE(0));
        stress[5] = stiffness * PARAMETER(6) * STATE(2);
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
    equation = "|mu dev b| <= sqrt(2/3) Y, b = F Cp^-1 F^T"
    kind = "stress"
    gates = ("inverse_yield_per_pa", "yield_radius_m")
    strains = True

    inverse_yield_per_pa: float = 0.0
    yield_radius_m: float = 0.0
    hardening: float = 0.0

    def derived(self, twin: Twin) -> dict[str, tuple[float, str]]:
        """The yield point itself."""
        found = {}
        if self.inverse_yield_per_pa:
            found["yield_pa"] = (1.0 / self.inverse_yield_per_pa, "Pa")
        if self.yield_radius_m:
            found["yield_curvature_per_m"] = (1.0 / self.yield_radius_m, "1/m")
        return found

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """By rho g L^2 / h, a third of a level beam's bending stress: at two thirds such a beam collapses."""
        hardening = Strength("hardening", "1", 0.0, 10.0, 0.05, gate=False)
        if twin.lattice.dim == 3:
            slender = body_size(twin) / float(np.ptp(twin.particles_start, axis=0).min())
            soft = 1.0 / (twin.density * gravity_size(twin) * body_size(twin) * slender)
            return (Strength("inverse_yield_per_pa", "1/Pa", 0.0, 40.0 * soft, 0.7 * soft), hardening)
        size = body_size(twin)
        return (Strength("yield_radius_m", "m", 0.0, 20.0 * size, size), hardening)

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds the plastic part of the stress."""
        law, h = problem.law, self.hardening
        numbers: tuple[float, ...]
        if isinstance(law, SolidLaw):
            if not self.inverse_yield_per_pa:
                return problem
            mu = law.lame[0]
            numbers = (mu, np.sqrt(2 / 3) / self.inverse_yield_per_pa / mu, h)
        else:
            if not self.yield_radius_m:
                return problem
            bent = 1.0 / self.yield_radius_m
            if isinstance(law, SheetLaw):
                numbers = (law.bending_n_m, bent, h, *law.bending_shape)
            else:
                assert isinstance(law, RodLaw)
                numbers = (law.bending_n_m2, bent, h)
        term = StressTerm(_MODELS[twin.lattice.dim], numbers, frequency_rad_s=0.0, name=self.name)
        return replace(problem, terms=(*problem.terms, term))
