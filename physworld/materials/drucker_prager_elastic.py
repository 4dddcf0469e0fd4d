"""The elastic law that goes with Drucker-Prager plasticity of sand and soil (Klar et al. 2016, section 4).

    W = mu ln U : ln U + lambda/2 (tr ln U)^2

It is the quadratic Hencky law, the same stress as :mod:`physworld.materials.hencky`: on the logarithmic strain the cone
|dev ln U| <= -alpha tr ln U has a return mapping in closed form. Here without the yield condition: the total Lagrangian
form cannot flow. It has a name of its own, since that is what a choice among elastic laws is asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from physworld.materials.hencky import Hencky


@dataclass(frozen=True)
class DruckerPragerElastic(Hencky):
    """Quadratic Hencky law of granular matter, without yield: see the module's text."""

    name: ClassVar[str] = "drucker_prager_elastic"
    title: ClassVar[str] = "Elastic part of Drucker-Prager plasticity"
    use: ClassVar[str] = "sand and soil before they yield"
