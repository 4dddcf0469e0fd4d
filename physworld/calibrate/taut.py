"""Where the search for a rope that hangs taut begins: it stretches and bends by one section.

Its tension T and its bending stiffness B swing it alike: a wave of number k has the frequency sqrt((T k^2 + B k^4) / m)
for the mass m of a length. More tension hides less bending, down to the next phase. So a start counts in both numbers
at once: octaves of E A, and at each of them octaves of B over E A r^2 / 4, which a homogeneous round section of radius
r has. A hollow one has up to twice as much; of one with many strands, which slide on each other, there is no least
share, but what bends less than a section's sixteenth hardly shows beside the tension.
"""

from __future__ import annotations

from itertools import product

from physworld.calibrate.parameters import BENDING, STRETCHING, Parameter
from physworld.twin.twin import Twin

SECTION_SHARES = (1.0, 1 / 2, 2.0, 1 / 4, 1 / 8, 1 / 16, 1 / 64)


def taut_starts(twin: Twin, parameters: list[Parameter]) -> list[tuple[float, ...]]:
    """Starts of a taut rope, (p,) each, in the parameters' units: what else is searched stays at its first start.

    Args:
        twin: whose radius counts.
        parameters: what is searched (p), E I and E A among them.
    """
    names = [p.name for p in parameters]
    stretch = parameters[names.index(STRETCHING)]
    found = []
    for stretching, share in product(stretch.starts, SECTION_SHARES):
        known = {STRETCHING: stretching, BENDING: share * stretching * twin.body.thickness_m**2 / 4.0}
        found.append(tuple(known.get(p.name, p.starts[0]) for p in parameters))
    return found
