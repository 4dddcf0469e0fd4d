"""Internal viscosity of Kelvin-Voigt kind: stress that follows the rate of strain.

    solid        Cauchy stress + 2 eta d, eta in Pa s
    sheet, rod   every strain e is replaced by e + tau de/dt, tau in s

The parameters are the law's own; the effect adds to them. It acts on strain rates only: a rigid motion, which drag
slows, it leaves alone. For a rod or sheet of modulus E bending has tau = 2 (1 + 2 nu^2) eta / E.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from physworld.effects.base import Effect, Strength
from physworld.effects.places import body_size, gravity_size
from physworld.engine.problem import Problem
from physworld.materials.sheet import SheetLaw
from physworld.materials.solid import SolidLaw

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


_FRICTION = {3: "viscosity_pa_s", 2: "relaxation_s", 1: "relaxation_s"}  # of a law, by dimension


@dataclass(frozen=True)
class ViscosityKelvinVoigt(Effect):
    """``viscosity_pa_s``: eta of a solid; ``relaxation_s``: tau of a sheet or rod."""

    name = "viscosity_kelvin_voigt"
    title = "internal viscosity"
    equation = "sigma += 2 eta d"
    kind = "stress"
    gates = ("viscosity_pa_s", "relaxation_s")

    viscosity_pa_s: float = 0.0
    relaxation_s: float = 0.0

    def derived(self, twin: Twin) -> dict[str, tuple[float, str]]:
        """Of a sheet the viscosity of its material."""
        law = twin.law
        if not isinstance(law, SheetLaw):
            return {}
        nu, thickness = law.poissons_ratio, twin.body.thickness_m
        modulus = law.membrane_n_m * (1 - nu**2) / thickness
        return {"viscosity_pa_s": (float(self.relaxation_s * modulus / (2 * (1 + 2 * nu**2))), "Pa s")}

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """The one that the body has; a solid's goes by its weight, rho g L [Pa], times a second."""
        if twin.lattice.dim == 3:
            scale = twin.density * gravity_size(twin) * body_size(twin)
            return (Strength("viscosity_pa_s", "Pa s", 0.0, scale, 1e-3 * scale),)
        return (Strength("relaxation_s", "s", 0.0, 0.2, 1e-3),)

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """A law without friction of its own."""
        wanted = _FRICTION[twin.lattice.dim]
        return None if hasattr(twin.law, wanted) else f"a {type(twin.law).__name__} has no {wanted}"

    def problem(self, problem: Problem, twin: Twin) -> Problem:
        """Adds to the law's friction."""
        law = problem.law
        own = self.viscosity_pa_s if isinstance(law, SolidLaw) else self.relaxation_s
        name = _FRICTION[twin.lattice.dim]
        return replace(problem, law=replace(law, **{name: getattr(law, name) + own}))
