"""Friction in sub-steps of its own, where an explicit one would shrink the time step many times.

    dv/dt = (f(x) - C(x) v) / m + g - c v        over one step at frozen positions x, then x += dt v

Explicit friction needs dt of the order of 2 / lambda, lambda the fastest rate of M^-1 C. The stages of the second-order
Runge-Kutta-Legendre scheme (Meyer, Balsara, Aslam 2014, J. Comput. Phys. 257, RKL2) stretch that like a square: s of
them are stable to

    lambda dt <= (s^2 + s - 2) / 2

Only C is applied s times; elastic forces, contacts and all other terms once a step. Since these stand on the right as
a source, a motion without inertia creeps at its true speed: with p the stages' polynomial, v' = p v + (1 - p) f / r
has the fixed point f / r whatever p is, which splitting decay from kick does not. For odd s, 0 < p <= 1 and
p >= (2 - z) / (2 + z), z = r dt, so the leapfrog's limit omega dt <= 2 stays what it is without friction. What decays
within a step is only known to decay: to about half a step.

The rate is followed by power iteration at every frame, since strain changes it; every number of stages has a graph of
its own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from physworld.arrays import Array
from physworld.engine.total.friction import FrictionForces
from physworld.engine.total.relaxation_kernels import begin_stages, end_stages, take_stage

MARGIN = 1.5  # the stages are stable to this multiple of the rate at the last frame
_LEAST = 3
_BLOCK = 256  # components a thread of a CPU takes
_FIRST_ITERATIONS, _ITERATIONS = 30, 4
_FROM_BELOW = 1.05  # power iteration approaches the rate from below


def stages_for(stiffness: float) -> int:
    """Smallest odd number of stages that is stable at ``stiffness``, the fastest rate [1/s] times dt [s]."""
    stages = _LEAST
    while 0.5 * (stages**2 + stages - 2) < stiffness:
        stages += 2
    return stages


def coefficients(stages: int) -> tuple[Array, Array]:
    """Of every stage (a, b, own, first), (s, 4), and its share of the mean velocity of the step, (s,)."""
    j = np.arange(stages + 1)
    b = np.full(stages + 1, 1.0 / 3.0)
    b[2:] = (j[2:] ** 2 + j[2:] - 2) / (2.0 * j[2:] * (j[2:] + 1))
    width = 4.0 / (stages**2 + stages - 2)
    table, shares = np.zeros((stages, 4)), np.zeros((stages + 1, stages))
    table[0] = 1.0, 0.0, b[1] * width, 0.0
    shares[1, 0] = b[1] * width
    for k in range(2, stages + 1):
        mu = (2 * k - 1) / k * b[k] / b[k - 1]
        nu = -(k - 1) / k * b[k] / b[k - 2]
        table[k - 1] = mu, nu, mu * width, -(1 - b[k - 1]) * mu * width
        shares[k] = mu * shares[k - 1] + nu * shares[k - 2]
        shares[k, k - 1] += table[k - 1, 2]
        shares[k, 0] += table[k - 1, 3]
    return table, shares[stages]


class Relaxation:
    """The node step of one run whose friction is sub-cycled.

    Args:
        nodes: lumped masses (n,), slots (n,), paths of positions and velocities, on the device: what
            :func:`physworld.engine.total.node_kernels.advance_nodes` takes.
        friction: the law's friction, or None.
        gravity, drag: [m/s^2] (3,) and [1/s].
        mean: takes the velocities at which the last step took its friction, (3n,) [m/s].

    Attributes:
        stages: how many the next step takes.
    """

    def __init__(
        self,
        nodes: list[wp.array],
        friction: FrictionForces | None,
        gravity: Array,
        drag: float,
        mean: wp.array,
    ) -> None:
        self._nodes, self._friction, self._drag = nodes, friction, drag
        self._gravity = wp.vec3d(*gravity)
        size, self._device = 3 * len(nodes[0]), nodes[0].device
        self._mass = np.repeat(nodes[0].numpy(), 3)
        free = np.repeat(nodes[1].numpy() < 0, 3)
        self._inverse_mass = wp.array(
            np.where(free, 1.0 / self._mass, 0.0), dtype=wp.float64, device=self._device
        )
        self._block = 1 if wp.get_device(self._device).is_cuda else _BLOCK
        self._mean = mean
        self._source, self._rate0, self._y0, self._y1, self._y2 = (
            wp.zeros(size, dtype=wp.float64, device=self._device) for _ in range(5)
        )
        self._mode: Array | None = None
        self.stages = _LEAST

    def tune(self, x: wp.array, dt: float) -> int:
        """Choose the stages for steps of ``dt`` [s] from positions ``x`` (3n,) [m] on; returns their number."""
        self.stages = stages_for(MARGIN * dt * (self.rate(x) + self._drag))
        return self.stages

    def rate(self, x: wp.array) -> float:
        """Fastest rate of the internal friction at positions ``x`` (3n,) [m]: [1/s]."""
        friction = self._friction
        if friction is None:
            return 0.0
        again = _FIRST_ITERATIONS if self._mode is None else _ITERATIONS
        if self._mode is None:
            self._mode = np.random.default_rng(0).normal(size=len(self._mass))
        friction.prepare(x)
        found = 0.0
        for _ in range(again):
            mode = self._mode / np.abs(self._mode).max()
            self._y1.assign(mode)
            self._y2.zero_()
            friction.launch(self._y1, self._y2)
            response = -self._y2.numpy() / self._mass
            if not np.isfinite(response).all():
                return 0.0  # the run's own check says what happened
            found = float(mode @ (self._mass * response) / (mode @ (self._mass * mode)))
            self._mode = response
        return _FROM_BELOW * found

    def launch(self, x: wp.array, v: wp.array, force: wp.array, clock: wp.array, counter: wp.array) -> None:
        """One step of positions and velocities.

        Args:
            x, v: nodal positions [m] and velocities [m/s], (3n,) float64; changed.
            force: of everything but friction [N], (3n,); cleared.
            clock: (frame interval [s], 1/dt [1/s], dt [s]).
            counter: (frame, substep, substeps).
        """
        n, device, friction = len(self._nodes[0]), self._device, self._friction
        _, slot, *paths = self._nodes
        table, shares = coefficients(self.stages)
        wp.launch(
            begin_stages, dim=n, inputs=[*self._nodes, self._gravity, clock, counter, x, v],
            outputs=[force, self._source, self._y0, self._y2, self._mean], device=device,
        )  # fmt: skip
        if friction is not None:
            friction.prepare(x)
        last, other = self._y0, self._y1
        for stage, (numbers, share) in enumerate(zip(table, shares, strict=True)):
            if friction is not None:
                friction.launch(last, force)
            given: list[Any] = [wp.float64(number) for number in (*numbers, share)]
            wp.launch(
                take_stage, dim=-(-len(v) // self._block),
                inputs=[self._block, self._inverse_mass, wp.float64(self._drag), clock, counter, int(stage == 0),
                        *given, self._source, self._y0, last],
                outputs=[force, self._rate0, self._mean, other], device=device,
            )  # fmt: skip
            last, other = other, self._y2 if stage == 0 else last
        wp.launch(
            end_stages, dim=n, inputs=[slot, *paths, clock, counter, last], outputs=[x, v], device=device
        )
