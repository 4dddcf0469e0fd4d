"""Bodies recorded by OpenSees: corotational beams and shells with lumped masses.

Newmark's rule with gamma = 1/2 and beta = 1/4, which loses nothing by itself. Linear drag is the mass-proportional part
of Rayleigh's damping. Hands do not turn: held nodes keep their rotations, and follow the hands' ways by single-point
constraints. ``pip install opensees``: it needs packages that cannot be locked for every Python that PhysWorld takes, so
it is in no extra.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import opensees.openseespy as opensees

from benchmarks.peers.finite_elements import Acting, Floats, Place, quadrilaterals

_BEAM_STEP_S, _SHELL_STEP_S = 1.0 / 1920.0, 1.0 / 960.0
_MOVED_M, _ITERATIONS = 1e-10, 40
_GRAVITY, _HANDS = 1, 2  # load patterns


@dataclass(frozen=True)
class Mesh:
    """What OpenSees is given.

    Attributes:
        nodes: at rest (n, 3) [m].
        cells: nodes of every element (m, 2 or 4), from 0.
        mass: of the nodes (n,) [kg].
        turning: rotational inertia of the nodes (n,) [kg m²].
        section: of the elements: A, E, G, J, Iy, Iz of beams; E, Poisson's ratio, thickness of shells.
        step_s: of time, at most [s].
    """

    nodes: Floats
    cells: np.ndarray
    mass: Floats
    turning: Floats
    section: tuple[float, ...]
    step_s: float

    def record(self, acting: Acting, held: Sequence[tuple[np.ndarray, Place]], times: Floats) -> Floats:
        """Nodes (T, n, 3) [m] at evenly spaced ``times`` [s], undeformed and at rest at the first.

        Args:
            acting: gravity and linear drag; anything else is refused.
            held: nodes of every grip and how it moves, without turning.
            times: T.

        Raises:
            ValueError: something acts that this recorder does not have.
            FloatingPointError: a step that did not converge.
        """
        refused = (acting.quadratic_drag_per_m, acting.viscosity_pa_s, acting.fibre_pa, acting.tether_n_m)
        if any(refused) or acting.push is not None:
            raise ValueError("OpenSees records gravity and linear drag")
        frame_s = float(times[1] - times[0])
        steps = int(np.ceil(frame_s / self.step_s))
        model = self._model(acting)
        self._led(model, held, np.arange(steps * len(times) + 2) * (frame_s / steps))
        model.constraints("Transformation")
        model.numberer("RCM")
        model.system("UmfPack")
        model.test("NormDispIncr", _MOVED_M * np.sqrt(6 * len(self.nodes)), _ITERATIONS)
        model.algorithm("Newton")
        model.integrator("Newmark", 0.5, 0.25)
        model.analysis("Transient")
        found = [self.nodes.copy()]
        for frame in range(1, len(times)):
            for _ in range(steps):
                if model.analyze(1, frame_s / steps) != 0:
                    raise FloatingPointError(f"a step to t = {times[frame]:.4f} s did not converge")
            moved = [model.nodeDisp(k + 1)[:3] for k in range(len(self.nodes))]
            found.append(self.nodes + np.array(moved))
        return np.stack(found)

    def _model(self, acting: Acting) -> Any:
        model = opensees.Model("basic", "-ndm", 3, "-ndf", 6)
        for k, place in enumerate(self.nodes):
            model.node(k + 1, *(float(c) for c in place))
            m, i = float(self.mass[k]), float(self.turning[k])
            model.mass(k + 1, m, m, m, i, i, i)
        if self.cells.shape[1] == 2:
            along = self.nodes[1] - self.nodes[0]
            model.geomTransf("Corotational", 1, *(float(c) for c in np.eye(3)[np.argmin(np.abs(along))]))
            for k, (one, other) in enumerate(self.cells):
                model.element("elasticBeamColumn", k + 1, int(one) + 1, int(other) + 1, *self.section, 1)
        else:
            young, poisson, thickness = self.section
            model.section("ElasticMembranePlateSection", 1, young, poisson, thickness, 0.0)
            for k, cell in enumerate(self.cells):
                model.element("ASDShellQ4", k + 1, *(int(n) + 1 for n in cell), 1, "-corotational")
        model.rayleigh(acting.linear_drag_per_s, 0.0, 0.0, 0.0)
        model.timeSeries("Constant", _GRAVITY)
        model.pattern("Plain", _GRAVITY, _GRAVITY)
        for k, mass in enumerate(self.mass):
            weight = mass * np.asarray(acting.gravity_m_s2)
            model.load(k + 1, *(float(f) for f in weight), 0.0, 0.0, 0.0, pattern=_GRAVITY)
            for axis in range(3):  # the rule needs what a body that is let go begins with
                model.setNodeAccel(k + 1, axis + 1, float(acting.gravity_m_s2[axis]), "-commit")
        return model

    def _led(self, model: Any, held: Sequence[tuple[np.ndarray, Place]], at: Floats) -> None:
        """Lead the held nodes: one series of each hand and axis, rotations at 0."""
        number = _HANDS
        for nodes, place in held:
            shifts = np.array([place(time)[1] for time in at])
            for axis in range(3):
                values = [float(v) for v in shifts[:, axis]]
                model.timeSeries("Path", number, "-dt", float(at[1] - at[0]), "-values", *values)
                model.pattern("Plain", number, number)
                for node in nodes:
                    model.sp(int(node) + 1, axis + 1, 1.0, pattern=number)
                number += 1
            for node in nodes:
                model.fix(int(node) + 1, 0, 0, 0, 1, 1, 1)


def rod(top: Floats, way: Floats, length_m: float, radius_m: float, young_pa: float, poisson: float,
        density_kg_m3: float, elements: int) -> Mesh:  # fmt: skip
    """A round rod from ``top`` (3,) [m] along ``way`` (3,), of corotational beams that do not shear."""
    along = np.asarray(way) / np.linalg.norm(way)
    area, inertia = np.pi * radius_m**2, 0.25 * np.pi * radius_m**4
    nodes = top + np.linspace(0.0, length_m, elements + 1)[:, None] * along
    cells = np.stack([np.arange(elements), np.arange(1, elements + 1)], axis=1)
    share = np.full(elements + 1, length_m / elements)
    share[[0, -1]] *= 0.5
    section = (area, young_pa, young_pa / (2.0 * (1.0 + poisson)), 2.0 * inertia, inertia, inertia)
    return Mesh(
        nodes,
        cells,
        density_kg_m3 * area * share,
        density_kg_m3 * 2.0 * inertia * share,
        section,
        _BEAM_STEP_S,
    )


def plate(corner: Floats, width_m: float, height_m: float, cells: tuple[int, int], thickness_m: float, young_pa: float,
          poisson: float, density_kg_m3: float) -> Mesh:  # fmt: skip
    """A plate in the plane of x and z from its lowest ``corner`` (3,) [m], of corotational shells."""
    nodes, quads = quadrilaterals(corner, width_m, height_m, cells)
    share = np.zeros(len(nodes))
    np.add.at(share, quads.ravel(), width_m * height_m / len(quads) / 4.0)
    mass = density_kg_m3 * thickness_m * share
    return Mesh(
        nodes, quads, mass, mass * thickness_m**2 / 12.0, (young_pa, poisson, thickness_m), _SHELL_STEP_S
    )
