"""Cubic Bézier paths of bounded curvature, parameterised by arc length (the paper's motion patterns).

B(u) = (1-u)³p₀ + 3(1-u)²u p₁ + 3(1-u)u²p₂ + u³p₃,  κ(u) = |B'×B''| / |B'|³.

p₀ and p₃ are start and end; p₁ and p₂ leave the chord's thirds by a random offset, which is shrunk until the
curvature limit holds (a straight chord has none, so an answer always exists). Arc length is integrated by
composite Gauss–Legendre quadrature, refined until two levels agree, and inverted by Newton's method inside a
bracket: ``ArcLength.parameter`` returns u with |s(u) - s| ≤ tolerance · length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array

GAUSS_NODES, GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(12)
GAUSS_NODES = 0.5 * (GAUSS_NODES + 1.0)  # moved from [-1, 1] to [0, 1]
GAUSS_WEIGHTS = 0.5 * GAUSS_WEIGHTS
MAX_PANELS = 1024
CURVATURE_SAMPLES = 65
SHRINK_STEPS = 12


class DegenerateCurve(ValueError):
    """A curve without length, or one whose arc length does not converge (a cusp)."""


@dataclass(frozen=True)
class CubicBezier:
    """One cubic segment; ``points`` are p₀..p₃ [m], (4, 3) float64."""

    points: Array

    def position(self, u: Array) -> Array:
        """B(u) [m], (n, 3)."""
        u = np.asarray(u, dtype=np.float64)[..., None]
        v = 1.0 - u
        p0, p1, p2, p3 = self.points
        point: Array = v**3 * p0 + 3.0 * v**2 * u * p1 + 3.0 * v * u**2 * p2 + u**3 * p3
        return point

    def derivative(self, u: Array) -> Array:
        """B'(u) [m], (n, 3)."""
        u = np.asarray(u, dtype=np.float64)[..., None]
        v = 1.0 - u
        d0, d1, d2 = np.diff(self.points, axis=0)
        derivative: Array = 3.0 * (v**2 * d0 + 2.0 * v * u * d1 + u**2 * d2)
        return derivative

    def second_derivative(self, u: Array) -> Array:
        """B''(u) [m], (n, 3)."""
        u = np.asarray(u, dtype=np.float64)[..., None]
        e0, e1 = np.diff(self.points, n=2, axis=0)
        second: Array = 6.0 * ((1.0 - u) * e0 + u * e1)
        return second

    def curvature(self, u: Array) -> Array:
        """κ(u) [1/m], (n,); infinite where the curve stands still."""
        first, second = self.derivative(u), self.second_derivative(u)
        numerator = np.linalg.norm(np.cross(first, second), axis=-1)
        speed = np.linalg.norm(first, axis=-1)
        still = speed <= 1e-12 * max(float(np.abs(np.diff(self.points, axis=0)).max()), 1e-300)
        return np.where(still, np.inf, numerator / np.where(still, 1.0, speed) ** 3)

    def peak_curvature(self) -> float:
        """The largest curvature [1/m] on an even grid of u."""
        return float(self.curvature(np.linspace(0.0, 1.0, CURVATURE_SAMPLES)).max())


