"""The engine that records what a trace is tried on: closed forms, energy, and a cantilever's first frequency."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from benchmarks.peers.finite_elements import Acting, Elements, record

pytestmark = pytest.mark.slow

G = 9.81
TIMES = np.arange(7) / 30.0
NOWHERE = np.zeros(3)


def box(young_pa: float = 2e4, size: tuple[float, float, float] = (0.1, 0.05, 0.05)) -> Elements:
    return Elements((2, 1, 1), lambda unit: unit * size, young_pa, 0.3, 500.0)


@pytest.mark.parametrize(
    ("acting", "speed"),
    [
        (Acting(), lambda t: G * t),
        (Acting(linear_drag_per_s=4.0), lambda t: G / 4.0 * (1.0 - np.exp(-4.0 * t))),
        (Acting(quadratic_drag_per_m=2.0), lambda t: np.sqrt(G / 2.0) * np.tanh(np.sqrt(2.0 * G) * t)),
    ],
)
def test_a_free_body_falls_as_the_closed_form_says(acting: Acting, speed) -> None:
    body = box()
    nodes = record(body, acting, [], TIMES)
    fine = np.linspace(0.0, TIMES[-1], 4001)
    fallen = float(np.trapezoid(speed(fine), fine))
    centre = np.einsum("n,tni->ti", body.mass, nodes) / body.mass.sum()
    assert centre[0, 2] - centre[-1, 2] == pytest.approx(fallen, rel=3e-3)
    assert np.abs(nodes[-1] - centre[-1] - body.nodes + centre[0]).max() < 1e-9  # it stays as it was


def test_a_tether_carries_what_hangs_on_it() -> None:
    body = box()
    weight = float(body.mass.sum()) * G
    attach = np.array([0.05, 0.025, 0.05])
    anchor = attach + np.array([0.0, 0.0, 0.3])
    tether = Acting(
        tether_n_m=200.0,
        tether_rest_m=0.3,
        tether_radius_m=1.0,
        anchor=anchor,
        attach=attach,
        linear_drag_per_s=40.0,
    )
    nodes = record(body, tether, [], np.arange(31) / 30.0)
    centre = np.einsum("n,tni->ti", body.mass, nodes) / body.mass.sum()
    lowered = 0.3 + weight / 200.0
    assert anchor[2] - centre[-1, 2] == pytest.approx(lowered, rel=1e-3)


def test_a_cantilever_rings_at_its_theoretical_frequency_and_keeps_its_energy() -> None:
    size = (0.3, 0.02, 0.02)
    body = Elements((10, 1, 1), lambda unit: unit * size, 2e6, 0.0, 1000.0)
    held = np.flatnonzero(body.nodes[:, 0] < 1e-9)
    still = [(held, lambda t: (np.eye(3), NOWHERE))]
    root = brentq(lambda b: np.cos(b) * np.cosh(b) + 1.0, 1.5, 2.2)
    frequency = root**2 / 0.3**2 * np.sqrt(2e6 * size[2] ** 2 / 12.0 / 1000.0) / (2.0 * np.pi)
    times = np.linspace(0.0, 3.0 / frequency, 241)
    push = Acting(gravity_m_s2=np.array([0.0, 0.0, -0.05]))
    tip = record(body, push, still, times)[:, np.argmax(body.nodes[:, 0]), 2]
    way = tip - tip.mean()
    crossings = times[:-1][(way[:-1] < 0.0) & (way[1:] >= 0.0)]
    assert np.diff(crossings).mean() == pytest.approx(1.0 / frequency, rel=0.02)
    swings = [np.ptp(tip[80 * k : 80 * (k + 1)]) for k in range(3)]
    assert swings[2] == pytest.approx(swings[0], rel=0.01)


def test_material_points_stay_where_they_are_in_the_body() -> None:
    body = Elements((3, 2, 2), lambda unit: unit * [0.2, 0.1, 0.05], 1e5, 0.3, 500.0)
    unit = np.random.default_rng(0).uniform(0.0, 1.0, (20, 3))
    nodes, weights = body.weights(unit)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for moved in (body.nodes, body.nodes @ turn.T + [1.0, 2.0, 3.0]):
        found = np.einsum("pk,pki->pi", weights, moved[nodes])
        own = unit * [0.2, 0.1, 0.05]
        assert found == pytest.approx(
            own if moved is body.nodes else own @ turn.T + [1.0, 2.0, 3.0], abs=1e-12
        )


def test_friction_takes_energy_and_fibres_stiffen_along_their_axis() -> None:
    body = box()
    rng = np.random.default_rng(1)
    rate = 0.1 * rng.normal(size=body.nodes.shape)
    pulls = body.forces(body.nodes, rate, Acting(viscosity_pa_s=5.0))
    assert np.sum(pulls * rate) < 0.0
    assert np.abs(pulls.sum(axis=0)).max() < 1e-12  # inside the body
    stretched = body.nodes * [1.01, 1.0, 1.0]
    along = body.forces(stretched, 0 * rate, Acting(fibre_pa=1e5)) - body.forces(
        stretched, 0 * rate, Acting()
    )
    end = body.nodes[:, 0] > 0.1 - 1e-9
    strain = 0.5 * (1.01**2 - 1.0)
    assert along[end, 0].sum() == pytest.approx(-1e5 * strain * 1.01 * 0.05 * 0.05, rel=1e-9)
    across = Acting(fibre_pa=1e5, fibre_axis=np.array([0.0, 1.0, 0.0]))
    assert body.forces(stretched, 0 * rate, across) == pytest.approx(
        body.forces(stretched, 0 * rate, Acting())
    )


def test_a_modulus_may_vary_over_the_body() -> None:
    even, told = box(), Elements(
        (2, 1, 1), lambda unit: unit * (0.1, 0.05, 0.05), lambda places: np.full(len(places), 2e4), 0.3, 500.0
    )  # fmt: skip
    bent = even.nodes * [1.02, 1.0, 1.0]
    assert told.forces(bent, 0 * bent, Acting()) == pytest.approx(even.forces(bent, 0 * bent, Acting()))

    def soft_half(places: np.ndarray) -> np.ndarray:
        return np.where(places[:, 0] > 0.05, 1e4, 2e4)

    halves = Elements((2, 1, 1), lambda unit: unit * (0.1, 0.05, 0.05), soft_half, 0.3, 500.0)
    assert halves.mu == pytest.approx(0.5 * even.mu)
    pulls, of_even = (body.forces(bent, 0 * bent, Acting()) for body in (halves, even))
    ends = (even.nodes[:, 0] < 1e-9, even.nodes[:, 0] > 0.1 - 1e-9)
    assert [pulls[end, 0].sum() / of_even[end, 0].sum() for end in ends] == pytest.approx([1.0, 0.5])
