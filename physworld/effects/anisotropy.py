"""Fibres: a material that is stiffer (or softer) along one direction of the undeformed body.

    solid   S += r E E_ff f f        E_ff = f . E f        (E Young's modulus, E Green strain, f the fibre)
    sheet   N += r K e_ff f f        M += r D k_ff f f     (warp over weft: about 1 + r)

f lies at ``azimuth_rad`` from the first material axis towards the second, and ``elevation_rad`` up to the third; the
material axes are the world's for a solid. Not for rods: they have one direction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from physworld.arrays import Array
from physworld.effects.base import Effect, Strength, Variant
from physworld.engine.problem import Problem
from physworld.engine.total.stress import StressTerm
from physworld.engine.total.stress_kernels import sheet_model, solid_model
from physworld.materials.sheet import SheetLaw
from physworld.materials.solid import SolidLaw

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

_DIAGONAL = 0.25 * np.pi

_MODELS = {
    3: solid_model(r"""
        V along = V{};
        for (int k = 0; k < 6; ++k) along += (k < 3 ? 1.0f : 2.0f) * PARAMETER(1 + k) * E[k];
        along = FIELD(0) * PARAMETER(0) * along;
        for (int k = 0; k < 6; ++k) S[k] = PARAMETER(1 + k) * along;
    """),
    2: sheet_model(r"""
        for (int k = 0; k < 6; k += 3) {
            V along = V{};
            for (int i = 0; i < 3; ++i) along += (i < 2 ? 1.0 : 2.0) * PARAMETER(2 + i) * strain[k + i];
            along = FIELD(0) * PARAMETER(k / 3) * along;
            for (int i = 0; i < 3; ++i) stress[k + i] = PARAMETER(2 + i) * along;
        }
    """),
}


@dataclass(frozen=True)
class Anisotropy(Effect):
    """``ratio``: r, fibre stiffness over the law's; ``azimuth_rad``, ``elevation_rad``: the fibre."""

    name = "anisotropy"
    title = "fibre stiffness"
    equation = "S += r E (f . E f) f f"
    kind = "stress"
    gates = ("ratio",)
    strains = True

    ratio: float = 0.0
    azimuth_rad: float = 0.0
    elevation_rad: float = 0.0

    def derived(self, twin: Twin) -> dict[str, tuple[float, str]]:
        """The fibres' own modulus: a sheet's over its thickness."""
        law = twin.law
        if isinstance(law, SolidLaw):
            modulus = law.youngs_modulus_pa
        else:
            assert isinstance(law, SheetLaw)
            modulus = law.membrane_n_m / twin.body.thickness_m
        return {"fibre_modulus_pa": (float(self.ratio * modulus), "Pa")}

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Half as soft to twenty times as stiff; a direction and its opposite are the same."""
        half_turn = 0.5 * np.pi
        angles = [Strength("azimuth_rad", "rad", -half_turn, half_turn, 0.05, gate=False)]
        if twin.lattice.dim == 3:
            angles.append(Strength("elevation_rad", "rad", -half_turn, half_turn, 0.05, gate=False))
        return (Strength("ratio", "1", -0.5, 20.0, 0.05), *angles)

    @classmethod
    def variants(cls, twin: Twin) -> list[Variant]:
        """Directions over the half circle, for a solid over the half sphere: axes and the diagonals between them."""
        angles: list[tuple[float, float | None]]
        if twin.lattice.dim < 3:
            angles = [(azimuth, None) for azimuth in (0.0, _DIAGONAL, -_DIAGONAL, 2 * _DIAGONAL)]
        else:
            angles = [(a, 0.0) for a in (0.0, _DIAGONAL, -_DIAGONAL, 2 * _DIAGONAL)]
            angles += [(0.0, 2 * _DIAGONAL), (0.0, _DIAGONAL), (0.0, -_DIAGONAL)]
            angles += [(2 * _DIAGONAL, _DIAGONAL), (2 * _DIAGONAL, -_DIAGONAL)]
        variants = []
        for azimuth, elevation in angles:
            fixed = {"azimuth_rad": azimuth}
            label = f"{np.degrees(azimuth):.0f}°"
            if elevation is not None:
                fixed["elevation_rad"] = elevation
                label += f", {np.degrees(elevation):.0f}°"
            variants.append(Variant(("ratio",), label, fixed, tuple(fixed)))
        return variants

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """A rod."""
        return "a rod has one material direction; fibres need two" if twin.lattice.dim == 1 else None

    def fibre(self) -> Array:
        """Unit vector in material axes, (3,)."""
        level = np.cos(self.elevation_rad)
        return np.array(
            [level * np.cos(self.azimuth_rad), level * np.sin(self.azimuth_rad), np.sin(self.elevation_rad)]
        )

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds the fibres' stress."""
        law, f = problem.law, self.fibre()
        numbers: tuple[float, ...]
        if isinstance(law, SolidLaw):
            pairs = (f[0] * f[0], f[1] * f[1], f[2] * f[2], f[1] * f[2], f[0] * f[2], f[0] * f[1])
            numbers = (self.ratio * law.youngs_modulus_pa, *pairs)
        else:
            assert isinstance(law, SheetLaw)
            f = np.array([np.cos(self.azimuth_rad), np.sin(self.azimuth_rad)])
            in_plane = (f[0] * f[0], f[1] * f[1], f[0] * f[1])
            numbers = (self.ratio * law.membrane_n_m, self.ratio * law.bending_n_m, *in_plane)
        return replace(
            problem, terms=(*problem.terms, StressTerm(_MODELS[twin.lattice.dim], numbers, name=self.name))
        )
