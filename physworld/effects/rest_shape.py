"""A rest shape that is not the declared one: stretched or shrunk along the material axes, or bent.

    strain      rest lengths along axis a are (1 + e_a) times the declared ones (lattice and mass keep their numbers)
    curvature   sheet: rest curvatures k11, k22;  rod: rest curvature vector, from the second and third axis of the
                start's frame;  solid: its longest axis bends towards the other two, S -= C : E_0, E_0 = -kappa y

A rod's rest curvature turns with its tangent. At the start the body stands where it was seen: a wrong rest shape acts
as a stress from then on (pre-stress).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from physworld.effects.base import Effect, Strength, Variant, one_by_one
from physworld.effects.places import body_size
from physworld.engine.problem import Problem
from physworld.engine.total.stress import StressTerm
from physworld.engine.total.stress_kernels import rod_model, sheet_model, solid_model
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import SheetLaw
from physworld.materials.solid import SolidLaw

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_AXES = ("x", "y", "z")

_MODELS = {
    3: solid_model(r"""
        for (int k = 0; k < 3; ++k) S[k] = FIELD(0) * FIELD(1 + k);
    """),
    2: sheet_model(r"""
        const V stiffness = -FIELD(0) * PARAMETER(0);
        stress[3] = stiffness * (PARAMETER(3) * PARAMETER(1) + PARAMETER(5) * PARAMETER(2));
        stress[4] = stiffness * (PARAMETER(4) * PARAMETER(2) + PARAMETER(5) * PARAMETER(1));
    """),
    1: rod_model(
        r"""
        CARRY(3, 4, 5);
        for (int i = 0; i < 3; ++i) {
            if (first) STATE(3 + i) = FIELD(1 + i);
            moment[i] = -FIELD(0) * PARAMETER(0) * STATE(3 + i);
        }
        for (int i = 0; i < 3; ++i) torque[i] = -CROSS(moment, kappa, i);
    """,
        rows=6,
    ),
}


@dataclass(frozen=True)
class RestShape(Effect):
    """``strain_x`` …: e; ``curvature_1_per_m``, ``curvature_2_per_m``: rest curvature."""

    name = "rest_shape"
    title = "other rest shape"
    equation = "rest length (1 + e) L, rest curvature k0"
    kind = "field"
    gates = ("strain_x", "strain_y", "strain_z", "curvature_1_per_m", "curvature_2_per_m")
    strains = True
    instead = "scan the body without load"

    strain_x: float = 0.0
    strain_y: float = 0.0
    strain_z: float = 0.0
    curvature_1_per_m: float = 0.0
    curvature_2_per_m: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """A fifth longer or shorter; bends up to half a turn over the body."""
        most = np.pi / body_size(twin)
        return (
            *(Strength(f"strain_{a}", "1", -0.2, 0.2, 0.005) for a in _AXES[: twin.lattice.dim]),
            Strength("curvature_1_per_m", "1/m", -most, most, 0.02 * most),
            Strength("curvature_2_per_m", "1/m", -most, most, 0.02 * most),
        )

    @classmethod
    def variants(cls, twin: Twin) -> list[Variant]:
        """Strains and curvatures apart."""
        strains, bends = ("strain_x", "strain_y", "strain_z"), ("curvature_1_per_m", "curvature_2_per_m")
        return one_by_one(cls.strengths(twin), strains, bends)

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Scales the lattice, and adds the stress of a bend."""
        strain = np.array([self.strain_x, self.strain_y, self.strain_z])[: twin.lattice.dim]
        if np.any(strain):
            stretch = 1.0 + strain
            lattice = replace(
                problem.lattice,
                origin=problem.lattice.origin * stretch,
                spacing=problem.lattice.spacing * stretch,
            )
            rest = problem.rest.copy()
            rest[:, : twin.lattice.dim] *= stretch
            known = np.ones(lattice.fill.size) if problem.density_factor is None else problem.density_factor
            problem = replace(problem, lattice=lattice, rest=rest, density_factor=known / np.prod(stretch))
        if self.curvature_1_per_m == 0 and self.curvature_2_per_m == 0:
            return problem
        bend = (self.curvature_1_per_m, self.curvature_2_per_m)
        return replace(problem, terms=(*problem.terms, _bending(problem, twin, bend)))


def _bending(problem: Problem, twin: Twin, bend: tuple[float, float]) -> StressTerm:
    law, lattice = problem.law, problem.lattice
    if isinstance(law, SheetLaw):
        return StressTerm(_MODELS[2], (law.bending_n_m, *bend, *law.bending_shape), frequency_rad_s=0.0)
    if isinstance(law, RodLaw):
        slope = lattice.interpolation(lattice.particle_coordinates, (1,)) @ twin.body.start
        tangent = slope / np.linalg.norm(slope, axis=1, keepdims=True)
        axes = np.linalg.svd(tangent.mean(axis=0)[None])[2][1:]
        rest = sum(b * axis for b, axis in zip(bend, axes, strict=True))
        across = rest - np.sum(rest * tangent, axis=1, keepdims=True) * tangent
        return StressTerm(_MODELS[1], (law.bending_n_m2,), across.T, frequency_rad_s=0.0)
    assert isinstance(law, SolidLaw)
    places = lattice.particle_coordinates
    filled = lattice.particle_measures > 0
    centred = places - places[filled].mean(axis=0)
    along = int(np.argmax(np.ptp(places[filled], axis=0)))
    others = [axis for axis in range(3) if axis != along]
    strain = -sum(b * centred[:, axis] for b, axis in zip(bend, others, strict=True))
    mu, lam = law.lame
    stress = np.repeat((-lam * strain)[None], 3, axis=0)
    stress[along] -= 2 * mu * strain
    return StressTerm(_MODELS[3], (), stress, frequency_rad_s=0.0, name=RestShape.name)
