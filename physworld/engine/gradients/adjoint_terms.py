"""The reverse pass of terms: d(w . f) / dx and / dv of whatever a bound term adds to the forces.

Terms of three kinds are taken back here:

* a term of plain Warp kernels: its launches are recorded once on a tape, and Warp's own adjoint kernels are launched;
* a :class:`physworld.engine.total.stress.BoundStress`: native code, by
:mod:`physworld.engine.gradients.adjoint_stress_kernels`;
* the twist of a rope, in closed form.

Growing stiffness multiplies the forces that are there: what came before it sees a multiplied w.

Memory that a term carries from substep to substep (``BoundTerm.memory``) is kept row by row in the forward pass and put
back here; its derivatives run backwards beside those of the state.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.gradients.adjoint_kernels import keep_rows, load_row, take_away
from physworld.engine.gradients.adjoint_stress_kernels import MOST_NUMBERS, stress_adjoint
from physworld.engine.problem import Problem
from physworld.engine.terms.term import BoundTerm
from physworld.engine.thin.twist import BoundTwist
from physworld.engine.thin.twist_kernels import push_twisted_along, turn_spans_along
from physworld.engine.total.stress import BoundStress
from physworld.errors import NotDifferentiable


@dataclass(frozen=True)
class Reverse:
    """Device arrays of a reverse pass.

    Attributes:
        x, v: state before the substep, (3n,) float64.
        clock, counter: as in a run.
        offset: first row of every frame in the histories.
        pull: all forces over the masses, of free nodes [m/s^2], (3n,).
        force_bar: w, derivatives by the forces (3n,).
        x_bar, v_bar: derivatives by the state, to be added to.
        mass_bar, drag_bar: derivatives by the nodal masses and by the nodes' drag rates, (n,), to be added to.
        gravity_bar: by the gravity of every node, (3n,), to be added to.
    """

    x: wp.array
    v: wp.array
    clock: wp.array
    counter: wp.array
    offset: wp.array
    pull: wp.array
    force_bar: wp.array
    x_bar: wp.array
    v_bar: wp.array
    mass_bar: wp.array
    drag_bar: wp.array
    gravity_bar: wp.array


class Memory:
    """Rows of one memory array, and the derivatives by it.

    Attributes:
        now: the term's array as flat numbers of its own precision.
        rows: what it held before every substep, (rows + 1, size) float64.
        bar: derivatives by it, (size,) float64.
    """

    def __init__(self, array: wp.array, rows: int) -> None:
        self.now = flat(array)
        self.rows = wp.zeros((rows + 1, len(self.now)), dtype=wp.float64, device=array.device)
        self.bar = wp.zeros(len(self.now), dtype=wp.float64, device=array.device)

    @property
    def nbytes(self) -> int:
        """Bytes of the rows."""
        return int(self.rows.size * 8)

    def keep(self, offset: wp.array, counter: wp.array) -> None:
        """After a substep: the memory goes into the row of the next."""
        wp.launch(keep_rows, dim=len(self.now), inputs=[offset, counter, self.now], outputs=[self.rows],
                  device=self.now.device)  # fmt: skip

    def put_back(self, offset: wp.array, counter: wp.array) -> None:
        """The memory as it was before the substep."""
        wp.launch(load_row, dim=len(self.now), inputs=[offset, counter, self.rows], outputs=[self.now],
                  device=self.now.device)  # fmt: skip


class TermAdjoint(Protocol):
    """The reverse pass of one bound term."""

    def take_back(self, now: Reverse) -> None:
        """Add this term's products to ``now.x_bar`` and ``now.v_bar``; part of the captured graph."""
        ...


def memories_of(term: BoundTerm, rows: int) -> list[Memory]:
    """One for each array that the term remembers."""
    return [Memory(array, rows) for array in getattr(term, "memory", ())]


