"""No plastic flow: the Hencky-elastic solid itself, eps stays eps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import warp as wp


@wp.func
def _project(
    eps: wp.vec3d, mu: wp.float64, lam: wp.float64, parameters: wp.vec3d, memory: wp.float64, dt: wp.float64
) -> wp.vec4d:
    return wp.vec4d(eps[0], eps[1], eps[2], memory)


@dataclass(frozen=True)
class Identity:
    """Purely elastic in Hencky strain."""

    name: ClassVar[str] = "identity"
    title: ClassVar[str] = "No plastic flow"
    equation: ClassVar[str] = "eps stays eps"
    use: ClassVar[str] = "bodies that do not flow"
    project: ClassVar[Any] = _project
    flows: ClassVar[bool] = False
    granular: ClassVar[bool] = False
    initial_memory: ClassVar[float] = 0.0

    def parameters(self) -> tuple[float, float, float]:
        """None."""
        return 0.0, 0.0, 0.0
