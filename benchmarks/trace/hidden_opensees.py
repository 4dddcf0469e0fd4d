"""Bodies for ``benchmarks.trace.hidden_effects --set hidden_opensees``, which OpenSees records and how they move.

Ropes that both ends of are held, ropes that hang from a hand, thick ropes, slabs that hang by two corners.
"""

from __future__ import annotations

from typing import Any

from benchmarks.peers.finite_elements import Floats
from benchmarks.trace.hidden_bodies import POISSON
from benchmarks.trace.hidden_kratos import ELEMENTS, ROPE_POISSON, Slab, Strand


class Line(Strand):
    """A rope of OpenSees' beams, held at both ends."""

    def mesh(self, top: Floats, along: Floats) -> Any:
        """See ``Strand``."""
        from benchmarks.peers.opensees_bodies import rod

        return rod(top, along, self.length_m, self.radius_m, self.young_pa, ROPE_POISSON, self.density_kg_m3,
                   ELEMENTS)  # fmt: skip


class HungLine(Line):
    """The same, held at its beginning."""

    hands = 1


class Plate(Slab):
    """A slab of OpenSees' shells."""

    def mesh(self, corner: Floats) -> Any:
        """See ``Slab``."""
        from benchmarks.peers.opensees_bodies import plate

        width, thickness, height = self.size_m
        return plate(corner, width, height, self.cells, thickness, self.young_pa, POISSON, self.density_kg_m3)


OPENSEES: dict[str, Line | Plate] = {
    "strung line": Line(0.38, 0.005, 1.5e6, 1000.0, (1.0, 0.3, 0.0), (0.004, 0.03, 0.02), 0.0),
    "hung line": HungLine(0.45, 0.007, 8e5, 850.0, (0.6, 0.2, -0.8), 0.035, 0.0),
    "thick line": HungLine(0.36, 0.014, 6e5, 800.0, (1.0, 0.0, 0.0), 0.03, 0.0),
    "hung plate": Plate((0.24, 0.012, 0.21), (10, 9), 3e5, 400.0, (0.004, 0.03, 0.02)),
}