class RecordedAdjoint:
    """A term of plain Warp kernels.

    Attributes:
        differentiated_bar: derivatives by the term's array of that name, as flat numbers; None where it has none.

    Args:
        term: bound to the run.
        mass: of the nodes (n,) [kg].
        now: state and derivatives of the substep that is taken back.
        memories: of the term, recorded by the run.

    Raises:
        NotDifferentiable: one of the term's kernels has no backward pass.
    """

    def __init__(self, term: BoundTerm, mass: Array, now: Reverse, memories: list[Memory]) -> None:
        self._term, self._memories = term, memories
        self._scratch = wp.zeros_like(now.force_bar)
        self._launches = launches_of(term, now, self._scratch)
        known = {now.x.ptr: now.x_bar, now.v.ptr: now.v_bar, self._scratch.ptr: now.force_bar}
        asked = getattr(term, "differentiated", None)
        self.differentiated_bar = None if asked is None else wp.zeros_like(asked)
        if asked is not None:
            known[asked.ptr] = self.differentiated_bar
        self._new_bars = [wp.zeros_like(memory.bar) for memory in memories]
        by_pointer = {memory.now.ptr: bar for memory, bar in zip(memories, self._new_bars, strict=True)}
        self._bars = []
        for launch in self._launches:
            kernel, arguments = launch[0], [*launch[3], *launch[4]]
            if kernel.options.get("enable_backward") is False or (
                kernel.options.get("enable_backward") is None
                and kernel.module.options["enable_backward"] is False
            ):
                raise NotDifferentiable(f"kernel {kernel.key} of {type(term).__name__} has no backward pass")
            self._bars.append([self._bar_of(a, known, by_pointer, mass, now) for a in arguments])

    def take_back(self, now: Reverse) -> None:
        """Run the launches again for what they hand on to each other, then their adjoint kernels, last first."""
        if len(self._launches) > 1:
            self._restore(now)
            self._term.launch(now.x, now.v, now.clock, now.counter, self._scratch)
        self._restore(now)
        for memory, bar in zip(self._memories, self._new_bars, strict=True):
            wp.copy(bar, memory.bar)
        for launch, bars in zip(reversed(self._launches), reversed(self._bars), strict=True):
            kernel, dim, _, inputs, outputs, device = launch[:6]
            wp.launch(
                kernel, dim, inputs=inputs, outputs=outputs, adj_inputs=bars[: len(inputs)],
                adj_outputs=bars[len(inputs) :], device=device, adjoint=True,
            )  # fmt: skip
        # Warp leaves the derivative by what a kernel overwrote where it was and adds that by what it read
        for memory, bar in zip(self._memories, self._new_bars, strict=True):
            wp.launch(take_away, dim=len(bar), inputs=[bar], outputs=[memory.bar], device=bar.device)

    def _restore(self, now: Reverse) -> None:
        for memory in self._memories:
            memory.put_back(now.offset, now.counter)

    @staticmethod
    def _bar_of(
        value: Any, known: dict[int, wp.array], memories: dict[int, wp.array], mass: Array, now: Reverse
    ) -> Any:
        """Where the derivative by an argument goes; None where nobody asks, a zero for a number."""
        if not isinstance(value, wp.array):
            return value
        if value.ptr in known:
            return known[value.ptr]
        if value.ptr in memories:
            return aliased(memories[value.ptr], value)
        is_mass = (
            value.dtype is wp.float64 and value.shape == mass.shape and np.array_equal(value.numpy(), mass)
        )
        return now.mass_bar if is_mass else None


class StressAdjoint:
    """A stress beside the law.

    Attributes:
        parameters_bar, fields_bar: derivatives by the model's numbers (k,) and by its fields, (layers * P,).
    """

    def __init__(self, term: BoundStress, problem: Problem, memories: list[Memory]) -> None:
        lattice, device = problem.lattice, problem.device
        tables = []
        for order in problem.law.strain_orders:
            size = 1.0 if lattice.dim == 3 else np.prod(lattice.spacing ** np.array(order))
            tables.append(lattice.table(order) / size)

        def array(values: Any) -> wp.array:
            return wp.array(
                np.ascontiguousarray(values, dtype=float).reshape(-1), dtype=wp.float64, device=device
            )

        parameters, fields = term.numbers.numpy().astype(float), term.fields.numpy().astype(float)
        layers = len(fields) // lattice.fill.size
        if max(len(parameters), layers) > MOST_NUMBERS:
            raise NotDifferentiable(
                f"a stress model of {len(parameters)} numbers and {layers} fields; at most {MOST_NUMBERS} of each"
            )
        inverse = wp.vec3d(*(1.0 / lattice.spacing)) if lattice.dim == 3 else wp.vec3d()
        self._kernel, self._cells, self._memories = stress_adjoint(term.model), len(lattice.cells), memories
        self._inputs = [
            self._cells, array(lattice.cell_nodes), array(np.stack(tables, axis=1)), array(problem.rest), inverse,
            array(parameters), array(fields),
        ]  # fmt: skip
        self._inputs[1] = wp.array(lattice.cell_nodes.reshape(-1), dtype=wp.int32, device=device)
        self._nothing = (wp.zeros((1, 1), dtype=wp.float64, device=device), array([0.0]))
        self.parameters_bar, self.fields_bar = array(0 * parameters), array(0 * fields)

    def take_back(self, now: Reverse) -> None:
        """One launch over the cells."""
        rows, bar = (self._memories[0].rows, self._memories[0].bar) if self._memories else self._nothing
        wp.launch(
            self._kernel, dim=self._cells,
            inputs=[*self._inputs, now.clock, now.counter, now.offset, now.x, rows, now.force_bar, bar],
            outputs=[now.x_bar, self.parameters_bar, self.fields_bar], device=now.x.device,
        )  # fmt: skip


