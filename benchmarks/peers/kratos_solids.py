"""Solids that Kratos Multiphysics records with quadratic hexahedra and explicit central differences.

The rule has no damping of its own, and its steps are so short that time costs little accuracy: ``kratos_bodies`` steps
implicitly and 1.8 mm beside what it records with half the step. Linear drag is Rayleigh's part in proportion to mass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import KratosMultiphysics as Kratos
import KratosMultiphysics.ConstitutiveLawsApplication as Laws
import KratosMultiphysics.StructuralMechanicsApplication as Structures
import numpy as np

from benchmarks.peers.finite_elements import Acting, Floats, Place

_AXES = "XYZ"
_FLIES_M = 10.0  # a node that went further has blown up
# Kratos' order of the 27 nodes of a hexahedron: corners, edges, faces, middle
_NODES = np.array(
    [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1), (-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1),
     (0, -1, -1), (1, 0, -1), (0, 1, -1), (-1, 0, -1), (-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0),
     (0, -1, 1), (1, 0, 1), (0, 1, 1), (-1, 0, 1), (0, 0, -1), (0, -1, 0), (1, 0, 0), (0, 1, 0), (-1, 0, 0),
     (0, 0, 1), (0, 0, 0)]
)  # fmt: skip

Kratos.Logger.GetDefaultOutput().SetSeverity(Kratos.Logger.Severity.WARNING)


class Solid:
    """A neo-Hookean solid of quadratic hexahedra.

    Args:
        lines: where cells begin and end along the three axes of the unit cube, from 0 to 1.
        shape: places (N, 3) [m] at rest of points (N, 3) of that cube.
    """

    def __init__(self, lines: Sequence[Sequence[float]], shape: Callable[[Floats], Floats], young_pa: float,
                 poisson: float, density_kg_m3: float) -> None:  # fmt: skip
        self._lines = [np.asarray(line, dtype=float) for line in lines]
        grids = [np.sort(np.concatenate([line, 0.5 * (line[1:] + line[:-1])])) for line in self._lines]
        self._size = [len(grid) for grid in grids]
        unit = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1).reshape(-1, 3)
        self.nodes = shape(unit)
        cells = np.indices([len(line) - 1 for line in self._lines]).reshape(3, -1).T
        at = 2 * cells[:, None] + 1 + _NODES
        self._cells = np.ravel_multi_index(np.moveaxis(at, -1, 0), self._size)
        self._constants = {Kratos.DENSITY: density_kg_m3, Kratos.YOUNG_MODULUS: young_pa,
                           Kratos.POISSON_RATIO: poisson}  # fmt: skip

    def weights(self, unit: Floats) -> tuple[np.ndarray, Floats]:
        """Nodes (N, 27) about places (N, 3) of the unit cube, and the shape functions there (N, 27)."""
        first, values = [], []
        for axis, line in enumerate(self._lines):
            cell = np.clip(np.searchsorted(line, unit[:, axis], side="right") - 1, 0, len(line) - 2)
            s = 2.0 * (unit[:, axis] - line[cell]) / (line[cell + 1] - line[cell]) - 1.0
            first.append(2 * cell)
            values.append(np.stack([0.5 * s * (s - 1.0), 1.0 - s**2, 0.5 * s * (s + 1.0)], axis=1))
        near = np.indices((3, 3, 3)).reshape(3, -1)
        nodes = np.ravel_multi_index([f[:, None] + n for f, n in zip(first, near, strict=True)], self._size)
        shares = np.prod([v[:, n] for v, n in zip(values, near, strict=True)], axis=0)
        return nodes, shares

    def record(self, acting: Acting, held: Sequence[tuple[np.ndarray, Place]], times: Floats,
               step_s: float) -> Floats:  # fmt: skip
        """Nodes (T, n, 3) [m] at evenly spaced ``times`` [s], undeformed and at rest at the first.

        Args:
            acting: gravity, linear drag and a push; anything else is refused.
            held: nodes of every grip and how it moves, turning about the mean of its nodes.
            times: T.
            step_s: at most; stable steps are shorter than about half of what sound takes between two nodes.

        Raises:
            ValueError: something acts that this recorder does not have.
            FloatingPointError: the step is not stable.
        """
        if acting.quadratic_drag_per_m or acting.viscosity_pa_s or acting.fibre_pa or acting.tether_n_m:
            raise ValueError("Kratos records gravity, linear drag and pushes")
        part = _part(Kratos.Model(), self, acting.linear_drag_per_s)
        grips = [
            ([part.GetNode(int(k) + 1) for k in nodes], self.nodes[nodes], place) for nodes, place in held
        ]
        for nodes, _, _ in grips:
            for node in nodes:
                for axis in _AXES:
                    node.Fix(Kratos.KratosGlobals.GetVariable(f"DISPLACEMENT_{axis}"))
        scheme = Structures.ExplicitCentralDifferencesScheme(1.0, 0.5, 0)
        strategy = Structures.MechanicalExplicitStrategy(part, scheme, False, False, True)
        strategy.SetRebuildLevel(0)
        strategy.SetEchoLevel(0)
        _load(part, acting, 0.0)
        strategy.Initialize()
        frame_s = times[1] - times[0]
        steps = int(np.ceil(frame_s / step_s - 1e-9))
        found = [self.nodes.copy()]
        for frame in range(len(times) - 1):
            for k in range(1, steps + 1):
                time = frame_s * (frame + k / steps)
                part.CloneTimeStep(time)
                _load(part, acting, time - frame_s / steps)
                strategy.InitializeSolutionStep()
                strategy.SolveSolutionStep()
                strategy.FinalizeSolutionStep()
                for nodes, rest, place in grips:
                    _placed(nodes, rest, *place(time))
            moved = Kratos.VariableUtils().GetSolutionStepValuesVector(part.Nodes, Kratos.DISPLACEMENT, 0, 3)
            moved = np.array(moved).reshape(-1, 3)
            if not np.all(np.abs(moved) < _FLIES_M):
                raise FloatingPointError(f"steps of {frame_s / steps:.2e} s are not stable")
            found.append(self.nodes + moved)
        return np.stack(found)


def _part(model: Any, solid: Solid, drag_per_s: float) -> Any:
    part = model.CreateModelPart("body")
    part.SetBufferSize(2)
    part.ProcessInfo[Kratos.DOMAIN_SIZE] = 3
    part.ProcessInfo[Kratos.COMPUTE_LUMPED_MASS_MATRIX] = True
    for variable in (Kratos.DISPLACEMENT, Kratos.REACTION, Kratos.VELOCITY, Kratos.ACCELERATION,
                     Kratos.VOLUME_ACCELERATION, Structures.MIDDLE_VELOCITY, Kratos.NODAL_MASS, Kratos.FORCE_RESIDUAL,
                     Kratos.RESIDUAL_VECTOR):  # fmt: skip
        part.AddNodalSolutionStepVariable(variable)
    for k, place in enumerate(solid.nodes):
        part.CreateNewNode(k + 1, *(float(c) for c in place))
    properties = part.CreateNewProperties(1)
    damping = {Structures.RAYLEIGH_ALPHA: drag_per_s, Structures.RAYLEIGH_BETA: 0.0}
    for variable, value in (solid._constants | damping).items():
        properties.SetValue(variable, value)
        if variable in damping:
            part.ProcessInfo[variable] = value
    properties.SetValue(Kratos.CONSTITUTIVE_LAW, Laws.HyperElastic3DLaw())
    for k, cell in enumerate(solid._cells):
        part.CreateNewElement("TotalLagrangianElement3D27N", k + 1, [int(n) + 1 for n in cell], properties)
    for axis in _AXES:
        one, other = (
            Kratos.KratosGlobals.GetVariable(f"{name}_{axis}") for name in ("DISPLACEMENT", "REACTION")
        )
        Kratos.VariableUtils().AddDof(one, other, part)
    return part


def _load(part: Any, acting: Acting, time: float) -> None:
    steady = acting.gravity_m_s2 + (acting.push(time) if acting.push is not None else 0.0)
    Kratos.VariableUtils().SetVariable(Kratos.VOLUME_ACCELERATION, Kratos.Array3(list(steady)), part.Nodes)


def _placed(nodes: list[Any], rest: Floats, turn: Floats, shift: Floats) -> None:
    """After a step, for the rule does not move what is fixed, and elements read places, not displacements."""
    centre = rest.mean(axis=0)
    moved = (rest - centre) @ turn.T + centre + shift
    for node, place, start in zip(nodes, moved, rest, strict=True):
        node.SetSolutionStepValue(Kratos.DISPLACEMENT, list(place - start))
        node.X, node.Y, node.Z = (float(c) for c in place)
