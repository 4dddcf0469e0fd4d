"""Verification against an engine that is not ours: scikit-fem, finite elements with quadratic hexahedra.

The same law (compressible neo-Hookean), the same beam, clamped at its end face: how far it sags under gravity when its
deflection is a third of its length, and how fast it swings. The peer's own error is measured by refining it.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import skfem
from scipy import sparse
from scipy.sparse.linalg import eigsh, spsolve

from benchmarks.verification.cases import (
    CLAMP_REACH,
    GRAVITY,
    Case,
    clamped_lattice,
    gripped,
    path,
    rest_nodes,
    ringing,
    run,
)
from benchmarks.verification.solids import SILICONE, SILICONE_SIZE, bending_mode
from physworld.materials.neo_hookean import NeoHookean
from physworld.materials.solid import SolidLaw

SAG_SIZE = (0.2, 0.04, 0.04)
SAG_LAW = NeoHookean(1.2e5, 0.35, density_kg_m3=1000.0)
_STEPS = 4  # load steps of the peer's Newton iteration
_TOLERANCE = 1e-9  # of the peer's last Newton step, over the length


class Peer:
    """A clamped box of quadratic hexahedra under the neo-Hookean law; elements and quadrature are scikit-fem's."""

    def __init__(self, size: tuple[float, ...], cells: tuple[int, ...], law: SolidLaw) -> None:
        axes = [np.linspace(0.0, length, count + 1) for length, count in zip(size, cells, strict=True)]
        self.basis = skfem.Basis(skfem.MeshHex.init_tensor(*axes), skfem.ElementHex2(), intorder=4)
        self.law = law
        self.slopes = np.stack([function[0].grad for function in self.basis.basis])  # (a, j, cell, point)
        self.values = np.stack([np.asarray(function[0]) for function in self.basis.basis])
        self.dofs = self.basis.element_dofs.T  # (cell, a)
        clamped = self.basis.get_dofs(lambda x: np.isclose(x[0], 0.0)).all()
        nodes = np.setdiff1d(np.arange(self.basis.N), clamped)
        self.free = (3 * nodes[:, None] + np.arange(3)).ravel()

    def forces(self, u: np.ndarray) -> tuple[np.ndarray, sparse.csc_matrix]:
        """Internal forces (3N,) [N] at displacements ``u`` (N, 3) [m] and their derivative, on the free degrees."""
        mu, lam = self.law.lame
        F = np.einsum("cai,ajcq->cqij", u[self.dofs], self.slopes) + np.eye(3)
        inverse = np.linalg.inv(F)
        log_j = np.log(np.linalg.det(F))[..., None, None]
        stress = mu * (F - np.swapaxes(inverse, -1, -2)) + lam * log_j * np.swapaxes(inverse, -1, -2)
        swap = np.einsum("cqjk,cqli->cqijkl", inverse, inverse)
        tangent = (
            mu * np.einsum("ik,jl->ijkl", np.eye(3), np.eye(3)) + (mu - lam * log_j[..., None, None]) * swap
        )
        tangent += lam * np.einsum("cqji,cqlk->cqijkl", inverse, inverse)
        local = np.einsum("cqij,ajcq,cq->cai", stress, self.slopes, self.basis.dx)
        force = np.zeros((self.basis.N, 3))
        np.add.at(force, self.dofs, local)
        slopes = np.moveaxis(self.slopes, (2, 3), (0, 1))  # (c, q, a, j)
        first = np.einsum("cqaj,cqijkl,cq->cqaikl", slopes, tangent, self.basis.dx, optimize=True)
        blocks = np.einsum("cqaikl,cqbl->caibk", first, slopes, optimize=True)
        return force.ravel(), self._assembled(blocks)

    def inertia(self) -> sparse.csc_matrix:
        """Consistent mass matrix [kg]."""
        local = np.einsum("acq,bcq,cq->cab", self.values, self.values, self.basis.dx) * self.law.density_kg_m3
        return self._assembled(np.einsum("cab,ik->caibk", local, np.eye(3)))

    def weight(self) -> np.ndarray:
        """Gravity's load (3N,) [N]."""
        local = np.einsum("acq,cq->ca", self.values, self.basis.dx) * self.law.density_kg_m3
        load = np.zeros((self.basis.N, 3))
        np.add.at(load, self.dofs, local[..., None] * GRAVITY)
        return load.ravel()

    def _assembled(self, blocks: np.ndarray) -> sparse.csc_matrix:
        cells, size = blocks.shape[0], blocks.shape[1] * 3
        index = (3 * self.dofs[..., None] + np.arange(3)).reshape(cells, size)
        rows, columns = np.repeat(index, size, axis=1).ravel(), np.tile(index, (1, size)).ravel()
        shape = (3 * self.basis.N, 3 * self.basis.N)
        return sparse.csc_matrix((blocks.ravel(), (rows, columns)), shape=shape)[self.free][:, self.free]


