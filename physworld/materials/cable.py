"""The law of ropes, cables and foam rods whose rest shape is not known: bending with friction and creep, twist, drag.

    M = B (k - k0 + tau k') + B k_f z + B c (k - q)        T = GJ (t - t0 + tau t')        N = EA (|x'| - 1)

k are the two curvatures about the material directors and k0 those that the rod has by itself, t and t0 likewise its
twist. z, between -1 and 1, is rate-independent friction (Dahl 1968): k_o z' = k' - |k'| z, so that B k_f is the moment
that strands, sheath and cells hold against each other and k_o the curvature after which they slip. q follows k within
the time T_c: q' = (k - q) / T_c, one Maxwell branch, for foams that creep.
Air drag per mass is b |v_n| v_n across the rod, with b = rho_air C d / (2 rho A).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from physworld.catalogue import Quantity
from physworld.materials.laws import Law
from physworld.materials.rod import RodLaw


@dataclass(frozen=True)
class CableLaw(RodLaw):
    """Rope, cable or rod with a rest shape of its own; the density is per length. See the module's text."""

    name: ClassVar[str] = "cable"
    title: ClassVar[str] = "Rope, cable or rod with a rest shape of its own"
    equation: ClassVar[str] = (
        "M = B (k - k0 + tau k' + k_f z + c (k - q)), T = GJ (t - t0), N = EA (|x'| - 1)"
    )
    use: ClassVar[str] = "measured ropes, sheathed cables, wire harnesses, foam rods"

    friction_per_m: Annotated[float, Quantity("1/m", "k_f, friction moment over B", 0.0)] = 0.0
    friction_onset_per_m: Annotated[float, Quantity("1/m", "k_o, curvature after which it slips", 0.0)] = 1.0
    creep_ratio: Annotated[float, Quantity("1", "c, stiffness that creeps away over B", 0.0)] = 0.0
    creep_s: Annotated[float, Quantity("s", "T_c, time of creep", 0.0)] = 1.0
    drag_normal_per_m: Annotated[float, Quantity("1/m", "b, quadratic drag across the rod", 0.0)] = 0.0

    @property
    def friction_law(self) -> Law | None:
        """None: its run damps within its own step."""
        return None
