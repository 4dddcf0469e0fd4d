"""Internal forces of one lattice under one law: what a formulation launches every substep.

An :class:`InternalForces` owns the device arrays of the law (stiffness times measure at every particle, tables of
spline derivatives) and launches the kernel of its dimension. It knows nothing of time steps, grips or gravity.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.lattice.lattice import Lattice
from physworld.engine.thin.rod_kernels import rod_forces
from physworld.engine.thin.sheet_kernels import sheet_forces
from physworld.engine.thin.triangle_kernels import triangle_forces
from physworld.engine.thin.triangles import TriangleLattice
from physworld.engine.total.solid_kernels import solid_forces
from physworld.errors import BatchRefused, SceneUnsupported
from physworld.materials.laws import Law
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import SheetLaw
from physworld.materials.solid import SolidLaw


@dataclass(frozen=True)
class _Bodies:
    """What the bodies of one shape have of their own.

    Attributes:
        kernel: the kernel of a law.
        inputs: what it takes as its model; arguments are those of :func:`model_inputs`.
        memory: numbers a cell that friction remembers from the last substep.
        shared: the inputs that belong to a law and a lattice, not to a particle: place and name.
    """

    kernel: Callable[[Any], wp.Kernel]
    inputs: Callable[[Any, Any, Array, Array, str], list[Any]]
    memory: int
    shared: Mapping[int, str]


class InternalForces:
    """Forces of a body of dimension 1, 2 or 3.

    Args:
        lattice: the reference body.
        law: its constitutive parameters; must fit the lattice's dimension.
        stiffness_factor: factor on every stiffness and on the friction, a particle, (P,).
        rest: nodal positions of the undeformed body in the world [m], (n, 3); used by solids.
        device: Warp device.

    Raises:
        ValueError: the law is of another dimension.
    """

    def __init__(self, lattice: Lattice, law: Law, stiffness_factor: Array, rest: Array, device: str) -> None:
        model = _of(lattice, law).inputs(lattice, law, stiffness_factor, rest, device)
        self._own(lattice, law, model, 1, device)

    def _own(self, lattice: Lattice, law: Law, model: list[Any], bodies: int, device: str) -> None:
        known = _of(lattice, law)
        cells = bodies * len(lattice.cells)
        if isinstance(lattice, TriangleLattice):
            cells = len(lattice.triangles) + len(lattice.hinges[0])
        self.device, self.cells, self._model = device, cells, model
        self._kernel = known.kernel(law)
        self._solid = lattice.dim == 3
        self.memory = wp.zeros(
            cells * known.memory, dtype=wp.float32 if self._solid else wp.float64, device=device
        )
        self.inverted = wp.zeros(cells, dtype=wp.int32, device=device)

    def launch(self, x: wp.array, clock: wp.array, force: wp.array) -> None:
        """Add the forces [N] at nodal positions ``x`` (3n,) to ``force`` (3n,); ``clock[1]`` is 1/dt [1/s]."""
        wp.launch(
            self._kernel,
            dim=self.cells,
            inputs=[*self._model, clock, x, self.memory],
            outputs=[force, self.inverted] if self._solid else [force],
            device=self.device,
        )


class ForcesSideBySide(InternalForces):
    """Forces of several bodies on copies of one lattice, in one launch: body after body, nodes and cells alike.

    Args:
        lattice: the reference body of all of them.
        laws: one for each; they may differ in what is multiplied with a particle's measure (moduli, viscosity), not in
            what the whole law shares (``shared`` of the bodies of a shape).
        stiffness_factors: (P,) for each.
        rests: nodal positions of the undeformed bodies in the world [m], (n, 3) for each.
        device: Warp device.

    Raises:
        BatchRefused: the laws differ in what they must share.
    """

    def __init__(
        self,
        lattice: Lattice,
        laws: Sequence[Law],
        stiffness_factors: Sequence[Array],
        rests: Sequence[Array],
        device: str,
    ) -> None:
        for law in laws:
            if law.name != laws[0].name:
                raise BatchRefused(f"one kernel integrates one law; here are {laws[0].name} and {law.name}")
        bodies = [
            model_inputs(lattice, law, factor, rest, device)
            for law, factor, rest in zip(laws, stiffness_factors, rests, strict=True)
        ]
        model = _joined(lattice, laws[0], bodies, device)
        self._own(lattice, laws[0], model, len(laws), device)


def _joined(lattice: Lattice, law: Law, bodies: list[list[Any]], device: str) -> list[Any]:
    """The model inputs of bodies side by side from those of each; see :func:`model_inputs` for their order."""
    offsets = np.arange(len(bodies))[:, None] * len(lattice.nodes)
    nodes = (lattice.cell_nodes.reshape(1, -1) + offsets).reshape(-1)
    shared = _of(lattice, law).shared
    joined: list[Any] = [wp.array(nodes, dtype=wp.int32, device=device)]
    for place, first in enumerate(bodies[0][1:-1], start=1):
        each = [body[place] for body in bodies]
        if place not in shared:
            values = np.concatenate([values.numpy() for values in each])
            joined.append(wp.array(values, dtype=first.dtype, device=device))
            continue
        for number, other in enumerate(each):
            if not np.array_equal(_numbers(first), _numbers(other)):
                raise BatchRefused(
                    f"bodies side by side share the {shared[place]} of their law ({law.name}): "
                    f"{_numbers(first)} of the first, {_numbers(other)} of number {number}"
                )
        joined.append(first)
    return [*joined, max(body[-1] for body in bodies)]


def _numbers(value: Any) -> Array:
    numbers: Array
    if isinstance(value, wp.array):
        numbers = value.numpy()
    else:
        numbers = np.atleast_1d(np.array(getattr(value, "value", value), dtype=float))
    return numbers


def model_inputs(lattice: Lattice, law: Law, stiffness_factor: Array, rest: Array, device: str) -> list[Any]:
    """What the kernels of a dimension take as their model: arrays on the device, then whether there is friction.

    Args:
        lattice: the reference body.
        law: of the lattice's dimension.
        stiffness_factor: factor on every stiffness and on the friction, a particle, (P,).
        rest: nodal positions of the undeformed body [m], (n, 3); used by solids.
        device: Warp device.

    Raises:
        ValueError: the law is of another dimension.
    """
    return _of(lattice, law).inputs(lattice, law, stiffness_factor, rest, device)


def _of(lattice: Lattice, law: Law) -> _Bodies:
    if law.dimension != lattice.dim:
        raise ValueError(f"a {type(law).__name__} does not fit a lattice of dimension {lattice.dim}")
    return _TRIANGLES if isinstance(lattice, TriangleLattice) else _SPLINES[lattice.dim]


def _uploaded(values: Any, dtype: Any, device: str) -> wp.array:
    return wp.array(np.ascontiguousarray(values).reshape(-1), dtype=dtype, device=device)


def _solid_inputs(
    lattice: Lattice, law: SolidLaw, stiffness_factor: Array, rest: Array, device: str
) -> list[Any]:
    def array(values: Any, dtype: Any = wp.float32) -> wp.array:
        return _uploaded(values, dtype, device)

    measure = lattice.particle_measures * stiffness_factor
    slopes = np.stack([lattice.table(order) for order in law.strain_orders], axis=1)
    moduli = measure.reshape(len(lattice.cells), 1, -1) * np.array(law.moduli)[:, None]
    return [
        array(lattice.cell_nodes, wp.int32), array(slopes), array(rest, wp.float64), array(moduli),
        array(law.viscosity_pa_s * measure), array([*law.numbers, 0.0]), wp.vec3f(*(1.0 / lattice.spacing)),
        int(law.viscosity_pa_s > 0),
    ]  # fmt: skip


def _sheet_inputs(
    lattice: Lattice, law: SheetLaw, stiffness_factor: Array, rest: Array, device: str
) -> list[Any]:
    def array(values: Any, dtype: Any = wp.float64) -> wp.array:
        return _uploaded(values, dtype, device)

    measure = lattice.particle_measures * stiffness_factor
    derivatives = [lattice.table(o) / np.prod(lattice.spacing ** np.array(o)) for o in law.strain_orders]
    return [
        array(lattice.cell_nodes, wp.int32), array(np.stack(derivatives, axis=1)),
        array(law.membrane_n_m * measure), array(law.bending_n_m * measure),
        array([*law.membrane_shape, *law.bending_shape]), wp.float64(law.relaxation_s), int(law.relaxation_s > 0),
    ]  # fmt: skip


def _rod_inputs(
    lattice: Lattice, law: RodLaw, stiffness_factor: Array, rest: Array, device: str
) -> list[Any]:
    def array(values: Any, dtype: Any = wp.float64) -> wp.array:
        return _uploaded(values, dtype, device)

    measure = lattice.particle_measures * stiffness_factor
    derivatives = [lattice.table((o,)) / lattice.spacing[0] ** o for (o,) in law.strain_orders]
    return [
        array(lattice.cell_nodes, wp.int32), array(np.stack(derivatives, axis=1)),
        array(law.stretching_n * measure), array(law.bending_n_m2 * measure), wp.float64(law.relaxation_s),
        int(law.relaxation_s > 0),
    ]  # fmt: skip


def _triangle_inputs(
    lattice: TriangleLattice, law: SheetLaw, stiffness_factor: Array, rest: Array, device: str
) -> list[Any]:
    """Of a mesh of triangles, of which two make a cell; they and the edges take the mean of its particles.

    Raises:
        SceneUnsupported: the law bends otherwise than an isotropic sheet, which hinges cannot.
    """
    plain = (1.0, 1.0, law.poissons_ratio, 1.0 - law.poissons_ratio)
    if not np.allclose(law.bending_shape, plain):
        raise SceneUnsupported(
            f"the hinges of {len(lattice.cells)} cells of triangles have one bending stiffness; ratios of weft, twist "
            f"and coupling make {law.bending_shape} of {plain}: leave them at 1"
        )

    def array(values: Any, dtype: Any = wp.float64) -> wp.array:
        return _uploaded(values, dtype, device)

    factor = stiffness_factor.reshape(len(lattice.cells), -1).mean(axis=1)
    edges, weights, areas = lattice.hinges
    membrane = law.membrane_n_m * lattice.areas * np.repeat(factor, 2)
    bending = law.bending_n_m / areas * factor[lattice.hinge_cells].mean(axis=1)
    return [
        len(lattice.triangles), array(lattice.triangles, wp.int32), array(lattice.slopes), array(membrane),
        array(law.membrane_shape), array(edges, wp.int32), array(weights), array(bending),
        wp.float64(law.relaxation_s), int(law.relaxation_s > 0),
    ]  # fmt: skip


_SPLINES = {
    3: _Bodies(
        lambda law: solid_forces(law.stress, len(law.moduli)), _solid_inputs, 72,
        {1: "gradients", 5: "numbers", 6: "cell size"},
    ),
    2: _Bodies(
        lambda law: sheet_forces, _sheet_inputs, 24, {1: "derivatives", 4: "shape ratios", 5: "relaxation time"}
    ),
    1: _Bodies(lambda law: rod_forces, _rod_inputs, 12, {1: "derivatives", 4: "relaxation time"}),
}  # fmt: skip
_TRIANGLES = _Bodies(lambda law: triangle_forces, _triangle_inputs, 24, {})