@cache
def peer_sag(across: int = 3) -> np.ndarray:
    """Displacement (3,) [m] of the middle of the free end of the sagging beam; ``across`` elements thick."""
    peer = Peer(SAG_SIZE, (5 * across, across, across), SAG_LAW)
    load, u = peer.weight(), np.zeros((peer.basis.N, 3))
    for step in range(1, _STEPS + 1):
        for _ in range(30):
            force, stiffness = peer.forces(u)
            change = spsolve(stiffness, ((step / _STEPS) * load - force)[peer.free])
            u.reshape(-1)[peer.free] += change
            if np.abs(change).max() < _TOLERANCE * SAG_SIZE[0]:
                break
    tip = np.array([[SAG_SIZE[0]], [SAG_SIZE[1] / 2], [SAG_SIZE[2] / 2]])
    return np.asarray(peer.basis.probes(tip) @ u).reshape(3)


@cache
def peer_frequency(across: int = 3) -> float:
    """First bending angular frequency [rad/s] of the silicone beam, by finite elements with a consistent mass."""
    peer = Peer(SILICONE_SIZE, (round(10 * across / 3), across, across), SILICONE)
    stiffness = peer.forces(np.zeros((peer.basis.N, 3)))[1]
    return float(np.sqrt(eigsh(stiffness, k=1, M=peer.inertia(), sigma=0.0)[0][0]))


def sag(cells: float, across: int = 3) -> float:
    """Distance between our tip and the peer's, over the sag; the peer is ``across`` elements thick."""
    count = int(cells)
    lattice = clamped_lattice(SAG_SIZE[0], SAG_SIZE[1:], (count, count // 5, count // 5), CLAMP_REACH)
    times = np.linspace(0.0, 2.5, 26)
    nodes = run(lattice, SAG_LAW, times, gripped(lattice), drag_per_s=12.0)
    place = (SAG_SIZE[0], SAG_SIZE[1] / 2, SAG_SIZE[2] / 2)
    exact = peer_sag(across)
    return float(np.linalg.norm(path(lattice, nodes, place)[-1] - place - exact) / np.linalg.norm(exact))


def frequency(cells: float) -> float:
    """Relative difference of the silicone beam's first bending frequency to the peer's."""
    count = int(cells)
    across = round(4 * count / 13)
    lattice = clamped_lattice(SILICONE_SIZE[0], SILICONE_SIZE[1:], (count, across, across), CLAMP_REACH)
    rest = rest_nodes(lattice)
    velocity = np.zeros_like(rest)
    velocity[:, 2] = 0.01 * bending_mode(np.clip(rest[:, 0] / SILICONE_SIZE[0], 0, None))
    exact = peer_frequency(4)
    times = np.linspace(0.0, 4 * 2 * np.pi / exact, 120)
    nodes = run(lattice, SILICONE, times, gripped(lattice), gravity=np.zeros(3), velocity=velocity)
    return ringing(times, path(lattice, nodes, (0.1, 0.015, 0.015))[:, 2], exact)[1] / exact - 1


CASES = (
    Case("peer_sag", "soft beam sagging by half its length: tip", "scikit-fem, quadratic hexahedra", "dx",
         (10, 15, 20), sag, 0.01, 1.2),
    Case("peer_frequency", "silicone beam, first bending frequency", "scikit-fem, quadratic hexahedra", "dx",
         (7, 13, 20), frequency, 0.01, 0.8),
)  # fmt: skip
