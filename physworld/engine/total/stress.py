"""Stresses beside a law's own as terms: a model of :mod:`physworld.engine.total.stress_kernels` with its numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.terms.term import BoundTerm
from physworld.engine.total.stability import fastest_frequency
from physworld.engine.total.stress_kernels import StressModel
from physworld.engine.updated.stress_kernels import particle_model
from physworld.engine.updated.terms import BoundParticleStress, ParticleBody
from physworld.errors import SceneUnsupported

if TYPE_CHECKING:
    from physworld.engine.problem import Problem


@dataclass(frozen=True)
class StressTerm:
    """A model with its numbers.

    Attributes:
        model: one for every dimension that the effect covers, in any order.
        parameters: what PARAMETER(k) reads.
        fields: what FIELD(1), FIELD(2), … read, (k, P), or None.
        frequency_rad_s: what it adds to the fastest mode; None: found by power iteration about the rest state, with
            memory empty (a model that softens gives 0 there).
        name: of the effect, for messages.
    """

    model: StressModel
    parameters: tuple[float, ...]
    fields: Array | None = None
    frequency_rad_s: float | None = None
    name: str = "a stress beside the law's"

    def on_particles(self, body: ParticleBody) -> BoundModel:
        """The model on particles.

        Raises:
            SceneUnsupported: the body flows, and its particles do not know their whole deformation.
        """
        problem = body.problem
        if body.flows:
            raise SceneUnsupported(
                f"{self.name} reads the whole deformation, and a flow law forgets what flowed of it"
            )
        factor = 1.0 if problem.stiffness_factor is None else problem.stiffness_factor
        fields = [problem.lattice.particle_measures * factor, *([] if self.fields is None else self.fields)]
        rows = np.zeros((len(fields), body.padded), dtype=np.float32)
        rows[:, : len(body.solid)] = np.stack(fields)[:, body.solid]
        frequency = self.bind(problem).frequency_rad_s
        return BoundModel(self.model, self.parameters, rows, problem.device, frequency)

    def bind(self, problem: Problem) -> BoundStress:
        """Device arrays; raises ValueError where the model is of another dimension."""
        lattice, device = problem.lattice, problem.device
        if lattice.dim != self.model.dim:
            raise ValueError(f"a model of dimension {self.model.dim} on a lattice of dimension {lattice.dim}")
        real = wp.float32 if lattice.dim == 3 else wp.float64

        def array(values: Any, dtype: Any = real) -> wp.array:
            return wp.array(np.ascontiguousarray(values).reshape(-1), dtype=dtype, device=device)

        factor = 1.0 if problem.stiffness_factor is None else problem.stiffness_factor
        fields = [lattice.particle_measures * factor, *([] if self.fields is None else self.fields)]
        cells, spacing, orders = len(lattice.cells), lattice.spacing, problem.law.strain_orders
        inputs = [cells, self.model.rows, array(lattice.cell_nodes, wp.int32)]
        if lattice.dim == 3:
            slopes = np.stack([lattice.table(o) for o in orders], axis=1)
            inputs += [array(slopes), array(problem.rest, wp.float64), wp.vec3f(*(1.0 / spacing))]
        else:
            inputs += [
                array(np.stack([lattice.table(o) / np.prod(spacing ** np.array(o)) for o in orders], axis=1))
            ]
        inputs += [array(self.parameters or (0.0,)), array(np.stack(fields))]
        state = wp.zeros(max(1, self.model.rows * lattice.fill.size), dtype=real, device=device)
        bound = BoundStress(self.model, cells, inputs, state, device, 0.0)
        if self.frequency_rad_s is not None:
            bound.frequency_rad_s = self.frequency_rad_s
        else:
            bound.frequency_rad_s = fastest_frequency(
                _AboutRest(bound), problem.rest, problem.nodal_mass(), float(spacing.min())
            )
            state.zero_()
        return bound


@dataclass
class BoundStress(BoundTerm):
    """A stress term whose arrays live on a device; the last two of its inputs are the numbers and the fields."""

    model: StressModel
    cells: int
    inputs: list[Any]
    state: wp.array
    device: str
    frequency_rad_s: float

    def __post_init__(self) -> None:
        self.memory = (self.state,) if self.model.rows else ()

    @property
    def numbers(self) -> wp.array:
        """What PARAMETER(k) reads."""
        return self.inputs[-2]

    @property
    def fields(self) -> wp.array:
        """What FIELD(k) reads, (layers * P,)."""
        return self.inputs[-1]

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """Add the forces [N] of the model's stresses.

        Args:
            x, v, clock, counter, force: as in :meth:`BoundTerm.launch`.
        """
        wp.launch(
            self.model.kernel,
            dim=self.cells,
            inputs=[*self.inputs, clock, counter, x, self.state],
            outputs=[force],
            device=self.device,
        )


class BoundModel(BoundParticleStress):
    """A model on the particles of the updated Lagrangian form.

    Args:
        model: what sets the stress.
        parameters: what PARAMETER(k) reads.
        fields: what FIELD(k) reads, (k, P padded) float32.
        device: Warp device.
        frequency_rad_s: what it adds to the fastest mode.
    """

    def __init__(
        self,
        model: StressModel,
        parameters: tuple[float, ...],
        fields: Array,
        device: str,
        frequency_rad_s: float,
    ) -> None:
        self.frequency_rad_s, self._device, self._groups = frequency_rad_s, device, fields.shape[1] // 8
        self._kernel = particle_model(model.text)
        numbers = np.array(parameters or (0.0,), dtype=np.float32)
        self._inputs = [
            self._groups, model.rows, wp.array(numbers, dtype=wp.float32, device=device),
            wp.array(fields.reshape(-1), dtype=wp.float32, device=device),
        ]  # fmt: skip
        self._state = wp.zeros(max(1, model.rows * fields.shape[1]), dtype=wp.float32, device=device)

    def launch(self, F: wp.array, stress: wp.array, clock: wp.array, counter: wp.array) -> None:
        """Add the model's stress.

        Args:
            F, stress, clock, counter: as in :meth:`BoundParticleStress.launch`.
        """
        flat = wp.array(ptr=F.ptr, dtype=wp.float64, shape=9 * len(F), device=self._device)
        wp.launch(
            self._kernel, dim=self._groups, inputs=[*self._inputs, clock, counter, flat],
            outputs=[self._state, stress], device=self._device,
        )  # fmt: skip


class _AboutRest:
    """A bound stress as power iteration takes it: in the middle of a run, no time passing."""

    def __init__(self, bound: BoundStress) -> None:
        self.device = bound.device
        self._bound = bound
        self._counter = wp.array([0, 1, 1], dtype=wp.int32, device=bound.device)

    def launch(self, x: wp.array, clock: wp.array, force: wp.array) -> None:
        self._bound.launch(x, x, clock, self._counter, force)
