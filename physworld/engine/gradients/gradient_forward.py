"""Forward sensitivities: how a whole run moves with a few scalars, carried along with the state.

For a handful of global numbers and every tracked point at once (a Gauss-Newton step, an interval) this is the cheap
direction; for fields it is the reverse pass (:mod:`physworld.engine.gradients.adjoint`). The tangent (dx, dv) of the
state takes a step with every substep (:mod:`physworld.engine.gradients.gradient_forward_kernels`). Of the derivative of
its forces

    df = df/dx dx + df/dv dv + df/dtheta

the elastic part of the first is :class:`physworld.engine.gradients.tangent.InternalTangent`. The rest (terms, friction
with its memory, the scalar itself) is the difference of two neighbours that stand beside the state, at x +- w dx / 2, v
+- w dv / 2 and theta +- w / 2 with the memory that belongs there: they are put back beside the state in every substep,
so that their distance never leaves the linear range.

The tangents ride on a run as its last term, so the state is that of the engine to the last bit. Friction is explicit,
however strong.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.gradients.gradient import Direction, Setting, internal_forces, same_internal_forces
from physworld.engine.gradients.gradient_forward_kernels import add_slope, advance_tangent, set_sides
from physworld.engine.gradients.soft_grips_derivatives import SoftGripsTangent, same_soft_grips
from physworld.engine.gradients.tangent import InternalTangent
from physworld.engine.problem import Problem
from physworld.engine.terms.soft_grips import SoftGrips
from physworld.engine.terms.term import refuse_undifferentiable
from physworld.engine.total.formulation import TotalLagrangian
from physworld.errors import NotDifferentiable
from physworld.materials.laws import friction_law


def sensitivities(
    setting: Setting,
    x: Array,
    times: Array,
    directions: Mapping[str, Direction],
    time_step_s: float | None = None,
) -> tuple[Array, dict[str, Array]]:
    """A run, and its derivatives by scalars.

    Args:
        setting: what is integrated.
        x: positions at the first time [m], (n, 3).
        times: (T,) [s].
        directions: two neighbours of the setting for each scalar; their distance is also that of the differences.
        time_step_s: forced time step [s], or None for the stable one.

    Returns:
        Positions (T, n, 3) [m], and their derivatives by every scalar, (T, n, 3) each.

    Raises:
        NotDifferentiable: a scalar changes which nodes are held, or the number of terms; or a term has no derivative.
        SimulationError: the run cannot be trusted.
    """
    tangents = {name: _Tangent(setting, direction, times) for name, direction in directions.items()}
    problem = replace(setting.problem, terms=(*setting.problem.terms, *tangents.values()))
    nodes = TotalLagrangian(problem, time_step_s, "explicit").run(x, setting.velocity, setting.held, times)
    return nodes, {name: np.array(tangent.recorded) for name, tangent in tangents.items()}


class _Tangent:
    """The tangent of a run along one scalar, as a term that adds no force."""

    frequency_rad_s = 0.0
    friction_per_s = 0.0

    def __init__(self, setting: Setting, direction: Direction, times: Array) -> None:
        high, low = direction.high, direction.low
        if not np.array_equal(high.held.nodes, low.held.nodes):
            raise NotDifferentiable(
                f"{len(high.held.nodes)} nodes are held on one side and {len(low.held.nodes)} on the other"
            )
        kinds = [[type(term) for term in s.problem.terms] for s in (setting, high, low)]
        if kinds[0] != kinds[1] or kinds[0] != kinds[2]:
            raise NotDifferentiable(
                f"the run has {len(kinds[0])} terms, its neighbours {len(kinds[1])} and {len(kinds[2])}"
            )
        self._setting, self._d, self._times = setting, direction, times

    def bind(self, problem: Problem) -> _Tangent:
        """Arrays for the run."""
        setting, high, low, width = self._setting, self._d.high, self._d.low, self._d.width
        own, device, n = setting.problem, problem.device, len(problem.rest)

        def array(values: Array) -> wp.array:
            return wp.array(np.ascontiguousarray(values, dtype=float), dtype=wp.float64, device=device)

        def zeros() -> wp.array:
            return wp.zeros(3 * n, dtype=wp.float64, device=device)

        frames, held = len(self._times), len(setting.held.nodes)
        slot = np.full(n, -1, dtype=np.int32)
        slot[setting.held.nodes] = np.arange(held, dtype=np.int32)
        paths = np.zeros((2, frames, max(3 * held, 1)))
        paths[0, :, : 3 * held] = (high.held.positions - low.held.positions).reshape(frames, -1) / width
        paths[1, :, : 3 * held] = (high.held.velocities - low.held.velocities).reshape(frames, -1) / width
        pulls = [np.asarray(s.problem.gravity_m_s2, dtype=float) for s in (high, low)]
        self._inputs = [
            array(own.nodal_mass()), array((high.problem.nodal_mass() - low.problem.nodal_mass()) / width),
            wp.array(slot, dtype=wp.int32, device=device), array(paths[0]), array(paths[1]),
            wp.vec3d(*((pulls[0] - pulls[1]) / width)), wp.float64(own.drag_per_s),
            wp.float64((high.problem.drag_per_s - low.problem.drag_per_s) / width),
        ]  # fmt: skip
        self._start = array((high.velocity - low.velocity).reshape(-1) / width)
        self._dx, self._dv, self._dx_previous, self._x_previous = zeros(), zeros(), zeros(), zeros()
        self._slope, self._forces = zeros(), (zeros(), zeros())
        self._x_sides, self._v_sides, self._scratch = (zeros(), zeros()), (zeros(), zeros()), zeros()
        factor = np.ones(own.lattice.fill.size) if own.stiffness_factor is None else own.stiffness_factor
        self._elastic = InternalTangent(own.lattice, own.law, factor, own.rest, device)
        self._viscous = any(friction_law(s.problem.law) is not None for s in (setting, high, low))
        self._soft = None
        if same_soft_grips((own, high.problem, low.problem)):
            slopes = (self._inputs[1], self._inputs[5], self._inputs[7])
            self._soft = SoftGripsTangent(own, high.problem, low.problem, width, slopes)
        self._terms = [
            [t.bind(s.problem) for t in s.problem.terms if not isinstance(t, SoftGrips)] for s in (high, low)
        ]
        refuse_undifferentiable(self._terms[0])
        by_difference = self._viscous or any(getattr(t, "multiplies", False) for t in self._terms[0])
        self._launched = by_difference or not same_internal_forces(high.problem, low.problem)
        self._internal = [internal_forces(s.problem) for s in (high, low)] if self._launched else []
        self._exact = not by_difference
        self._still = wp.zeros(3, dtype=wp.float64, device=device)
        return self

    def pace(self, time_step_s: float) -> None:
        """Substeps have this length [s] from now on."""
        if self._soft is not None:
            self._soft.pace(time_step_s)
        for side in self._terms:
            for term in side:
                term.pace(time_step_s)

    def begin(self, times: Array) -> None:
        """A run starts."""
        for side in self._terms:
            for term in side:
                term.begin(times)
        self._dx.zero_()
        wp.copy(self._dv, self._start)
        self._starting = True
        self.recorded = [np.zeros((len(self._dx) // 3, 3))]

    def check(self, time_s: float) -> None:
        """A frame ended."""
        self.recorded.append(self._dx.numpy().reshape(-1, 3).copy())

    def launch(self, x: wp.array, v: wp.array, clock: wp.array, counter: wp.array, force: wp.array) -> None:
        """One step of the tangent; the first call of a run is the half step back of its start."""
        starting, device = self._starting, x.device
        self._starting = False
        if starting:
            wp.copy(self._x_previous, x)
            wp.copy(self._dx_previous, self._dx)
        if self._exact:
            self._elastic.apply(x, self._dx, self._slope)
        if self._launched:
            self._launch_internal(x, self._still if starting else clock)
        if any(self._terms):
            self._spread(x, self._dx, self._x_sides)
            self._spread(v, self._dv, self._v_sides)
            for terms, near, speed, out in zip(
                self._terms, self._x_sides, self._v_sides, self._forces, strict=True
            ):
                for term in terms:
                    term.launch(near, speed, clock, counter, out)
        width = wp.float64(self._d.width)
        wp.launch(add_slope, dim=len(x), inputs=[width], outputs=[*self._forces, self._slope], device=device)
        wp.copy(self._x_previous, x)
        if self._soft is not None:
            self._soft.add(x, v, self._dx, self._dv, clock, counter, force, self._slope)
        wp.launch(
            advance_tangent, dim=len(x) // 3,
            inputs=[*self._inputs, int(starting), clock, counter, force, v],
            outputs=[self._slope, self._dx, self._dv, self._dx_previous], device=device,
        )  # fmt: skip

    def _launch_internal(self, x: wp.array, clock: wp.array) -> None:
        """Internal forces of both sides: at the state itself where the tangent has the rest, else beside it."""
        if self._exact:
            for internal, out in zip(self._internal, self._forces, strict=True):
                internal.launch(x, clock, out)
            return
        self._spread(self._x_previous, self._dx_previous, self._x_sides)
        for internal, near in zip(self._internal, self._x_sides, strict=True):
            internal.launch(near, clock, self._scratch)  # friction remembers these
        self._spread(x, self._dx, self._x_sides)
        for internal, near, out in zip(self._internal, self._x_sides, self._forces, strict=True):
            internal.launch(near, clock, out)

    def _spread(self, centre: wp.array, tangent: wp.array, sides: tuple[wp.array, wp.array]) -> None:
        half = wp.float64(0.5 * self._d.width)
        wp.launch(
            set_sides,
            dim=len(centre),
            inputs=[half, centre, tangent],
            outputs=list(sides),
            device=centre.device,
        )
