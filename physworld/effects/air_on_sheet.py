"""Air on a sheet: drag across its plane and the mass of the air that it carries, per area.

    (m I + m_a n n^T) a = F + m g - A (b + k |v_n|) v_n n        m_a: added mass, v_n = n . v

Pressure acts along the normal n only. k = C_d rho / 2: at amplitudes of about a width C_d is 3 to 8 (Keulegan and
Carpenter 1958; Graham 1980), so k is some kg/m^3. A wide strip of width w carries pi rho w / 4 per area (Lamb 1932,
article 71), a square half of it: as much as a light cloth weighs. Still air; nothing is shed.

The inertia is put in by the acceleration: of the force along the normal the share m_a / (m + m_a) is taken away, so
this term comes after every other force. Calibrations of measured cloths set it; a trace does not look for it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import warp as wp

from physworld.effects.base import Effect, Strength, Variant
from physworld.engine.problem import HeldNodes, Problem
from physworld.engine.terms.term import BoundTerm

if TYPE_CHECKING:
    from physworld.twin.twin import Twin


@wp.func
def slope(
    i: int, first: wp.array[wp.int32], nodes: wp.array[wp.int32], weights: wp.array[wp.float64],
    x: wp.array[wp.float64],
) -> wp.vec3d:  # fmt: skip
    """A row of a sparse matrix times nodal positions."""
    total = wp.vec3d()
    for k in range(first[i], first[i + 1]):
        j = 3 * nodes[k]
        total += weights[k] * wp.vec3d(x[j], x[j + 1], x[j + 2])
    return total


@wp.kernel(enable_backward=False)
def air_forces(
    # model
    mass: wp.array[wp.float64],
    area: wp.array[wp.float64],
    first_u: wp.array[wp.int32],
    nodes_u: wp.array[wp.int32],
    weights_u: wp.array[wp.float64],
    first_v: wp.array[wp.int32],
    nodes_v: wp.array[wp.int32],
    weights_v: wp.array[wp.float64],
    gravity: wp.vec3d,
    linear: wp.float64,
    quadratic: wp.float64,
    added: wp.float64,
    # in
    x: wp.array[wp.float64],
    v: wp.array[wp.float64],
    # in, out
    force: wp.array[wp.float64],
) -> None:
    """Drag and added inertia of one node along the sheet's normal there."""
    i = wp.tid()
    n = wp.normalize(
        wp.cross(slope(i, first_u, nodes_u, weights_u, x), slope(i, first_v, nodes_v, weights_v, x))
    )
    across = wp.dot(n, wp.vec3d(v[3 * i], v[3 * i + 1], v[3 * i + 2]))
    drag = -area[i] * (linear + quadratic * wp.abs(across)) * across
    pull = drag + wp.dot(n, wp.vec3d(force[3 * i], force[3 * i + 1], force[3 * i + 2]) + mass[i] * gravity)
    carried = added * area[i]
    change = drag - pull * carried / (mass[i] + carried)
    for c in range(3):
        force[3 * i + c] = force[3 * i + c] + change * n[c]


@dataclass(frozen=True)
class SheetAir:
    """Term of :class:`AirOnSheet`."""

    linear: float
    quadratic: float
    added: float

    def bind(self, problem: Problem) -> BoundSheetAir:
        """Device arrays."""
        lattice, device = problem.lattice, problem.device
        arrays: list[Any] = [
            wp.array(values, dtype=wp.float64, device=device)
            for values in (problem.nodal_mass(), lattice.lumped(lattice.particle_measures))
        ]
        for orders in ((1, 0), (0, 1)):
            rows = lattice.interpolation(lattice.node_coordinates, orders)
            arrays += [wp.array(part, dtype=wp.int32, device=device) for part in (rows.indptr, rows.indices)]
            arrays.append(wp.array(rows.data, dtype=wp.float64, device=device))
        arrays.append(wp.vec3d(*problem.gravity_m_s2))
        arrays += [wp.float64(number) for number in (self.linear, self.quadratic, self.added)]
        return BoundSheetAir(tuple(arrays), len(lattice.nodes), self.linear / problem.law.density)


@dataclass(frozen=True)
class BoundSheetAir(BoundTerm):
    """Arrays on the device."""

    model: tuple[Any, ...]
    count: int
    friction_per_s: float
    differentiable = False

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the forces [N]."""
        wp.launch(
            air_forces, dim=self.count, inputs=[*self.model, x, v], outputs=[force], device=force.device
        )


@dataclass(frozen=True)
class AirOnSheet(Effect):
    """``linear_pa_s_m``: b [Pa s/m]; ``quadratic_kg_m3``: k [kg/m^3]; ``added_kg_m2``: m_a [kg/m^2]."""

    name = "air_on_sheet"
    title = "air on a sheet"
    equation = "(m I + m_a n n^T) a = F + m g - A (b + k |v_n|) v_n n"
    kind = "force"
    gates = ("linear_pa_s_m", "quadratic_kg_m3", "added_kg_m2")

    linear_pa_s_m: float = 0.0
    quadratic_kg_m3: float = 0.0
    added_kg_m2: float = 0.0

    @classmethod
    def strengths(cls, twin: Twin) -> tuple[Strength, ...]:
        """Up to what a cloth of half a metre meets."""
        return (
            Strength("linear_pa_s_m", "Pa s/m", 0.0, 5.0, 0.02),
            Strength("quadratic_kg_m3", "kg/m^3", 0.0, 30.0, 0.1),
            Strength("added_kg_m2", "kg/m^2", 0.0, 1.0, 0.01),
        )

    @classmethod
    def variants(cls, twin: Twin) -> list[Variant]:
        """None: a calibration sets it."""
        return []

    @classmethod
    def refuses(cls, twin: Twin) -> str | None:
        """Only smooth sheets have normals at their nodes."""
        if twin.lattice.dim != 2 or not twin.lattice.smooth:
            return f"it acts along the normals of a sheet of splines; here are {twin.lattice.dim} dimensions"
        return None

    def attach(self, problem: Problem, held: HeldNodes, twin: Twin) -> tuple[Problem, HeldNodes]:
        """Adds the term after the others."""
        term = SheetAir(self.linear_pa_s_m, self.quadratic_kg_m3, self.added_kg_m2)
        return replace(problem, terms=(*problem.terms, term)), held
