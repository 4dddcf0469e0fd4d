"""Drucker-Prager plasticity of grains, in principal Hencky strains (Klar et al. 2016, section 6.3 and appendix).

    f = |dev eps| + a (3 lambda + 2 mu) / (2 mu) (tr eps - t) <= 0        a = sqrt(2/3) 2 sin phi / (3 - sin phi)

phi is the friction angle and t = c / (K tan phi) the volumetric strain of the cone's tip: 0 for dry grains, more with a
cohesion c (K = lambda + 2/3 mu). Three cases: inside, nothing; tension beyond the tip, all strain goes and the tip
stays; else the deviator shrinks onto the cone at constant trace, flow without dilatancy.

Volume that opened at the tip must close before grains press again (Tampubolon et al. 2017): the memory is the
volumetric strain lost there, and it is added to the trial strain until it is used up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
import warp as wp

from physworld.catalogue import Quantity


@wp.func
def _project(
    eps: wp.vec3d, mu: wp.float64, lam: wp.float64, parameters: wp.vec3d, memory: wp.float64, dt: wp.float64
) -> wp.vec4d:
    three = wp.float64(3.0)
    zero = wp.float64(0.0)
    slope = parameters[0]
    tip = parameters[1] / (lam + wp.float64(2.0) * mu / three)
    before = eps[0] + eps[1] + eps[2]
    trace = before + memory
    third = before / three
    deviator = eps - wp.vec3d(third, third, third)
    size = wp.length(deviator)
    result = wp.vec4d(eps[0], eps[1], eps[2], memory)
    if trace >= tip:
        result = wp.vec4d(tip / three, tip / three, tip / three, trace - tip)
    else:
        excess = size + slope * (three * lam + wp.float64(2.0) * mu) / (wp.float64(2.0) * mu) * (trace - tip)
        kept = wp.float64(1.0)
        if excess > zero:
            kept = wp.float64(1.0) - excess / size
        if excess > zero or memory != zero:
            middle = trace / three
            result = wp.vec4d(
                middle + kept * deviator[0], middle + kept * deviator[1], middle + kept * deviator[2], zero
            )
    return result


@dataclass(frozen=True)
class DruckerPrager:
    """See the module's text.

    Raises:
        ValueError: a friction angle outside (0, pi/2) or a negative cohesion.
    """

    friction_angle_rad: Annotated[float, Quantity("rad", "phi, angle of friction", 0.0, np.pi / 2)]
    cohesion_pa: Annotated[float, Quantity("Pa", "c, shear strength without pressure", 0.0)] = 0.0

    name: ClassVar[str] = "drucker_prager"
    title: ClassVar[str] = "Drucker-Prager plasticity of grains"
    equation: ClassVar[str] = "|dev eps| + a (3 lambda + 2 mu) / (2 mu) (tr eps - t) <= 0"
    use: ClassVar[str] = "sand, soil, snow"
    project: ClassVar[Any] = _project
    flows: ClassVar[bool] = True
    granular: ClassVar[bool] = True
    initial_memory: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        if not (0 < self.friction_angle_rad < np.pi / 2) or self.cohesion_pa < 0:
            raise ValueError(
                f"friction angle must lie in (0, pi/2) and cohesion not below 0, got {self.friction_angle_rad:.4g} rad "
                f"and {self.cohesion_pa:.4g} Pa"
            )

    @property
    def cone_slope(self) -> float:
        """a of the module's text."""
        sine = np.sin(self.friction_angle_rad)
        return float(np.sqrt(2.0 / 3.0) * 2.0 * sine / (3.0 - sine))

    def parameters(self) -> tuple[float, float, float]:
        """(cone slope, mean tension at the tip [Pa], unused)."""
        return self.cone_slope, self.cohesion_pa / float(np.tan(self.friction_angle_rad)), 0.0
