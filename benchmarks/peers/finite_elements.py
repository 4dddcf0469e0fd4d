"""An engine that is not ours, to record with: explicit finite elements of quadratic hexahedra (scikit-fem's).

Total Lagrangian, compressible neo-Hookean, mass lumped by row sums (Simpson's weights, all positive), leapfrog: no
damping but what is asked for. Nodes that a grip holds are prescribed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import skfem
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Place = Callable[
    [float], tuple[Floats, Floats]
]  # time [s] -> rotation (3, 3) and shift (3,) [m] from the start

_SAFETY = 0.7  # of the longest stable step
_ITERATIONS, _SMALL_M = 60, 1e-7
_ORDER = 4  # of the quadrature: 27 points


@dataclass(frozen=True)
class Acting:
    """What acts beside elasticity; the defaults are nothing but gravity.

    Attributes:
        gravity_m_s2: (3,).
        linear_drag_per_s: a = -c v.
        quadratic_drag_per_m: a = -k |v| v.
        viscosity_pa_s: Cauchy stress 2 eta d.
        fibre_pa, fibre_axis: second Piola-Kirchhoff stress E_ff modulus along the axis (3,), at rest.
        tether_n_m: spring between ``anchor`` (3,) [m], of length ``tether_rest_m``, and the centroid of the nodes
            within ``tether_radius_m`` of ``attach`` (3,) [m].
        push: acceleration (3,) [m/s^2] at a time [s], of the whole body.
    """

    gravity_m_s2: Floats = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    linear_drag_per_s: float = 0.0
    quadratic_drag_per_m: float = 0.0
    viscosity_pa_s: float = 0.0
    fibre_pa: float = 0.0
    fibre_axis: Floats = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    tether_n_m: float = 0.0
    tether_rest_m: float = 0.0
    tether_radius_m: float = 0.0
    anchor: Floats = field(default_factory=lambda: np.zeros(3))
    attach: Floats = field(default_factory=lambda: np.zeros(3))
    push: Callable[[float], Floats] | None = None


class Elements:
    """A body of quadratic hexahedra.

    Args:
        counts: elements along the three axes of a box from 0 to 1.
        shape: places (N, 3) [m] of points (N, 3) of that box at rest.
        young_pa: of the whole body, or at places (N, 3) [m] of it, (N,).
        poisson: likewise, one for all.
        density_kg_m3: at rest.
    """

    def __init__(
        self,
        counts: tuple[int, int, int],
        shape: Callable[[Floats], Floats],
        young_pa: float | Callable[[Floats], Floats],
        poisson: float,
        density_kg_m3: float,
    ) -> None:
        self._box = skfem.MeshHex.init_tensor(*(np.linspace(0.0, 1.0, n + 1) for n in counts))
        mesh = skfem.MeshHex(shape(self._box.p.T).T, self._box.t)
        self.basis = skfem.Basis(mesh, skfem.ElementHex2(), intorder=_ORDER)
        self.nodes = self.basis.doflocs.T.copy()
        values = np.stack([np.asarray(function[0]) for function in self.basis.basis])  # (a, c, q)
        slopes = np.stack([function[0].grad for function in self.basis.basis])  # (a, j, c, q)
        cells, points = self.basis.dx.shape
        self._slopes = np.ascontiguousarray(
            slopes.transpose(2, 0, 3, 1).reshape(cells, -1, 3 * points)
        )  # (c, a, qj)
        self._volume = self.basis.dx[..., None, None]
        self._cells = self.basis.element_dofs.T
        self.mass = np.bincount(
            self._cells.ravel(),
            (density_kg_m3 * values * self.basis.dx).sum(axis=2).T.ravel(),
            len(self.nodes),
        )
        if callable(young_pa):
            at = np.asarray(self.basis.global_coordinates())  # (3, c, q)
            modulus = young_pa(at.reshape(3, -1).T).reshape(cells, points, 1, 1)
        else:
            modulus = np.full((1, 1, 1, 1), young_pa)
        self._mu = modulus / (2 * (1 + poisson))
        self._lam = modulus * poisson / ((1 + poisson) * (1 - 2 * poisson))
        self.mu = float(self._mu.min())
        """Of the softest part [Pa]."""
        self.fastest_rad_s = self._fastest()

    def forces(self, x: Floats, v: Floats, acting: Acting) -> Floats:
        """Internal forces (N, 3) [N] at places and velocities (N, 3)."""
        F = self._gradient(x)
        inverse = np.linalg.inv(F)
        determinant = np.linalg.det(F)[..., None, None]
        turned = np.swapaxes(inverse, -1, -2)
        stress = self._mu * (F - turned) + self._lam * np.log(determinant) * turned
        if acting.viscosity_pa_s:
            rate = self._gradient(v) @ inverse
            stress += acting.viscosity_pa_s * determinant * (rate + np.swapaxes(rate, -1, -2)) @ turned
        if acting.fibre_pa:
            axis = acting.fibre_axis / np.linalg.norm(acting.fibre_axis)
            fibre = F @ axis
            strain = 0.5 * (np.sum(fibre**2, axis=-1) - 1.0)
            stress += (acting.fibre_pa * strain[..., None] * fibre)[..., None] * axis
        stress *= self._volume
        cells, points = stress.shape[:2]
        loads = self._slopes @ stress.transpose(0, 1, 3, 2).reshape(cells, 3 * points, 3)
        rows = self._cells.ravel()
        return -np.stack(
            [np.bincount(rows, loads[..., i].ravel(), len(self.nodes)) for i in range(3)], axis=1
        )

    def _fastest(self) -> float:
        """Highest natural frequency [rad/s], by power iteration from a random start."""
        way = np.random.default_rng(0).normal(size=self.nodes.shape)
        root, rest, size = np.sqrt(self.mass)[:, None], Acting(), 0.0
        for _ in range(_ITERATIONS):
            way /= np.linalg.norm(way)
            pulls = self.forces(self.nodes + _SMALL_M * way / root, np.zeros_like(way), rest)
            way = -pulls / (_SMALL_M * root)
            size = float(np.linalg.norm(way))
        return float(np.sqrt(size))

    def _gradient(self, values: Floats) -> Floats:
        """Derivatives (c, q, 3, 3) of nodal values (N, 3) by the places at rest."""
        local = self._slopes.transpose(0, 2, 1) @ values[self._cells]  # (c, qj, i)
        cells = len(local)
        return local.reshape(cells, -1, 3, 3).transpose(0, 1, 3, 2)

    def weights(self, places: Floats) -> tuple[NDArray[np.int64], Floats]:
        """Nodes (P, 27) and their weights (P, 27) of material points at ``places`` (P, 3) of the box from 0 to 1."""
        cells = self._box.element_finder()(*places.T)
        local = self._box.mapping().invF(places.T[:, :, None], tind=cells)[:, :, 0]
        shares = [np.asarray(self.basis.elem.lbasis(local, k)[0]) for k in range(self._cells.shape[1])]
        return self._cells[cells], np.stack(shares, axis=1)


def record(
    body: Elements, acting: Acting, grips: list[tuple[NDArray[np.int64], Place]], times: Floats
) -> Floats:
    """Nodes (T, N, 3) [m] at evenly spaced ``times`` [s], undeformed and at rest at the first.

    Args:
        grips: nodes that each holds, and how it moves.
    """
    gap = float(times[1] - times[0])
    fastest = body.fastest_rad_s * np.sqrt(1.0 + 0.5 * acting.fibre_pa / body.mu)
    ratio = 0.5 * fastest * acting.viscosity_pa_s / body.mu  # damping ratio of the fastest mode
    steps = int(np.ceil(gap * fastest / (2.0 * _SAFETY * (np.sqrt(1.0 + ratio**2) - ratio))))
    step = gap / steps
    x, v = body.nodes.copy(), np.zeros_like(body.nodes)
    tied = np.linalg.norm(body.nodes - acting.attach, axis=1) <= acting.tether_radius_m
    share = np.where(tied, body.mass, 0.0)[:, None] / max(float(body.mass[tied].sum()), 1e-30)
    frames = [x.copy()]
    for count in range(steps * (len(times) - 1)):
        force = body.forces(x, v, acting)
        speed = np.linalg.norm(v, axis=1, keepdims=True)
        pull = acting.linear_drag_per_s + acting.quadratic_drag_per_m * speed
        field_m_s2 = acting.gravity_m_s2 + (0.0 if acting.push is None else acting.push(count * step))
        if acting.tether_n_m:
            reach = acting.anchor - np.sum(share * x, axis=0)
            length = float(np.linalg.norm(reach))
            force += share * (acting.tether_n_m * (length - acting.tether_rest_m) * reach / length)
        kick = step if count else 0.5 * step  # velocities are those between two steps
        v += kick * (force / body.mass[:, None] + field_m_s2 - pull * v)
        now = (count + 1) * step
        for held, place in grips:
            turn, shift = place(now)
            centre = body.nodes[held].mean(axis=0)
            target = (body.nodes[held] - centre) @ turn.T + centre + shift
            v[held] = (target - x[held]) / step
        x = x + step * v
        if (count + 1) % steps == 0:
            if not np.isfinite(x).all():
                raise FloatingPointError(f"the recording blew up before {now:.3g} s at steps of {step:.3g} s")
            frames.append(x.copy())
    return np.stack(frames)


def quadrilaterals(
    corner: Floats, width_m: float, height_m: float, cells: tuple[int, int]
) -> tuple[Floats, np.ndarray]:
    """Nodes (n, 3) [m] of a plate in the plane of x and z from its lowest ``corner`` (3,) [m], and its cells (m, 4)."""
    across, up = np.meshgrid(
        np.linspace(0.0, width_m, cells[0] + 1), np.linspace(0.0, height_m, cells[1] + 1)
    )
    nodes = corner + np.stack([across.ravel(), np.zeros(across.size), up.ravel()], axis=1)
    number = np.arange(across.size).reshape(across.shape)
    corners = (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    return nodes, np.stack([c.ravel() for c in corners], axis=1)
