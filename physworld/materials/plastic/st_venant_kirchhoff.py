"""St. Venant-Kirchhoff solid in Hencky strain that flows above its yield stress with a viscosity (Perzyna).

    d gamma / dt = <|s| - sqrt(2/3) sigma_y> / eta        s = 2 mu dev eps

Backward Euler closes in one line: what exceeds the yield surface shrinks by 1 / (1 + 2 mu dt / eta) a step, as it
decays like exp(-2 mu t / eta) in time. This is the return mapping that the MPM literature names after St. Venant and
Kirchhoff (plastic "foam" and "paste", after Yue et al. 2015, with the exponent 1): eta = 0 is von Mises, an infinite
yield stress the finite-strain elastic solid. The volume is kept.
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
    size = wp.float64(2.0) * mu * wp.length(deviator)
    excess = size - wp.sqrt(wp.float64(2.0) / wp.float64(3.0)) * parameters[0]
    result = wp.vec4d(eps[0], eps[1], eps[2], memory)
    if excess > wp.float64(0.0):
        flowed = excess * wp.float64(2.0) * mu * dt / (parameters[1] + wp.float64(2.0) * mu * dt)
        kept = wp.float64(1.0) - flowed / size
        result = wp.vec4d(
            third + kept * deviator[0],
            third + kept * deviator[1],
            third + kept * deviator[2],
            memory + flowed / (wp.float64(2.0) * mu),
        )
    return result


@dataclass(frozen=True)
class StVenantKirchhoff:
    """See the module's text.

    Raises:
        ValueError: a negative yield stress or viscosity.
    """

    yield_stress_pa: Annotated[float, Quantity("Pa", "sigma_y, at which simple tension flows", 0.0)] = float(
        "inf"
    )
    flow_viscosity_pa_s: Annotated[float, Quantity("Pa s", "eta; 0: flows at once", 0.0)] = 0.0

    name: ClassVar[str] = "st_venant_kirchhoff"
    title: ClassVar[str] = "St. Venant-Kirchhoff solid with viscous flow"
    equation: ClassVar[str] = "d gamma/dt = <|s| - sqrt(2/3) sigma_y> / eta"
    use: ClassVar[str] = "foam and paste that flow slowly"
    project: ClassVar[Any] = _project
    flows: ClassVar[bool] = True
    granular: ClassVar[bool] = False
    initial_memory: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        if not (self.yield_stress_pa >= 0 and self.flow_viscosity_pa_s >= 0):
            raise ValueError(
                f"yield stress and viscosity must not be negative, got {self.yield_stress_pa:.4g} Pa and "
                f"{self.flow_viscosity_pa_s:.4g} Pa s"
            )

    def parameters(self) -> tuple[float, float, float]:
        """(sigma_y, eta, unused)."""
        return self.yield_stress_pa, self.flow_viscosity_pa_s, 0.0
