"""Von Mises (J2) plasticity with linear isotropic hardening, in principal Hencky strains.

    f = |s| - sqrt(2/3) (sigma_y + h a) <= 0        s = 2 mu dev eps, a accumulated plastic strain

Radial return (Simo and Hughes 1998, box 3.1): with f > 0 at the trial strain,

    dgamma = f / (2 mu + 2/3 h)      eps <- eps - dgamma s / |s|      a <- a + sqrt(2/3) dgamma

The trace of eps stays, so plastic flow keeps the volume. In simple tension it yields at the stress sigma_y.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import warp as wp

from physworld.catalogue import Quantity


@wp.func
def _project(
    eps: wp.vec3d, mu: wp.float64, lam: wp.float64, parameters: wp.vec3d, memory: wp.float64, dt: wp.float64
) -> wp.vec4d:
    third = (eps[0] + eps[1] + eps[2]) / wp.float64(3.0)
    deviator = eps - wp.vec3d(third, third, third)
    size = wp.length(deviator)
    root = wp.sqrt(wp.float64(2.0) / wp.float64(3.0))
    excess = wp.float64(2.0) * mu * size - root * (parameters[0] + parameters[1] * memory)
    result = wp.vec4d(eps[0], eps[1], eps[2], memory)
    if excess > wp.float64(0.0):
        slip = excess / (wp.float64(2.0) * mu + wp.float64(2.0) / wp.float64(3.0) * parameters[1])
        kept = wp.float64(1.0) - slip / size
        result = wp.vec4d(
            third + kept * deviator[0],
            third + kept * deviator[1],
            third + kept * deviator[2],
            memory + root * slip,
        )
    return result


@dataclass(frozen=True)
class VonMises:
    """See the module's text.

    Raises:
        ValueError: a negative yield stress or hardening.
    """

    yield_stress_pa: Annotated[float, Quantity("Pa", "sigma_y, at which simple tension yields", 0.0)]
    hardening_pa: Annotated[float, Quantity("Pa", "h, growth of sigma_y per plastic strain", 0.0)] = 0.0

    name: ClassVar[str] = "von_mises"
    title: ClassVar[str] = "Von Mises plasticity with linear hardening"
    equation: ClassVar[str] = "|s| - sqrt(2/3) (sigma_y + h a) <= 0"
    use: ClassVar[str] = "metals, clay, dough"
    project: ClassVar[Any] = _project
    flows: ClassVar[bool] = True
    granular: ClassVar[bool] = False
    initial_memory: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        if self.yield_stress_pa < 0 or self.hardening_pa < 0:
            raise ValueError(
                f"yield stress and hardening must not be negative, got {self.yield_stress_pa:.4g} Pa and "
                f"{self.hardening_pa:.4g} Pa"
            )

    def parameters(self) -> tuple[float, float, float]:
        """(sigma_y, h, unused)."""
        return self.yield_stress_pa, self.hardening_pa, 0.0