class TwistAdjoint:
    """One bound twist's reverse pass.

    Twist forces are minus the gradient of an energy, so d(w . f)/dx is the change of the forces with the nodes along w,
    found in closed form (:mod:`physworld.engine.thin.twist_kernels`). The angle of the last substep only counts turns:
    nothing is differentiated through it. How the grips turn is given; a scalar that changes it is differenced as every
    other term is (:mod:`physworld.engine.gradients.gradient`).
    """

    def __init__(self, term: BoundTwist, memories: list[Memory]) -> None:
        self._term, self._memories = term, memories
        points, device = len(term.span_of), term.device
        self._along_rate = wp.zeros(points, dtype=wp.vec3d, device=device)
        self._moment_rate = wp.zeros(term.spans, dtype=wp.float64, device=device)
        self._by_log_stiffness = wp.zeros(term.spans, dtype=wp.float64, device=device)

    @property
    def log_stiffness(self) -> Array:
        """Derivatives by the logarithms of the particles' stiffness, (P,): their sum is that by GJ's logarithm."""
        slopes: Array = self._by_log_stiffness.numpy() @ self._term.shares
        return slopes

    def take_back(self, now: Reverse) -> None:
        """Add the products to ``now.x_bar``."""
        term, state = self._term, self._term.state
        for memory in self._memories:
            memory.put_back(now.offset, now.counter)
        term.turn(now.x, now.clock, now.counter)
        rates = [self._along_rate, self._moment_rate]
        wp.launch(
            turn_spans_along, dim=term.spans,
            inputs=[term.begins, *term.rows, term.compliance, *state.geometry, state.moment, now.force_bar],
            outputs=[*rates, self._by_log_stiffness], device=term.device,
        )  # fmt: skip
        wp.launch(
            push_twisted_along, dim=len(term.span_of),
            inputs=[term.begins, term.span_of, *term.rows, *state.geometry, state.moment, *rates, now.force_bar],
            outputs=[now.x_bar], device=term.device,
        )  # fmt: skip


def launches_of(term: BoundTerm, now: Reverse, force: wp.array) -> list[list[Any]]:
    """The kernel launches of a term as Warp's tape records them, with forces going to ``force`` (3n,)."""
    kept = [wp.clone(array) for array in getattr(term, "memory", ())]
    with wp.Tape() as tape:
        term.launch(now.x, now.v, now.clock, now.counter, force)
    for array, before in zip(getattr(term, "memory", ()), kept, strict=True):
        wp.copy(array, before)
    return list(tape.launches)


def flat(array: wp.array) -> wp.array:
    """The same memory as a flat array of numbers of its own precision."""
    values = array.numpy()
    dtype = {4: wp.float32, 8: wp.float64}[values.dtype.itemsize]
    return wp.array(ptr=array.ptr, dtype=dtype, shape=(values.size,), device=array.device, deleter=None)


def aliased(bar: wp.array, like: wp.array) -> wp.array:
    """Flat double derivatives seen with the shape and type of an array."""
    return wp.array(ptr=bar.ptr, dtype=like.dtype, shape=like.shape, device=bar.device, deleter=None)
