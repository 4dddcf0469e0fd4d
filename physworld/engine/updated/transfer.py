"""Transfer schemes of the updated Lagrangian form: what a particle takes from the grid.

APIC (Jiang et al. 2015) takes the grid's velocity and its gradient. It conserves linear and angular momentum, and loses
what 8 particles a cell know and 1 node a cell does not: a vibrating body is damped (``docs/engine.md`` has figures).

ASFLIP (Fei et al. 2021) gives back a share of the difference between a particle's velocity and the grid's before
forces, and moves particles by it where material opens. Two of the paper's settings are changed, for measured reasons
(``docs/engine.md``). The share counts a substep: with their 0.99 the difference would be gone after a hundred substeps,
which are a few milliseconds here, so solids keep all of it; grains, which come to rest by friction, keep 0.99. And only
grains are moved by it: a solid's deformation gradient does not know of such a move, and a beam creeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class Apic:
    """Affine particle in cell."""

    name: ClassVar[str] = "apic"
    split: ClassVar[bool] = False
    velocity_share: ClassVar[float | None] = 0.0
    separating_volume: ClassVar[float | None] = None


@dataclass(frozen=True)
class Asflip:
    """Affine separable FLIP.

    Attributes:
        velocity_share: share of the velocity that the grid does not see which a particle keeps, a substep; None: 0.99
            for Drucker-Prager grains, else 1.
        separating_volume: elastic volume ratio above which material counts as opening and positions are adjusted too;
            infinite: never, the scheme that the paper calls AFLIP; None: 0.999 for Drucker-Prager grains, else
            infinite.

    Raises:
        ValueError: a share outside [0, 1].
    """

    velocity_share: float | None = None
    separating_volume: float | None = None

    name: ClassVar[str] = "asflip"
    split: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.velocity_share is not None and not 0.0 <= self.velocity_share <= 1.0:
            raise ValueError(f"a velocity share lies in [0, 1], got {self.velocity_share:.4g}")


Transfer = Apic | Asflip
TRANSFERS: dict[str, type[Apic | Asflip]] = {kind.name: kind for kind in (Apic, Asflip)}
