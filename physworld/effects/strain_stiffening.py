"""Strain stiffening: a material that grows stiffer the more it is strained.

    solid  W = s E / 4 (E : E)^2          S = s E (E : E) E         (E Young's modulus, E the Green strain)
    sheet  N = s K (e : e) e              M = s D h^2 / 4 (k : k) k (K, D membrane and bending stiffness, h thickness)
    rod    N = s EA e^3                   M = s B r^2 |k|^2 k       (r radius)

The first correction that an isotropic material can have without changing its modulus at rest: at a strain of 0.1 a
solid with s = 100 is about twice as stiff. A thin body's bending strain is its curvature times half its thickness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from physworld.effects.base import Effect, Strength
from physworld.engine.problem import Problem
from physworld.engine.total.stress import StressTerm
from physworld.engine.total.stress_kernels import rod_model, sheet_model, solid_model
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import SheetLaw
from physworld.materials.solid import SolidLaw

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_DESIGN_STRAIN = (
    0.15  # strain up to which the stable time step is safe; beyond it the run may stop with an error
)

_MODELS = {
    3: solid_model(r"""
        V norm = E[0] * E[0] + E[1] * E[1] + E[2] * E[2] + 2.0f * (E[3] * E[3] + E[4] * E[4] + E[5] * E[5]);
        norm = FIELD(0) * norm * PARAMETER(0);
        for (int k = 0; k < 6; ++k) S[k] = norm * E[k];
    """),
    2: sheet_model(r"""
        for (int k = 0; k < 6; k += 3) {
            const V* e = strain + k;
            const V norm = FIELD(0) * PARAMETER(k / 3) * (e[0] * e[0] + e[1] * e[1] + 2.0 * e[2] * e[2]);
            for (int i = 0; i < 3; ++i) stress[k + i] = norm * e[i];
        }
    """),
    1: rod_model(r"""
        axial = FIELD(0) * PARAMETER(0) * stretch * stretch * stretch;
        for (int i = 0; i < 3; ++i) moment[i] = FIELD(0) * PARAMETER(1) * DOT(kappa, kappa) * kappa[i];
    """),
}


@dataclass(frozen=True)
class StrainStiffening(Effect):
    """``coefficient``: s, without unit."""

    name = "strain_stiffening"
    title = "strain stiffening"
    equation = "S += s E (E : E) E"
    kind = "stress"
    gates = ("coefficient",)
    strains = True

    coefficient: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to a doubling at a strain of 0.07."""
        return (Strength("coefficient", "1", 0.0, 200.0, 4.0),)

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds the stress."""
        law, lattice, s = problem.law, problem.lattice, self.coefficient
        half = 0.5 * twin.body.thickness_m
        numbers: tuple[float, ...]
        if isinstance(law, SolidLaw):
            numbers = (s * law.youngs_modulus_pa,)
        elif isinstance(law, SheetLaw):
            numbers = (s * law.membrane_n_m, s * law.bending_n_m * half**2)
        else:
            assert isinstance(law, RodLaw)
            numbers = (s * law.stretching_n, s * law.bending_n_m2 * (2 * half) ** 2)
        share = np.sqrt(3.0 * s) * _DESIGN_STRAIN  # of the law's own fastest frequency
        frequency = float(share * 2.0 * np.sqrt(lattice.dim) * law.wave_speed_m_s / lattice.spacing.min())
        term = StressTerm(_MODELS[lattice.dim], numbers, frequency_rad_s=frequency, name=self.name)
        return replace(problem, terms=(*problem.terms, term))
