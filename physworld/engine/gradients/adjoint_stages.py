"""One substep whose friction is taken in stages, backwards: see :mod:`physworld.engine.total.relaxation`.

The stages are linear in the velocities, with fixed coefficients and with friction at the positions of the step. So they
are run again from the velocities that were kept, and then taken back one by one, transposed
(:mod:`physworld.engine.gradients.adjoint_stages_kernels`). How friction and elastic forces change with the positions
and with the law is the tangent's own, stage by stage, with the velocity of the stage in the place of the last
substep's: friction is linear in it, and for a sheet, whose strains are not linear in the positions, the lag is short.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.gradients.adjoint_pairs import ForcePair
from physworld.engine.gradients.adjoint_stages_kernels import (
    close_stage_back,
    enter_stages_back,
    leave_stages_back,
    open_stage_back,
    take_stage_again,
)
from physworld.engine.gradients.adjoint_terms import Reverse
from physworld.engine.gradients.tangent import InternalTangent
from physworld.engine.problem import Problem
from physworld.engine.total.friction import FrictionForces
from physworld.engine.total.relaxation import coefficients

_LAG_S = 1.0  # of solids and rods: any would do in exact numbers, and this one loses none of single precision
_SHEET_LAG = 1e-4  # of a sheet, as a share of the time step


class StagesBack:
    """The nodes, the friction and the elastic forces of one substep.

    Args:
        problem: what was integrated.
        friction: that of the run; None where only drag is taken in stages.
        nodes: lumped masses (n,), slots (n,).
        kept: velocities before every substep, and the forces beside friction in it, one a row.
        now: arrays of the reverse pass.
        earlier_dt, x_previous, path_bars: likewise.
        tangent: derivatives of the internal forces; law_bar: those of L by the numbers of the law.
        pairs: neighbours' frictions are launched in every stage.
    """

    def __init__(
        self,
        problem: Problem,
        friction: FrictionForces | None,
        nodes: list[wp.array],
        kept: tuple[wp.array, wp.array],
        now: Reverse,
        earlier_dt: wp.array,
        x_previous: wp.array,
        path_bars: tuple[wp.array, wp.array],
        tangent: InternalTangent,
        law_bar: wp.array,
        pairs: Sequence[ForcePair],
    ) -> None:
        self._friction, self._now, self._pairs, self._tangent = friction, now, pairs, tangent
        self._mass, self._slot = nodes
        self._law_bar, self._x_previous, self._path_bars = law_bar, x_previous, path_bars
        self._drag, self._sheet = wp.float64(problem.drag_per_s), problem.lattice.dim == 2
        inverse = np.where(self._slot.numpy() < 0, 1.0 / self._mass.numpy(), 0.0)
        self._inverse_mass = wp.array(np.repeat(inverse, 3), dtype=wp.float64, device=now.x.device)
        gravity = wp.vec3d(*problem.gravity_m_s2)
        self._enter_inputs = [
            *nodes, gravity, now.offset, *kept, now.clock, now.counter, earlier_dt, now.x, now.v_bar
        ]  # fmt: skip
        self._lag_clock = wp.zeros_like(now.clock)
        self._velocities: list[wp.array] = []
        self._pushes: list[wp.array] = []
        self._source, self._goal_bar, self._cur, self._before = (wp.zeros_like(now.x) for _ in range(4))
        self._y0_bar, self._rate0_bar, self._u, self._pushed = (wp.zeros_like(now.x) for _ in range(4))
        self._x_lagged = wp.zeros_like(now.x)

    def enter(self, time_step_s: float, stages: int) -> None:
        """Substeps have this length [s] and at most so many stages from now on."""
        while len(self._velocities) < stages:
            self._velocities.append(wp.zeros_like(self._now.x))
            self._pushes.append(wp.zeros_like(self._now.x))
        lag = _SHEET_LAG * time_step_s if self._sheet else _LAG_S
        self._lag_clock.assign(np.array([0.0, 1.0 / lag, lag]))

    def take_back(self, stages: int) -> None:
        """Derivatives by the state before the substep and, in ``now.force_bar``, by the forces beside friction.

        With internal friction the elastic forces are taken back along them too; with drag alone they are not.
        """
        now, n = self._now, len(self._mass)
        wp.launch(
            enter_stages_back, dim=n, inputs=self._enter_inputs,
            outputs=[now.x_bar, now.v, self._x_previous, now.pull, self._source, self._velocities[0], self._cur,
                     self._before, self._y0_bar, self._rate0_bar, self._goal_bar, now.force_bar],
            device=now.x.device,
        )  # fmt: skip
        if self._friction is not None:
            self._friction.prepare(now.x)
        for pair in self._pairs:
            pair.prepare_friction()
        table = coefficients(stages)[0]
        self._run_again(table)
        for stage in reversed(range(stages)):
            self._take_stage_back(stage, *(float(number) for number in table[stage]))
        wp.launch(
            leave_stages_back, dim=n,
            inputs=[self._slot, now.clock, now.counter, self._cur, self._y0_bar, self._goal_bar],
            outputs=[now.x_bar, *self._path_bars, now.v_bar], device=now.x.device,
        )  # fmt: skip

    def _run_again(self, table: Array) -> None:
        """The velocities before every stage, and the friction at them."""
        now, y, q = self._now, self._velocities, self._pushes
        for stage in range(len(table)):
            if self._friction is not None:
                q[stage].zero_()
                self._friction.launch(y[stage], q[stage])
            if stage + 1 == len(table):
                return
            given = [wp.float64(number) for number in table[stage]]
            wp.launch(
                take_stage_again, dim=len(now.x),
                inputs=[self._inverse_mass, self._drag, now.clock, now.counter, *given, self._source, y[0], q[0],
                        y[max(stage - 1, 0)], y[stage], q[stage]],
                outputs=[y[stage + 1]], device=now.x.device,
            )  # fmt: skip

    def _take_stage_back(self, stage: int, a: float, b: float, own: float, first: float) -> None:
        now, y, q = self._now, self._velocities[stage], self._pushes[stage]
        given = [wp.float64(number) for number in (1.0 - a - b, own, first)]
        wp.launch(
            open_stage_back, dim=len(now.x),
            inputs=[self._inverse_mass, now.clock, now.counter, self._lag_clock, int(stage == 0), *given, self._cur,
                    now.x, y],
            outputs=[self._rate0_bar, self._y0_bar, self._u, self._pushed, self._x_lagged], device=now.x.device,
        )  # fmt: skip
        if self._friction is not None:
            self._friction.launch(self._u, self._pushed)
            self._tangent.apply_with_friction(
                now.x, self._x_lagged, self._lag_clock, self._u, now.x_bar, now.x_bar, self._law_bar
            )
        for pair in self._pairs:
            pair.add_friction_work(y, self._u)
        wp.launch(
            close_stage_back, dim=len(self._mass),
            inputs=[self._mass, self._drag, wp.float64(a), wp.float64(b), y, q, now.pull, self._u, self._pushed],
            outputs=[self._cur, self._before, now.force_bar, now.mass_bar, now.gravity_bar, now.drag_bar],
            device=now.x.device,
        )  # fmt: skip
