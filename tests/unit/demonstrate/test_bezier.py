"""The Bézier path against closed forms: lines, near-circles, and its own arc length."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from physworld.demonstrate.bezier import ArcLength, CubicBezier, DegenerateCurve, random_bezier, straight

CIRCLE = 4.0 / 3.0 * np.tan(np.pi / 8.0)  # handle of the usual cubic quarter circle
CIRCLE_ERROR = 3e-4  # that cubic leaves the unit circle by at most 2.7e-4


def quarter_circle() -> CubicBezier:
    return CubicBezier(np.array([[1.0, 0.0, 0.0], [1.0, CIRCLE, 0.0], [CIRCLE, 1.0, 0.0], [0.0, 1.0, 0.0]]))


def test_a_straight_curve_has_linear_arc_length():
    curve = straight(np.array([1.0, 2.0, 3.0]), np.array([4.0, 2.0, 7.0]))
    arc = ArcLength(curve)
    assert arc.length == pytest.approx(5.0, rel=1e-14)
    u = np.linspace(0.0, 1.0, 17)
    np.testing.assert_allclose(arc.at(u), 5.0 * u, rtol=0, atol=1e-13)
    np.testing.assert_allclose(arc.parameter(5.0 * u), u, rtol=0, atol=1e-9)
    assert curve.peak_curvature() == pytest.approx(0.0, abs=1e-12)


def test_a_quarter_circle_has_its_length_and_curvature():
    curve = quarter_circle()
    assert ArcLength(curve).length == pytest.approx(np.pi / 2.0, rel=CIRCLE_ERROR)
    u = np.linspace(0.0, 1.0, 50)
    np.testing.assert_allclose(np.linalg.norm(curve.position(u), axis=1), 1.0, atol=CIRCLE_ERROR)
    # the cubic's curvature oscillates around that of the circle by less than 3 %
    np.testing.assert_allclose(curve.curvature(u), 1.0, atol=3e-2)


def test_the_derivatives_are_those_of_the_position():
    generator = np.random.default_rng(5)
    curve = CubicBezier(generator.standard_normal((4, 3)))
    u, step = np.linspace(0.1, 0.9, 9), 1e-5
    slope = (curve.position(u + step) - curve.position(u - step)) / (2 * step)
    bend = (curve.derivative(u + step) - curve.derivative(u - step)) / (2 * step)
    np.testing.assert_allclose(curve.derivative(u), slope, atol=1e-8)
    np.testing.assert_allclose(curve.second_derivative(u), bend, atol=1e-8)


@pytest.mark.parametrize("seed", range(8))
def test_arc_length_agrees_with_adaptive_quadrature_and_inverts_to_its_tolerance(seed):
    generator = np.random.default_rng(seed)
    curve = random_bezier(generator.standard_normal(3), generator.standard_normal(3), generator)
    arc = ArcLength(curve, tolerance=1e-10)
    expected, _ = quad(lambda u: float(np.linalg.norm(curve.derivative(np.array(u)))), 0.0, 1.0, epsabs=1e-13)
    assert arc.length == pytest.approx(expected, rel=1e-10)
    s = np.linspace(0.0, arc.length, 41)
    u = arc.parameter(s)
    assert np.all(np.diff(u) > 0.0)
    np.testing.assert_allclose(arc.at(u), s, rtol=0, atol=2e-10 * arc.length)


def test_equal_steps_of_arc_length_are_equal_steps_along_the_curve():
    curve = CubicBezier(np.array([[0, 0, 0], [0.05, 0, 0], [1, 1, 0], [1, 1, 1]], dtype=float))
    arc = ArcLength(curve)
    points = curve.position(arc.parameter(np.linspace(0.0, arc.length, 2001)))
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # a chord is shorter than its arc by (κ·ds)²/24: 1.4e-3 in this curve's sharp first turn
    assert steps.max() / steps.min() == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("limit", [0.5, 2.0, 6.0])
def test_random_curvature_stays_under_its_limit_and_is_not_always_small(limit):
    generator = np.random.default_rng(11)
    start, end = np.zeros(3), np.array([0.3, -0.2, 0.1])
    chord = float(np.linalg.norm(end - start))
    curves = [random_bezier(start, end, generator, curvature_limit=limit) for _ in range(50)]
    peaks = [curve.peak_curvature() * chord for curve in curves]
    assert max(peaks) <= limit * (1.0 + 1e-9)
    assert np.median(peaks) > 0.3 * limit
    assert np.std([random_bezier(start, end, generator).points[1] for _ in range(10)]) > 0.0


def test_a_curve_in_a_box_stays_in_it():
    generator = np.random.default_rng(7)
    low, high = np.array([-0.1, -0.1, 0.0]), np.array([0.5, 0.1, 0.4])
    for _ in range(50):
        start, end = generator.uniform(low, high), generator.uniform(low, high)
        curve = random_bezier(start, end, generator, bend=1.5, box=(low, high))
        path = curve.position(np.linspace(0.0, 1.0, 200))
        assert np.all(path >= low - 1e-12) and np.all(path <= high + 1e-12)
        assert curve.peak_curvature() * np.linalg.norm(end - start) <= 6.0 * (1.0 + 1e-9)


def test_the_same_seed_gives_the_same_curve():
    one = random_bezier(np.zeros(3), np.ones(3), np.random.default_rng(3))
    two = random_bezier(np.zeros(3), np.ones(3), np.random.default_rng(3))
    np.testing.assert_array_equal(one.points, two.points)


def test_a_curve_without_length_is_refused():
    with pytest.raises(DegenerateCurve, match="coincide"):
        random_bezier(np.ones(3), np.ones(3), np.random.default_rng(0))
    with pytest.raises(DegenerateCurve, match="length is 0"):
        ArcLength(straight(np.ones(3), np.ones(3)))
