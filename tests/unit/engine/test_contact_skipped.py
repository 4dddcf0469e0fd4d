"""Points far from a still collider are not looked at, and contact takes no more of the time step than it must."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import GRAVITY, NeoHookean, rest_nodes, still_clamp
from same_numbers import assert_same
from scipy import sparse
from scipy.sparse.linalg import eigsh

from physworld.engine.lattice.lattice import box_lattice
from physworld.engine.problem import Problem
from physworld.engine.terms.colliders import Collider, largest_share, reach_of_nodes
from physworld.engine.terms.colliders_path import RigidPath
from physworld.engine.terms.contact import ColliderContact, contact_points
from physworld.engine.total.formulation import TotalLagrangian
from physworld.shapes import sdf

LAW = NeoHookean(2e5, 0.3, 20.0, 1000.0)
BLOCK = box_lattice(np.array([-0.05, -0.05, 0.05]), np.array([0.1, 0.1, 0.05]), (4, 4, 2))
TIMES = np.linspace(0, 0.4, 13)
SHAPES = {"ground": (sdf.half_space(), np.zeros(3)), "ball": (sdf.sphere(0.04), np.array([0.01, 0.0, -0.04]))}


def collider(name: str, poses: int) -> Collider:
    """The same place in one pose, or in two between which it would be looked for."""
    shape, place = SHAPES[name]
    times = np.linspace(0.0, 1.0, poses)
    return Collider(
        name, shape, RigidPath(times, np.tile(place, (poses, 1)), np.tile(np.eye(3), (poses, 1, 1))), 0.4
    )


def ready(terms: tuple) -> TotalLagrangian:
    return TotalLagrangian(
        Problem(BLOCK, LAW, rest_nodes(BLOCK), np.asarray(GRAVITY, dtype=float), terms=terms)
    )


def thrown(solver: TotalLagrangian) -> np.ndarray:
    """Paths of a block that is thrown down and spins: its sides and edges touch in turn."""
    rest = rest_nodes(BLOCK)
    spin = np.cross(np.array([0.0, 8.0, 3.0]), rest - rest.mean(axis=0)) + np.array([0.2, 0.0, -1.0])
    return solver.run(rest, spin, still_clamp(BLOCK, rest, len(TIMES), clamped=False), TIMES)


@pytest.mark.parametrize("name", SHAPES)
def test_points_that_are_not_looked_at_change_nothing(name: str) -> None:
    still, always = (ready((ColliderContact(collider(name, poses)),)) for poses in (1, 2))
    assert still.time_step_s == always.time_step_s
    assert_same(thrown(still), thrown(always))
    assert still.terms[0].deepest_m == always.terms[0].deepest_m > 0  # it did touch


def test_a_second_run_of_a_solver_is_the_first() -> None:
    solver = ready((ColliderContact(collider("ground", 1)),))
    assert_same(thrown(solver), thrown(solver))


def test_what_a_run_that_blew_up_left_does_not_count() -> None:
    solver, fresh = (ready((ColliderContact(collider("ground", 1)),)) for _ in range(2))
    term = solver.terms[0]
    term._seen.fill_(np.nan)  # no way from there has a length
    term._clearance.fill_(1.0)
    assert_same(thrown(solver), thrown(fresh))


def test_the_share_is_the_largest_eigenvalue_from_above() -> None:
    points, areas, groups = contact_points(BLOCK)
    matrix = BLOCK.interpolation(points)
    mass = TotalLagrangian(Problem(BLOCK, LAW, rest_nodes(BLOCK), np.zeros(3))).mass
    scaling = sparse.diags(1 / np.sqrt(mass))
    for group in np.unique(groups):
        measures = np.where(groups == group, areas, 0.0)
        operator = scaling @ matrix.T @ sparse.diags(measures) @ matrix @ scaling
        exact = float(eigsh(operator.tocsc(), k=1, return_eigenvectors=False)[0])
        bound = largest_share(matrix, measures, mass)
        assert exact <= bound * (1 + 1e-12) and bound <= 1.05 * exact
        assert bound < float((matrix.T @ measures / mass).max())  # Gershgorin's


def test_no_point_outruns_its_nodes() -> None:
    matrix = BLOCK.interpolation(contact_points(BLOCK)[0])
    reach = reach_of_nodes(matrix)
    rng = np.random.default_rng(3)
    for _ in range(50):
        ways = rng.normal(size=(matrix.shape[1], 3)) * rng.lognormal(sigma=2.0, size=(matrix.shape[1], 1))
        points = np.linalg.norm(matrix @ ways, axis=1).max()
        assert points <= (reach * np.linalg.norm(ways, axis=1)).max() * (1 + 1e-12)
