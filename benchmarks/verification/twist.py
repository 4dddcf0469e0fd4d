"""Verification of twisted ropes: Greenhill's and Michell's critical twists, and Calugareanu's writhe.

The two buckling cases take the engine's own forces, linearise them about the twisted equilibrium by central
differences, and find the moment at which the stiffness of the free nodes becomes singular. No run, no imperfection.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from scipy.linalg import eigh, null_space
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from benchmarks.verification.cases import Case
from physworld.devices import default_device
from physworld.engine.lattice.lattice import Lattice, box_lattice
from physworld.engine.problem import Problem
from physworld.engine.thin.twist import BoundTwist, Twist, span_between
from physworld.engine.total.forces import InternalForces
from physworld.materials.rod import RodLaw

_ON: dict[str, Any] = {"device": default_device()}
LENGTH = 0.4
ROD = RodLaw(stretching_n=2e4, bending_n_m2=2e-2, density_kg_m=0.05)
GREENHILL = 2 * brentq(lambda x: np.sin(x) - x * np.cos(x), 4.4, 4.6)
"""M L / B at which two clamped ends without thrust let go: tan(M L / 2B) = M L / 2B (Greenhill 1883)."""
MICHELL = 2 * np.pi * np.sqrt(3.0)
"""M L / B of a ring of a naturally straight rod (Michell 1890, Goriely 2006)."""
_STEP = 1e-6  # of differences, in cells


def _lattice(cells: int) -> tuple[Lattice, np.ndarray, np.ndarray]:
    """A rope of ``LENGTH`` between two held cells, its material from 0 on: lattice, node coordinates, free nodes."""
    dx = LENGTH / cells
    lattice = box_lattice(np.array([-dx]), np.array([LENGTH + 2 * dx]), (cells + 2,))
    return lattice, lattice.node_coordinates[:, 0], np.arange(3, len(lattice.nodes) - 3)


def _bound(lattice: Lattice, start: np.ndarray, turns: np.ndarray, times: np.ndarray) -> BoundTwist:
    """The twist of the rope between its held cells, whose grips turn by ``turns`` (2, T, 3, 3)."""
    span = span_between(lattice, start, (0.0, LENGTH), turns, times)
    assert span is not None
    bound = Twist((span,)).bind(Problem(lattice, ROD, start, np.zeros(3)))
    bound.begin(times)
    return bound


class _Forces:
    """Forces of the law and of a unit twisting moment at nodal positions."""

    def __init__(self, lattice: Lattice, start: np.ndarray) -> None:
        axis = np.squeeze(lattice.interpolation(np.array([[LENGTH]]), (1,)) @ start)
        turn = Rotation.from_rotvec(np.array([0.0, 1.0])[:, None] * axis / np.linalg.norm(axis)).as_matrix()
        still = np.repeat(np.eye(3)[None], 2, axis=0)
        self._twist = _bound(lattice, start, np.stack([still, turn]), np.array([0.0, 1.0]))
        self._law = InternalForces(lattice, ROD, np.ones(lattice.fill.size), start, default_device())
        self._still = wp.zeros(3, dtype=wp.float64, **_ON)
        self._clock = wp.array([1.0, 1.0, 1.0], dtype=wp.float64, **_ON)
        self._counter = wp.array([1, 0, 1], dtype=wp.int32, **_ON)

    def law(self, x: np.ndarray) -> np.ndarray:
        force = wp.zeros(x.size, dtype=wp.float64, **_ON)
        self._law.launch(wp.array(x.reshape(-1), dtype=wp.float64, **_ON), self._still, force)
        return force.numpy()

    def twist(self, x: np.ndarray) -> np.ndarray:
        force, nodes = (
            wp.zeros(x.size, dtype=wp.float64, **_ON),
            wp.array(x.reshape(-1), dtype=wp.float64, **_ON),
        )
        self._twist.launch(nodes, nodes, self._clock, self._counter, force)
        return force.numpy() / self._twist.moments_n_m[0]


def _stiffness(forces: object, x: np.ndarray, free: np.ndarray, step: float) -> np.ndarray:
    """Minus the derivative of nodal ``forces`` at ``x`` by the free nodes, symmetric, (3f, 3f)."""
    slots = (3 * free[:, None] + np.arange(3)).reshape(-1)
    columns = []
    for slot in slots:
        ends = []
        for sign in (1, -1):
            moved = x.reshape(-1).copy()
            moved[slot] += sign * step
            ends.append(forces(moved.reshape(x.shape))[slots])  # type: ignore[operator]
        columns.append((ends[1] - ends[0]) / (2 * step))
    matrix = np.array(columns)
    return 0.5 * (matrix + matrix.T)


def _critical(
    forces: _Forces, x: np.ndarray, free: np.ndarray, step: float, idle: np.ndarray | None = None
) -> float:
    """M L / B at which the stiffness at ``x`` becomes singular, but for a motion ``idle`` (n, 3) that costs nothing."""
    law = _stiffness(forces.law, x, free, step)
    turned = _stiffness(forces.twist, x, free, step)
    if idle is not None:
        others = null_space(idle[free].reshape(1, -1))
        law, turned = others.T @ law @ others, others.T @ turned @ others
    most = eigh(-turned, law, eigvals_only=True)[-1]
    return float(LENGTH / (most * ROD.bending_n_m2))


def greenhill(cells: float) -> float:
    """Relative error of the twisting moment that buckles a straight rod between two clamps, without thrust."""
    lattice, s, free = _lattice(int(cells))
    rest = np.zeros((len(s), 3))
    rest[:, 0] = s
    return _critical(_Forces(lattice, rest), rest, free, _STEP * LENGTH / cells) / GREENHILL - 1


def michell(cells: float) -> float:
    """Relative error of the twisting moment that throws a ring of a straight rod out of its plane."""
    lattice, s, free = _lattice(int(cells))
    radius, step = LENGTH / (2 * np.pi), _STEP * LENGTH / cells
    h = LENGTH / cells / radius
    ring = np.zeros((len(s), 3))  # splines of quadratic order shrink a wave of nodes by (3 + cos h) / 4
    ring[:, 0], ring[:, 1] = radius * np.sin(s / radius), -radius * np.cos(s / radius)
    ring /= (3 + np.cos(h)) / 4
    forces = _Forces(lattice, ring)
    x, slots = ring.copy(), (3 * free[:, None] + np.arange(3)).reshape(-1)
    for _ in range(5):  # the discrete ring's equilibrium without twist
        push = forces.law(x)[slots]
        x.reshape(-1)[slots] += np.linalg.solve(_stiffness(forces.law, x, free, step), push)
    rolling = np.cross(
        [1.0, 0.0, 0.0], x - [0.0, -radius, 0.0]
    )  # about the held tangent: the section turns back
    return _critical(forces, x, free, step, rolling) / MICHELL - 1


def _coil(u: np.ndarray, height: float) -> np.ndarray:
    """A closed curve that winds three times about a torus while it goes round once, (N, 3)."""
    out = 1.0 + height * np.cos(3 * u)
    return np.stack([out * np.cos(u), out * np.sin(u), height * np.sin(3 * u)], axis=-1)


def gauss_writhe(height: float, count: int = 2000) -> float:
    """Writhe of the coil by Gauss's double integral, with no frame or transport in it."""
    u = 2 * np.pi * np.arange(count) / count
    points, step = _coil(u, height), 1e-5
    slopes = (_coil(u + step, height) - _coil(u - step, height)) / (2 * step)
    total = 0.0
    for k in range(count):
        apart = points[k] - points
        distance = np.linalg.norm(apart, axis=1)
        distance[k] = 1.0
        apart[k] = 0.0
        total += float(np.sum(np.einsum("ij,ij->i", np.cross(slopes[k], slopes), apart) / distance**3))
    return total * (2 * np.pi / count) ** 2 / (4 * np.pi)


