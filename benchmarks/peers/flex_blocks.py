"""Blocks on a table by an engine that is not ours: MuJoCo flex of linear tetrahedra, undamped, with its own contact.

MuJoCo's contacts are soft (its constraint solver gives way by a little, in ``_GIVES_WAY_S``) and its elastic energy is
St. Venant-Kirchhoff's. Vertices weigh a quarter of the tetrahedra around them.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.peers.finite_elements import Acting, Floats, Place
from benchmarks.peers.flex_cloths import stepped

_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
_EVEN = np.array([[0, 6, 5, 3], [4, 6, 5, 0], [2, 6, 0, 3], [1, 0, 5, 3], [7, 6, 3, 5]])
_ODD = np.array([[1, 2, 4, 7], [0, 1, 2, 4], [3, 1, 7, 2], [5, 1, 4, 7], [6, 2, 7, 4]])
"""Five tetrahedra of a cell by corner (4 i + 2 j + k); neighbours take the other pattern, so that faces match."""
_RADIUS_M = 1e-4  # of the vertices, in contact: the block stands so far above the table
_GIVES_WAY_S = 0.004


@dataclass(frozen=True)
class Block:
    """A box of cells, five tetrahedra each, that stands on the plane z = 0 about the z axis.

    Attributes:
        friction: Coulomb's, of the table.
        steps_per_frame: time steps of a thirtieth of a second.
    """

    size_m: tuple[float, float, float]
    cells: tuple[int, int, int]
    young_pa: float
    poisson: float
    density_kg_m3: float
    friction: float
    steps_per_frame: int

    def vertices(self) -> Floats:
        """At rest (V, 3) [m]."""
        grid = np.stack(np.meshgrid(*(np.arange(n + 1.0) for n in self.cells), indexing="ij"), axis=-1)
        return (grid.reshape(-1, 3) / self.cells - [0.5, 0.5, 0.0]) * self.size_m + [0.0, 0.0, _RADIUS_M]

    def tetrahedra(self) -> NDArray[np.int64]:
        """Vertices of the tetrahedra (E, 4), of positive volume."""
        _, ny, nz = self.cells
        found = []
        for cell in np.ndindex(*self.cells):
            corner = np.array(cell) + _CORNERS
            number = (corner[:, 0] * (ny + 1) + corner[:, 1]) * (nz + 1) + corner[:, 2]
            found.append(number[_EVEN if sum(cell) % 2 == 0 else _ODD])
        corners = np.concatenate(found)
        turned = np.linalg.det(_sides(self.vertices(), corners)) < 0
        corners[turned] = corners[turned][:, [0, 2, 1, 3]]
        return corners

    def masses(self) -> Floats:
        """Of the vertices (V,) [kg]."""
        rest, corners = self.vertices(), self.tetrahedra()
        mass = np.zeros(len(rest))
        np.add.at(mass, corners, self.density_kg_m3 * np.linalg.det(_sides(rest, corners))[:, None] / 24.0)
        return mass

    def model(self) -> mujoco.MjModel:
        """The block and its table as MuJoCo has them."""
        numbers = " ".join(f"{value:.9g}" for value in self.vertices().ravel())
        elements = " ".join(str(number) for number in self.tetrahedra().ravel())
        contact = f'condim="3" friction="{self.friction} 0 0" solref="{_GIVES_WAY_S} 1"'
        mujoco.set_mju_user_warning(_report)
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><option integrator="Euler" cone="elliptic" impratio="10" solver="CG" iterations="60"
            tolerance="1e-9"/><size memory="400M"/><worldbody>
            <geom name="table" type="plane" size="2 2 0.1" {contact}/>
            <flexcomp name="block" type="direct" dim="3" mass="1" radius="{_RADIUS_M}" point="{numbers}"
            element="{elements}"><contact selfcollide="none" {contact}/>
            <elasticity young="{self.young_pa}" poisson="{self.poisson}" damping="0"/></flexcomp>
            </worldbody></mujoco>"""
        )
        model.body_mass[model.flex_vertbodyid] = self.masses()
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def record(
        self, acting: Acting, grips: list[tuple[NDArray[np.int64], Place]], places: Floats, times: Floats
    ) -> Floats:
        """Points (T, N, 3) [m] at evenly spaced ``times`` [s], undeformed and at rest at the first.

        Args:
            grips: vertices that are held, and how each hold moves.
            places: of the points, shares of the block's sides (N, 3).

        Raises:
            FloatingPointError: the recording blew up.
        """
        steps = round(self.steps_per_frame * (times[1] - times[0]) * 30.0)
        frames = stepped(self.model(), self.vertices(), self.masses(), acting, grips, times, steps)
        return self.between(frames, places)

    def between(self, nodes: Floats, places: Floats) -> Floats:
        """Tracks (T, N, 3) of places (N, 3) between 0 and 1 of the block, linear in its tetrahedra."""
        rest, corners = self.vertices(), self.tetrahedra()
        inverse, found = np.linalg.inv(_sides(rest, corners)), []
        for target in rest.min(axis=0) + places * self.size_m:
            local = np.einsum("eij,ej->ei", inverse, target - rest[corners[:, 0]])
            weights = np.concatenate([1.0 - local.sum(axis=1, keepdims=True), local], axis=1)
            own = int(np.argmax(weights.min(axis=1)))
            found.append(np.einsum("k,tki->ti", weights[own], nodes[:, corners[own]]))
        return np.stack(found, axis=1)


def _report(message: str) -> None:
    """MuJoCo's warnings, but for one that is wrong: it says that the flex has no passive forces."""
    if "no equality constraints or passive forces" not in message:
        print(message, file=sys.stderr)


def _sides(places: Floats, corners: NDArray[np.int64]) -> Floats:
    """Edge matrices (E, 3, 3) of tetrahedra, columns x_k - x_0."""
    return np.swapaxes(places[corners[:, 1:]] - places[corners[:, :1]], 1, 2)
