"""A chain of inextensible links with springs and dampers between them: many candidates at once, in NumPy.

Nodes x (n, 3), links e = x' - x of fixed lengths l, unit tangents t = e/l. Per unit of mass per length:

* a joint of two links, and of Voronoi length l_i, stores B |t' - t|² / (2 l_i): bending stiffness B [m⁴/s²], for small
  angles that of an elastic rod (Bergou et al. 2008, with 2 sin(θ/2) for the angle). It is a constant quadratic form
  xᵀK x / 2, and its damper is c K v, c [m⁴/s]; in a bent joint that also resists a turn of the whole, slightly.
* twist is quasi-static (Bergou et al. 2008): one number m [rad] for the chain, G m² / (2 L). Ends turn as their links
  do, by least rotation; m is followed by its gradient, the curvature binormals.
* drag d v [1/s] on every node, and gravity.

Links are rigid: their mass matrix is l/6 [[2, 1], [1, 2]]; lumped masses are l/2 at both ends. Time: the trapezoidal
rule for springs and dampers, then a projection of positions and velocities to the lengths with the mass matrix, which
keeps momentum (DEFORM's constraint does so too, arXiv:2406.05931 section 3).

Legend: B candidates, n nodes, m links, f free nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array

PROJECTIONS = 3
LONGEST_STEP_S = 4e-3


@dataclass(frozen=True)
class Coefficients:
    """Of every candidate, (B,): bending [m⁴/s²], joint damping [m⁴/s], drag [1/s], twist [m⁴/s²]."""

    bending: Array
    damping: Array
    drag: Array
    twist: Array


@dataclass(frozen=True)
class Chain:
    """Lengths of the links [m], (m,), which nodes are driven, (n,) bool, and whether masses are lumped."""

    lengths: Array
    driven: Array
    lumped: bool

    @property
    def differences(self) -> Array:
        """Nodes to links, (m, n)."""
        links = len(self.lengths)
        return np.eye(links, links + 1, 1) - np.eye(links, links + 1)

    @property
    def mass(self) -> Array:
        """Per unit of mass per length [m], (n, n)."""
        matrix = np.zeros((len(self.driven), len(self.driven)))
        block = np.diag([0.5, 0.5]) if self.lumped else np.array([[2.0, 1.0], [1.0, 2.0]]) / 6.0
        for link, length in enumerate(self.lengths):
            matrix[link : link + 2, link : link + 2] += length * block
        return matrix

    @property
    def joints(self) -> Array:
        """K [1/m³], (n, n), see the module's text."""
        tangents = self.differences / self.lengths[:, None]
        bends = np.diff(tangents, axis=0)
        voronoi = 0.5 * (self.lengths[1:] + self.lengths[:-1])
        matrix: Array = bends.T @ (bends / voronoi[:, None])
        return matrix

    def run(
        self, start: Array, velocity: Array, driven: Array, times: Array, gravity: Array, of: Coefficients
    ) -> Array:
        """Nodes at the frames, (B, T, n, 3) [m].

        Args:
            start, velocity: at the first frame, (B, n, 3) or (n, 3) [m], [m/s].
            driven: places of the driven nodes at the frames, (B, T, k, 3) or (T, k, 3) [m].
            times: (T,) [s].
            gravity: (3,) [m/s²].
            of: the candidates.
        """
        count, frames = len(of.bending), len(times)
        driven = np.broadcast_to(driven, (count, frames, int(self.driven.sum()), 3))
        x = np.array(np.broadcast_to(start, (count, *start.shape[-2:])))
        v = np.array(np.broadcast_to(velocity, x.shape))
        tracks = np.empty((count, frames, *x.shape[1:]))
        tracks[:, 0] = x
        stepper = _Stepper(self, of, gravity)
        twist = np.zeros(count)
        for frame in range(1, frames):
            span = times[frame] - times[frame - 1]
            steps = max(1, int(np.ceil(span / LONGEST_STEP_S - 1e-9)))
            ends = [
                driven[:, frame - 1] + (driven[:, frame] - driven[:, frame - 1]) * (s / steps)
                for s in range(1, steps + 1)
            ]
            for end in ends:
                x, v, twist = stepper.step(x, v, twist, end, span / steps)
            tracks[:, frame] = x
        return tracks


