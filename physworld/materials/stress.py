"""What a law of solids hands to the native kernels: the C++ text of its first Piola-Kirchhoff stress P(F).

The text is written once over a scalar type ``S`` and compiled twice: with S a vector of particles it gives the
stress, with S a dual number (value and derivative in one direction) it gives dP = (dP/dF) : dF. It may use

    F[9], cof[9], J     S: deformation gradient, its cofactor J F^-T, its determinant
    H[9]                S: F - I, with all its digits at small strain
    c[]                 V: the law's moduli at the particle times its volume; P must be linear in them
    number[]            float: the law's other numbers, the same in the whole body
    lane::log, sqrt, inverse, floor(S, float), value(S) -> V          and the law's own ``helpers``

and writes ``P[9]``, rows first. A dual number stands on the left of a product with a V or a float.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Stress:
    """C++ of a stress.

    Attributes:
        name: of the kernels that are built from it.
        body: statements that write P.
        helpers: members of the struct ``lane`` that the body calls.
        infinite_at_inversion: the energy is infinite at J = 0: a smaller J than 0.02 is reported, and floored there.
    """

    name: str
    body: str
    helpers: str = ""
    infinite_at_inversion: bool = False