class ArcLength:
    """Arc length of a curve and its inverse.

    Attributes:
        length: total length [m].
        tolerance: relative accuracy of ``parameter`` in arc length.
    """

    def __init__(self, curve: CubicBezier, tolerance: float = 1e-9) -> None:
        self.curve = curve
        self.tolerance = tolerance
        panels, previous = 4, np.inf
        while True:
            edges = np.linspace(0.0, 1.0, panels + 1)
            lengths = self._between(edges[:-1], edges[1:])
            total = float(lengths.sum())
            if not total > 0.0:
                raise DegenerateCurve(f"the curve's length is {total:g} m")
            if abs(total - previous) <= 0.1 * tolerance * total:
                break
            if panels >= MAX_PANELS:
                raise DegenerateCurve(
                    f"arc length {total:g} m still changes by {abs(total - previous):.2e} m "
                    f"at {panels} panels; tolerance {tolerance:.1e}"
                )
            panels, previous = 2 * panels, total
        self._edges = edges
        self._cumulative = np.concatenate([[0.0], np.cumsum(lengths)])
        self.length = float(self._cumulative[-1])

    def at(self, u: Array) -> Array:
        """Arc length s(u) [m] from the start, (n,)."""
        u = np.clip(np.asarray(u, dtype=np.float64), 0.0, 1.0)
        panel = np.clip(np.searchsorted(self._edges, u, side="right") - 1, 0, len(self._edges) - 2)
        return self._cumulative[panel] + self._between(self._edges[panel], u)

    def parameter(self, s: Array) -> Array:
        """u with arc length ``s`` [m] from the start, (n,); s outside [0, length] is clipped."""
        s = np.clip(np.asarray(s, dtype=np.float64), 0.0, self.length)
        panel = np.clip(np.searchsorted(self._cumulative, s, side="right") - 1, 0, len(self._edges) - 2)
        low, high = self._edges[panel], self._edges[panel + 1]
        start, base = low, self._cumulative[panel]
        span = self._cumulative[panel + 1] - base
        u = low + (high - low) * np.where(span > 0.0, (s - base) / np.where(span > 0.0, span, 1.0), 0.0)
        for _ in range(60):
            error = base + self._between(start, u) - s
            open_ = np.abs(error) > self.tolerance * self.length
            if not open_.any():
                return u
            low, high = np.where(error < 0.0, u, low), np.where(error > 0.0, u, high)
            speed = np.linalg.norm(self.curve.derivative(u), axis=-1)
            step = u - error / np.maximum(speed, 1e-300)
            step = np.where((step > low) & (step < high), step, 0.5 * (low + high))
            u = np.where(open_, step, u)
        raise DegenerateCurve(
            f"inverting the arc length left {float(np.abs(error).max()):.2e} m of {self.length:g} m"
        )

    def _between(self, low: Array, high: Array) -> Array:
        """Length of the curve over each [low, high], (n,)."""
        low, high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        u = low[..., None] + (high - low)[..., None] * GAUSS_NODES
        speed = np.linalg.norm(self.curve.derivative(u), axis=-1)
        length: Array = (high - low) * (speed @ GAUSS_WEIGHTS)
        return length


def straight(start: Array, end: Array) -> CubicBezier:
    """The straight segment from ``start`` to ``end`` (3,) at constant |B'|."""
    return bent(start, end, np.zeros((2, 3)))


def bent(start: Array, end: Array, offsets: Array) -> CubicBezier:
    """A segment whose inner control points leave the chord's thirds by ``offsets`` [m], (2, 3)."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    third = (end - start) / 3.0
    return CubicBezier(np.stack([start, start + third + offsets[0], end - third + offsets[1], end]))


def random_bezier(
    start: Array,
    end: Array,
    generator: np.random.Generator,
    *,
    bend: float = 0.5,
    curvature_limit: float = 6.0,
    box: tuple[Array, Array] | None = None,
) -> CubicBezier:
    """A random curve from ``start`` to ``end`` (3,) with bounded curvature.

    Args:
        bend: standard deviation of the inner control points' offsets, in chords.
        curvature_limit: largest allowed κ · chord (6: no turn is tighter than a sixth of the chord).
        box: lower and upper corner that the curve stays within; it must hold start and end.
    """
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    chord = float(np.linalg.norm(end - start))
    if not chord > 0.0:
        raise DegenerateCurve("start and end coincide")
    offsets = bend * chord * generator.standard_normal((2, 3))

    def curve(factor: float) -> CubicBezier:
        """The curve at ``factor`` of the offsets; its control polygon, hence the curve, inside the box."""
        points = bent(start, end, factor * offsets).points
        return CubicBezier(points if box is None else np.clip(points, *box))

    limit = curvature_limit / chord
    if curve(1.0).peak_curvature() <= limit:
        return curve(1.0)
    low, high = 0.0, 1.0  # the factor low always keeps the limit
    for _ in range(SHRINK_STEPS):
        middle = 0.5 * (low + high)
        if curve(middle).peak_curvature() <= limit:
            low = middle
        else:
            high = middle
    return curve(low)
