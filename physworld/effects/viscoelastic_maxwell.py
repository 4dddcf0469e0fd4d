"""Maxwell relaxation: a spring and a dashpot in series beside the law, so that part of the stiffness fades.

    solid        S += 2 G1 dev(E - a)            da/dt = (E - a) / tau       (E Green strain)
    sheet, rod   stress += g C (e - a)           da/dt = (e - a) / tau       (C the law's own stiffness)

Fast motions feel G1 (or the share g) on top of the law, slow ones nothing; in between energy is lost, most of it at
the frequency 1/tau. The branch starts relaxed. In a rod ``a`` holds curvature and turns with the tangent.

Several ``branches`` are a Prony series of equal parts, each ten times slower than the one before: between its first and
its last time the loss modulus g sum_k w tau_k / (1 + w^2 tau_k^2) hardly depends on the frequency w, for a ladder of
one branch a decade averages to g pi / (2 ln 10) = 0.68 g. What creeps over seconds is then softer than what rings. A
solid takes G1 as a ``share`` g of the law's shear modulus too; ``shear_modulus_pa`` adds to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from physworld.effects.base import Effect, Strength, Variant
from physworld.effects.places import body_size, gravity_size
from physworld.engine.problem import Problem
from physworld.engine.total.stress import StressTerm
from physworld.engine.total.stress_kernels import rod_model, sheet_model, solid_model
from physworld.materials.cable import CableLaw
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import SheetLaw
from physworld.materials.solid import SolidLaw

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_RELAXATIONS_S = (0.02, 0.1, 0.5)

_MODELS = {
    3: solid_model(
        r"""
        const float keep = PARAMETER(1) / (PARAMETER(1) + dt);
        for (int k = 0; k < 6; ++k) {
            STATE(k) = first ? E[k] : E[k] + (STATE(k) - E[k]) * keep;
            S[k] = FIELD(0) * PARAMETER(0) * (E[k] - STATE(k));
        }
        const V mean = (S[0] + S[1] + S[2]) * (1.0f / 3.0f);
        for (int k = 0; k < 3; ++k) S[k] -= mean;
    """,
        rows=6,
    ),
    2: sheet_model(
        r"""
        const double keep = PARAMETER(2) / (PARAMETER(2) + dt);
        V e[6];
        for (int k = 0; k < 6; ++k) {
            STATE(k) = first ? strain[k] : strain[k] + (STATE(k) - strain[k]) * keep;
            e[k] = strain[k] - STATE(k);
        }
        for (int k = 0; k < 6; k += 3) {
            const V stiffness = FIELD(0) * PARAMETER(k / 3);
            const int c = k == 0 ? 3 : 7;   // C11, C22, C12 and C33 of stretch, of bending
            stress[k] = stiffness * (PARAMETER(c) * e[k] + PARAMETER(c + 2) * e[k + 1]);
            stress[k + 1] = stiffness * (PARAMETER(c + 1) * e[k + 1] + PARAMETER(c + 2) * e[k]);
            stress[k + 2] = stiffness * PARAMETER(c + 3) * e[k + 2];
        }
    """,
        rows=6,
    ),
    1: rod_model(
        r"""
        CARRY(3, 4, 5);
        const double keep = PARAMETER(2) / (PARAMETER(2) + dt);
        for (int i = 0; i < 3; ++i) {
            STATE(3 + i) = first ? kappa[i] : kappa[i] + (STATE(3 + i) - kappa[i]) * keep;
            moment[i] = FIELD(0) * PARAMETER(1) * (kappa[i] - STATE(3 + i));
        }
        const V rest[3] = {STATE(3), STATE(4), STATE(5)};
        for (int i = 0; i < 3; ++i) torque[i] = CROSS(rest, moment, i);
        STATE(6) = first ? stretch : stretch + (STATE(6) - stretch) * keep;
        axial = FIELD(0) * PARAMETER(0) * (stretch - STATE(6));
    """,
        rows=7,
    ),
}


@dataclass(frozen=True)
class ViscoelasticMaxwell(Effect):
    """``shear_modulus_pa``: G1 of a solid; ``share``: g; ``relaxation_s``: tau of the first of ``branches``."""

    name = "viscoelastic_maxwell"
    title = "Maxwell relaxation"
    equation = "S += 2 G1 dev(E - a), da/dt = (E - a) / tau"
    kind = "stress"
    gates = ("shear_modulus_pa", "share")
    strains = True

    shear_modulus_pa: float = 0.0
    share: float = 0.0
    relaxation_s: float = 0.1
    branches: int = 1

    @classmethod
    def why_not(cls, twin: Twin) -> str | None:
        """Strains of splines, or the branch that the law of discrete rods has."""
        return None if isinstance(twin.law, CableLaw) else super().why_not(twin)

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """A branch up to the size of a stiff law, fading within 5 ms to 5 s.

        It is believed to be about as stiff as the law at most: few materials are more than twice as stiff in fast
        motion as in slow motion.
        """
        time = Strength("relaxation_s", "s", 5e-3, 5.0, 0.02, gate=False, start=0.1)
        if not isinstance(twin.law, SolidLaw):
            return (Strength("share", "1", 0.0, 5.0, 0.02, prior_deviation=1.0), time)
        scale, shear = twin.density * gravity_size(twin) * body_size(twin), twin.law.lame[0]
        own = Strength("shear_modulus_pa", "Pa", 0.0, 1e4 * scale, 0.02 * shear, prior_deviation=shear)
        return (own, time)

    @classmethod
    def variants(cls, twin: Twin) -> list[Variant]:
        """Three relaxation times."""
        gates = tuple(s.name for s in cls.strengths(twin) if s.gate)
        return [
            Variant(gates, f"{time:g} s", {"relaxation_s": time}, ("relaxation_s",))
            for time in _RELAXATIONS_S
        ]

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds the branches; the law of discrete rods has one of its own."""
        if isinstance(problem.law, CableLaw):
            law = replace(
                problem.law, creep_ratio=problem.law.creep_ratio + self.share, creep_s=self.relaxation_s
            )
            return replace(problem, law=law)
        model, times = _MODELS[twin.lattice.dim], [self.relaxation_s * 10.0**k for k in range(self.branches)]
        added = [StressTerm(model, self._numbers(problem, tau), name=self.name) for tau in times]
        return replace(problem, terms=(*problem.terms, *added))

    def _numbers(self, problem: Problem, tau: float) -> tuple[float, ...]:
        """What the model of one branch reads."""
        law, g = problem.law, self.share
        numbers: tuple[float, ...]
        if isinstance(law, SolidLaw):
            shear = self.shear_modulus_pa if g == 0.0 else self.shear_modulus_pa + g * law.lame[0]
            numbers = (2.0 * shear, tau)
        elif isinstance(law, SheetLaw):
            shape = (*law.membrane_shape, *law.bending_shape)
            numbers = (g * law.membrane_n_m, g * law.bending_n_m, tau, *shape)
        else:
            assert isinstance(law, RodLaw)
            numbers = (g * law.stretching_n, g * law.bending_n_m2, tau)
        return numbers