def writhe(cells: float, height: float = 0.45, frames: int = 31) -> float:
    """Relative error of the twist of a ribbon, closed with Lk = 0, while its axis is coiled: Tw = Lk - Wr."""
    lattice, _, _ = _lattice(int(cells))
    times = np.linspace(0.0, 1.0, frames)
    rows = lattice.interpolation(lattice.particle_coordinates).toarray()
    u = 2 * np.pi * lattice.particle_coordinates[:, 0] / LENGTH
    shapes, turns = [], []
    for share in times:
        shapes.append(np.linalg.lstsq(rows, _coil(u, share * height), rcond=None)[0])
        slope = _coil(np.array([1e-6]), share * height)[0] - _coil(np.array([-1e-6]), share * height)[0]
        turns.append(Rotation.from_rotvec([np.arctan2(slope[2], slope[1]), 0.0, 0.0]).as_matrix())
    bound = _bound(lattice, shapes[0], np.stack([turns, turns]), times)
    clock = wp.array([times[1], 1 / times[1], times[1]], dtype=wp.float64, **_ON)
    for frame, x in enumerate(shapes):
        nodes, force = (
            wp.array(x.reshape(-1), dtype=wp.float64, **_ON),
            wp.zeros(x.size, dtype=wp.float64, **_ON),
        )
        bound.launch(nodes, nodes, clock, wp.array([frame, 0, 1], dtype=wp.int32, **_ON), force)
    return float(bound.angles_rad[0] / (-2 * np.pi * gauss_writhe(height)) - 1)


CASES = (
    Case("greenhill", "twisted rod between clamps: moment that buckles it", "Greenhill, 8.987 B/L", "dx",
         (16, 32, 64), greenhill, 5e-3, 1.7),
    Case("michell", "twisted ring: moment that throws it out of its plane", "Michell, 2π√3 B/L", "dx",
         (24, 48, 96), michell, 3e-3, 1.7),
    Case("writhe", "closed ribbon coiled in space: its twist", "Lk − Wr, Gauss's integral", "dx",
         (24, 48, 96), writhe, 2e-3, 1.7),
)  # fmt: skip