class _Stepper:
    """One step of all candidates; matrices are kept for the last length of a step."""

    def __init__(self, chain: Chain, of: Coefficients, gravity: Array) -> None:
        self.of, self.gravity = of, gravity
        self.mass, self.joints = chain.mass, chain.joints
        self.free, self.held = np.flatnonzero(~chain.driven), np.flatnonzero(chain.driven)
        self.lengths, self.total = chain.lengths, float(chain.lengths.sum())
        moving = ~chain.driven[:-1] | ~chain.driven[1:]
        self.kept = np.flatnonzero(moving)
        self.rows = chain.differences[self.kept][:, self.free]
        self.inverse = np.linalg.inv(self.mass[np.ix_(self.free, self.free)])
        self.spread = self.inverse @ self.rows.T
        self.coupling = self.rows @ self.spread
        self.dt, self.solver = 0.0, np.empty(0)

    def step(self, x: Array, v: Array, twist: Array, end: Array, dt: float) -> tuple[Array, Array, Array]:
        """Places, velocities and twist after ``dt`` [s], the driven nodes at ``end`` (B, k, 3)."""
        of, free, held = self.of, self.free, self.held
        if abs(dt - self.dt) > 1e-9:
            self.dt, self.solver = dt, self._solver(dt)
        given = (end - x[:, held]) / dt
        moving = v.copy()
        moving[:, held] = given
        springs = of.bending[:, None, None] * (self.joints @ (x + 0.5 * dt * moving))
        dampers = of.damping[:, None, None] * (self.joints @ moving)
        drag = of.drag[:, None, None] * (self.mass @ moving)
        force = self.mass @ np.broadcast_to(self.gravity, x.shape) - springs - dampers - drag
        slope = self._twist_slope(x)
        force -= (of.twist * twist / self.total)[:, None, None] * slope
        force[:, free] -= self.mass[np.ix_(free, held)] @ (given - v[:, held]) / dt
        change = self.solver @ (dt * force[:, free])
        new, speed = x.copy(), moving
        new[:, held] = end
        new[:, free] += dt * (v[:, free] + 0.5 * change)
        speed[:, free] += change
        predicted = new[:, free]
        old = np.diff(x, axis=1)[:, self.kept]
        for _ in range(PROJECTIONS):
            link = np.diff(new, axis=1)[:, self.kept]
            excess = np.sum(link**2, axis=2) - self.lengths[self.kept] ** 2
            gram = 2.0 * self.coupling * (link @ old.transpose(0, 2, 1))
            multiplier = np.linalg.solve(gram, excess[..., None])
            new[:, free] -= self.spread @ (multiplier * old)
        speed[:, free] += (new[:, free] - predicted) / dt
        link = np.diff(new, axis=1)[:, self.kept]
        rate = np.sum(link * np.diff(speed, axis=1)[:, self.kept], axis=2)
        gram = self.coupling * (link @ link.transpose(0, 2, 1))
        speed[:, free] -= self.spread @ (np.linalg.solve(gram, rate[..., None]) * link)
        turned = np.sum(0.5 * (slope + self._twist_slope(new)) * (new - x), axis=(1, 2))
        return new, speed, twist + turned

    def _solver(self, dt: float) -> Array:
        of, free = self.of, self.free
        block = np.ix_(free, free)
        implicit = (0.25 * dt**2 * of.bending + 0.5 * dt * of.damping)[:, None, None] * self.joints[block]
        inert = (1.0 + 0.5 * dt * of.drag)[:, None, None] * self.mass[block]
        return np.linalg.inv(inert + implicit)

    def _twist_slope(self, x: Array) -> Array:
        """Gradient of the chain's twist by its nodes [rad/m], (B, n, 3)."""
        link = np.diff(x, axis=1)
        size = np.linalg.norm(link, axis=2)
        before, after = link[:, :-1], link[:, 1:]
        dot = np.sum(before * after, axis=2)
        binormal = 2.0 * np.cross(before, after) / (size[:, :-1] * size[:, 1:] + dot)[..., None]
        left, right = binormal / (2.0 * size[:, :-1, None]), binormal / (2.0 * size[:, 1:, None])
        slope = np.zeros_like(x)
        slope[:, :-2] += left
        slope[:, 2:] -= right
        slope[:, 1:-1] += right - left
        return slope
