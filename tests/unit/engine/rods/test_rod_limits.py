"""Where discrete rods end: folded edges, edges without length, very stiff and very soft ropes, runs that blow up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discrete import FALL, LAW, along, energies, line, problem, run, still, uniform

from physworld.engine.problem import Problem
from physworld.engine.rods.chain import chain
from physworld.engine.rods.discrete_rods import DiscreteRods, directors_along, joint_angles
from physworld.errors import BlewUp, ParticlesLeftTheGrid, SceneUnsupported
from physworld.materials.rod import RodLaw


def folded(lift: float) -> np.ndarray:
    """A rope of ten edges whose second half lies back on its first, ``lift`` [m] above it at its end."""
    x = along(line(10))
    x[6:, 0] = x[4::-1, 0]
    x[6:, 2] = lift * np.arange(1, 6) / 5.0
    return x


@pytest.mark.parametrize("lift", [0.0, 1e-9, 1e-3])
def test_an_edge_folded_back_on_another_is_integrated(lift: float) -> None:
    lattice = line(10)
    start = folded(lift)
    assert np.isfinite(directors_along(lattice, start)).all()
    assert np.isfinite(joint_angles(lattice, start)).all()
    natural = uniform(lattice, 1.0, 0.5, 1.0)
    one = problem(lattice, natural=natural, gravity=FALL, frames=101)
    path, state = run(one, start, np.linspace(0.0, 1.0, 101), held=still([0, 1], start, 101))
    assert np.isfinite(path).all()
    assert np.linalg.norm(state.directors[1:], axis=1) == pytest.approx(1.0, abs=1e-9)
    assert np.abs(np.diff(path, axis=0)).max() < 0.3  # [m] in 10 ms: it springs open with 4 J


def test_a_joint_bends_no_stiffer_than_at_its_last_opening() -> None:
    """Moments grow as 2 tan of half the turn up to 168 degrees, and no further."""
    lattice = chain(np.array([-1, 0, 1]), np.array([0.0, 0.1, 0.1]))
    pushes = []
    for turn in np.deg2rad([90.0, 160.0, 175.0, 179.9]):
        start = np.array([[-0.1, 0, 0], [0, 0, 0], [0.1 * np.cos(turn), 0.1 * np.sin(turn), 0]])
        _, state = run(problem(lattice), start, np.array([0.0, 1e-7]), 1e-7, held=still([0, 1], start, 2))
        pushes.append(np.linalg.norm(state.v[2]))
    half = np.deg2rad([45.0, 80.0])
    moments = np.tan(half) / np.cos(half) ** 2
    assert pushes[1] / pushes[0] == pytest.approx(moments[1] / moments[0], rel=1e-3)
    assert max(pushes) < 500.0 * pushes[0]


def test_an_edge_without_length_is_named() -> None:
    lattice = line(5)
    start = along(lattice)
    start[3] = start[2]
    with pytest.raises(SceneUnsupported, match=r"edge 2 of 5 is 0 m long at the start, at rest 0\.2 m"):
        DiscreteRods([problem(lattice)]).run(
            start, np.zeros_like(start), [still([], start, 2)], np.array([0.0, 0.1])
        )


def test_an_edge_that_is_pressed_to_nothing_is_integrated() -> None:
    lattice = line(4)
    start = along(lattice)
    velocity = np.zeros_like(start)
    velocity[1:, 0] = -30.0  # a soft rope against its held end: edges run through no length at all
    law = replace(LAW, stretching_n=0.5, bending_n_m2=1e-6)
    one = problem(lattice, law, frames=21)
    path, state = run(one, start, np.linspace(0.0, 0.2, 21), velocity=velocity, held=still([0], start, 21))
    assert np.isfinite(path).all()
    assert np.isfinite(state.directors).all()


@pytest.mark.parametrize(("stretching", "bending"), [(1e7, 1e2), (1e4, 1e-6), (1.0, 1e-10), (1e3, 1e-4)])
def test_very_stiff_and_very_soft_ropes_swing_without_gaining_energy(
    stretching: float, bending: float
) -> None:
    lattice = line(30)
    start = along(lattice)
    law = replace(LAW, stretching_n=stretching, bending_n_m2=bending)
    times = np.linspace(0.0, 2.0, 401)
    one = problem(lattice, law, gravity=FALL, frames=401)
    path, _ = run(one, start, times, held=still([0], start, 401))
    mass = one.nodal_mass()[:, None]
    natural = np.zeros((31, 3))
    weight = 9.81 * float(mass.sum())
    for before, now, after in list(zip(path, path[1:], path[2:], strict=False))[::20]:
        rate = (after - before) / (times[2] - times[0])
        # waves of stretch are far faster than a step: what they store within one is not looked at
        _, bending_j, _ = energies(lattice, law, natural, now, directors_along(lattice, now))
        total = bending_j + 0.5 * float(np.sum(mass * rate**2)) + 9.81 * float(np.sum(mass[:, 0] * now[:, 2]))
        assert total < 0.05 * weight  # of a metre: it starts with none


@pytest.mark.parametrize("edges", [60, 240])
@pytest.mark.parametrize("changes", [{}, {"relaxation_s": 0.02}, {"torsion_ratio": 0.0}], ids=str)
def test_a_fine_rope_swings_as_a_coarse_one(edges: int, changes: dict[str, float]) -> None:
    tips = []
    for count in (30, edges):
        lattice = line(count)
        start = along(lattice)
        one = problem(
            lattice,
            replace(LAW, **changes),
            gravity=FALL,
            drag_per_s=0.3,
            natural=uniform(lattice, 2.0, 1.0, 0.5),
        )
        path, _ = run(one, start, np.array([0.0, 0.6]), held=still([0], start, 2))
        tips.append(path[-1, -1])
    assert tips[1] == pytest.approx(tips[0], abs=0.03)


def test_a_node_far_away_is_named() -> None:
    lattice = line(10)
    start = along(lattice)
    velocity = np.full_like(start, 1e3)
    found = DiscreteRods([problem(lattice)]).run(
        start, velocity, [still([], start, 2)], np.array([0.0, 0.1])
    )[0]
    assert isinstance(found, ParticlesLeftTheGrid)
    assert "a node went 100 m from its start; the rod is 1 m long" in str(found)


def test_a_run_without_numbers_is_named() -> None:
    lattice = line(10)
    start = along(lattice)
    times = np.linspace(0.0, 0.3, 4)
    held = still([0], start, 4)
    held.positions[2] = np.nan
    found = DiscreteRods([problem(lattice, frames=4)], 1e-3).run(start, np.zeros_like(start), [held], times)[
        0
    ]
    assert isinstance(found, BlewUp)
    assert "blew up at frame 2 of 4 with time step 0.001 s" in str(found)


def test_bodies_laws_and_terms_of_another_kind_are_refused() -> None:
    lattice = line(10)
    with pytest.raises(SceneUnsupported, match=r"got a body of dimension 1 and \['rod'\]"):
        DiscreteRods([replace(problem(lattice), law=RodLaw(100.0, 1e-3))])
    with pytest.raises(SceneUnsupported, match="1 rods without sections"):
        DiscreteRods([Problem(lattice, LAW, np.zeros((11, 3)), FALL)])


def test_chains_that_are_none_are_refused_with_numbers() -> None:
    with pytest.raises(ValueError, match="a rod of 1 edges"):
        chain(np.array([-1, 0]), np.array([0.0, 0.1]))
    with pytest.raises(ValueError, match="a rod of 3 edges between 0 m"):
        chain(np.array([-1, 0, 1, 2]), np.array([0.0, 0.1, 0.0, 0.1]))
    with pytest.raises(ValueError, match=r"before each of 4 nodes: \[-1, 0, 3, 2\]"):
        chain(np.array([-1, 0, 3, 2]), np.array([0.0, 0.1, 0.1, 0.1]))
    with pytest.raises(ValueError, match="2 edges begin at the first node"):
        chain(np.array([-1, 0, 0, 2]), np.array([0.0, 0.1, 0.1, 0.1]))
