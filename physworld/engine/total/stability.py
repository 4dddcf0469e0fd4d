"""The largest stable time step, from the body's own fastest mode instead of a rule of thumb.

The fastest frequency omega of M^-1 K is found by power iteration on the engine's own forces about the undeformed
state, and the fastest rate r of M^-1 C in the same way. The symplectic Euler step with friction that lags half a step
is stable while

    omega^2 dt^2 + 2 r dt <= 4

(Belytschko, Liu, Moran, ch. 6.2, for r = 0). For a full lattice of quadratic B-splines this is about 0.9 to
1.3 dx / c, the CFL limit of the pressure wave; thin cells, partial fill and bending are covered too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import warp as wp

from physworld.arrays import Array

SAFETY = 0.6  # share of the limit that is used: large strains stiffen a body
_ITERATIONS = 40
_MARGIN = 1.05  # power iteration approaches omega from below
EXPLICIT_SHRINK = (
    8.0  # explicit friction may cost this factor of the step: sub-steps of the same cost as much
)
DRAG_SHRINK = 1.05  # and drag this one: its sub-steps need no cells


class NodalForces(Protocol):
    """Forces at nodal positions, whatever makes them: what a power iteration probes."""

    device: str

    def launch(self, x: wp.array, clock: wp.array, force: wp.array) -> None:
        """Add the forces [N] at nodal positions ``x`` (3n,) to ``force`` (3n,); ``clock[1]`` is 1/dt [1/s]."""
        ...


def fastest_frequency(forces: NodalForces, rest: Array, mass: Array, spacing: float) -> float:
    """Highest angular frequency [rad/s] about the rest state.

    Args:
        forces: internal forces of the body.
        rest: nodal positions without stress [m], (n, 3).
        mass: lumped nodal masses [kg], (n,).
        spacing: smallest cell size [m], the scale of the probe.
    """
    return float(fastest_frequencies(forces, rest[None], mass[None], spacing)[0])


def fastest_frequencies(forces: NodalForces, rest: Array, mass: Array, spacing: float) -> Array:
    """Highest angular frequencies [rad/s], (B,), of B bodies that ``forces`` holds side by side.

    Args:
        forces: internal forces of all of them.
        rest: nodal positions without stress [m], (B, n, 3).
        mass: lumped nodal masses [kg], (B, n).
        spacing: smallest cell size [m], the scale of the probe.
    """
    forces_at = _ForcesAt(forces, rest.size)
    scale = 1e-4 * spacing
    mode = np.repeat(np.random.default_rng(0).normal(size=rest.shape[1:])[None], len(rest), axis=0)
    squares = np.zeros(len(rest))
    for _ in range(_ITERATIONS):
        mode /= np.abs(mode).max(axis=(1, 2), keepdims=True)
        pushed = forces_at(rest + scale * mode) - forces_at(rest - scale * mode)
        response = -pushed / (2 * scale) / mass[..., None]
        weighted = mass[..., None] * mode
        for body in range(len(rest)):
            squares[body] = np.sum(weighted[body] * response[body]) / np.sum(weighted[body] * mode[body])
        mode = response
    return _MARGIN * np.sqrt(np.maximum(squares, 1e-12))


def stable_time_step(frequency_rad_s: float, friction_per_s: float, safety: float = SAFETY) -> float:
    """Largest time step [s] times ``safety``, for the fastest frequency [rad/s] and friction rate [1/s]."""
    root = np.sqrt(friction_per_s**2 + 4 * frequency_rad_s**2)
    return float(safety * (root - friction_per_s) / frequency_rad_s**2)


@dataclass(frozen=True)
class Steps:
    """Time steps that a body allows, by how its own friction is integrated.

    Attributes:
        frequency_rad_s: fastest mode.
        internal_per_s, drag_per_s: fastest rates of the law's friction and of drag.
        terms_per_s: of everything else that acts.
    """

    frequency_rad_s: float
    internal_per_s: float
    drag_per_s: float
    terms_per_s: tuple[float, ...]

    def explicit_s(self, safety: float = SAFETY) -> float:
        """With explicit friction [s]."""
        rate = self.drag_per_s + self.internal_per_s
        for term in self.terms_per_s:
            rate += term
        return stable_time_step(self.frequency_rad_s, rate, safety)

    def relaxed_s(self, safety: float = SAFETY) -> float:
        """With friction in sub-steps of its own [s]."""
        return stable_time_step(self.frequency_rad_s, sum(self.terms_per_s), safety)

    @property
    def relax(self) -> bool:
        """Whether sub-steps are worth their work: see :data:`EXPLICIT_SHRINK` and :data:`DRAG_SHRINK`."""
        shrink = self.relaxed_s() / self.explicit_s()
        internal = stable_time_step(self.frequency_rad_s, self.internal_per_s + sum(self.terms_per_s))
        return shrink > EXPLICIT_SHRINK or internal / self.explicit_s() > DRAG_SHRINK


class _ForcesAt:
    """Forces at positions, where they are asked for many times: one captured launch, between the same arrays.

    Args:
        forces: what is asked.
        size: of the positions, 3n of all bodies.
    """

    def __init__(self, forces: NodalForces, size: int) -> None:
        device = forces.device
        clock = wp.zeros(3, dtype=wp.float64, device=device)  # 1/dt = 0: friction silent
        self._x, self._force = (wp.zeros(size, dtype=wp.float64, device=device) for _ in range(2))
        self._uploaded = self._x if self._x.device.is_cpu else wp.zeros(size, dtype=wp.float64, device="cpu")
        self._written: Array = self._uploaded.numpy()  # the same memory
        with wp.ScopedCapture(device=device) as capture:
            forces.launch(self._x, clock, self._force)
        self._launch, self._kept = capture.graph, clock

    def __call__(self, x: Array) -> Array:
        """Forces [N] at positions ``x`` (B, n, 3) [m]."""
        self._written[:] = x.reshape(-1)
        if self._uploaded is not self._x:
            wp.copy(self._x, self._uploaded)
        self._force.zero_()
        wp.capture_launch(self._launch)
        forces_n: Array = self._force.numpy().reshape(x.shape).copy()
        return forces_n
