"""Bodies recorded by Kratos Multiphysics: corotational beams and shells, solids in the total Lagrangian form.

Newmark's rule with gamma = 1/2 and beta = 1/4, which loses nothing by itself. Linear drag is the mass-proportional part
of Rayleigh's damping.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import KratosMultiphysics as Kratos
import KratosMultiphysics.ConstitutiveLawsApplication as Laws
import KratosMultiphysics.LinearSolversApplication
import KratosMultiphysics.StructuralMechanicsApplication as Structures
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.peers.finite_elements import Acting, Floats, Place, quadrilaterals

_STEP_S = 1.0 / 480.0  # at most
_TOLERANCE, _LEFT_N, _ITERATIONS = 1e-3, 3e-6, 60
_MOVED = 1e-6  # share of what a step moves, below which an iteration changes it no more
_SHEAR = 0.9  # share of a round section that shears
_TURNING = (Kratos.ROTATION, Kratos.REACTION_MOMENT, Kratos.ANGULAR_VELOCITY, Kratos.ANGULAR_ACCELERATION)
_MOVING = (Kratos.DISPLACEMENT, Kratos.REACTION, Kratos.VELOCITY, Kratos.ACCELERATION)

Kratos.Logger.GetDefaultOutput().SetSeverity(Kratos.Logger.Severity.WARNING)


@dataclass(frozen=True)
class Mesh:
    """What Kratos is given.

    Attributes:
        nodes: at rest (n, 3) [m].
        cells: nodes of every element (m, k), from 0.
        element: its name.
        law: makes its law of the material.
        properties: values by variable.
        turning: whether nodes carry rotations.
    """

    nodes: Floats
    cells: np.ndarray
    element: str
    law: Callable[[], Any]
    properties: dict[Any, float]
    turning: bool

    def record(self, acting: Acting, held: Sequence[tuple[np.ndarray, Place]], times: Floats) -> Floats:
        """Nodes (T, n, 3) [m] at evenly spaced ``times`` [s], undeformed and at rest at the first.

        Args:
            acting: gravity, linear drag and a push; anything else is refused.
            held: nodes of every grip and how it moves, turning about the mean of its nodes.
            times: T.

        Raises:
            ValueError: something acts that this recorder does not have.
            FloatingPointError: a step that did not converge.
        """
        if acting.quadratic_drag_per_m or acting.viscosity_pa_s or acting.fibre_pa or acting.tether_n_m:
            raise ValueError("Kratos records gravity, linear drag and pushes")
        model = Kratos.Model()
        part = self._part(model, acting.linear_drag_per_s)
        strategy = _strategy(part)
        grips = [
            ([part.GetNode(int(k) + 1) for k in nodes], self.nodes[nodes], place) for nodes, place in held
        ]
        for nodes, _, _ in grips:
            for node in nodes:
                for variable in _components(_MOVING[0], _TURNING[0] if self.turning else None):
                    node.Fix(variable)
        for node in part.Nodes:  # the rule needs what a body that is let go begins with
            node.SetSolutionStepValue(Kratos.ACCELERATION, list(acting.gravity_m_s2))
        steps = int(np.ceil((times[1] - times[0]) / _STEP_S))
        found, time = [self.nodes.copy()], 0.0
        for frame in range(1, len(times)):
            for k in range(1, steps + 1):
                time = times[frame - 1] + (times[frame] - times[frame - 1]) * k / steps - times[0]
                part.CloneTimeStep(time)
                steady = acting.gravity_m_s2 + (acting.push(time) if acting.push is not None else 0.0)
                Kratos.VariableUtils().SetVariable(
                    Kratos.VOLUME_ACCELERATION, Kratos.Array3(list(steady)), part.Nodes
                )
                for nodes, rest, place in grips:
                    self._placed(nodes, rest, *place(time))
                strategy.InitializeSolutionStep()
                strategy.Predict()
                if not strategy.SolveSolutionStep():
                    raise FloatingPointError(f"the step to t = {time:.4f} s did not converge")
                strategy.FinalizeSolutionStep()
            moved = Kratos.VariableUtils().GetSolutionStepValuesVector(part.Nodes, Kratos.DISPLACEMENT, 0, 3)
            found.append(self.nodes + np.array(moved).reshape(-1, 3))
        return np.stack(found)

    def _placed(self, nodes: list[Any], rest: Floats, turn: Floats, shift: Floats) -> None:
        centre = rest.mean(axis=0)
        moved = (rest - centre) @ turn.T + centre + shift - rest
        turned = Rotation.from_matrix(turn).as_rotvec()
        for node, by in zip(nodes, moved, strict=True):
            node.SetSolutionStepValue(Kratos.DISPLACEMENT, list(by))
            if self.turning:
                node.SetSolutionStepValue(Kratos.ROTATION, list(turned))

    def _part(self, model: Any, drag_per_s: float) -> Any:
        part = model.CreateModelPart("body")
        part.SetBufferSize(2)
        part.ProcessInfo[Kratos.DOMAIN_SIZE] = 3
        for variable in (*_MOVING, Kratos.VOLUME_ACCELERATION, *(_TURNING if self.turning else ())):
            part.AddNodalSolutionStepVariable(variable)
        for k, place in enumerate(self.nodes):
            part.CreateNewNode(k + 1, *(float(c) for c in place))
        properties = part.CreateNewProperties(1)
        damping = {Structures.RAYLEIGH_ALPHA: drag_per_s, Structures.RAYLEIGH_BETA: 0.0}
        for variable, value in (self.properties | damping).items():
            properties.SetValue(variable, value)
        properties.SetValue(Kratos.CONSTITUTIVE_LAW, self.law())
        for k, cell in enumerate(self.cells):
            part.CreateNewElement(self.element, k + 1, [int(n) + 1 for n in cell], properties)
        pairs = [(_MOVING[0], _MOVING[1])] + ([(_TURNING[0], _TURNING[1])] if self.turning else [])
        for free, reaction in pairs:
            for one, other in zip(_components(free), _components(reaction), strict=True):
                Kratos.VariableUtils().AddDof(one, other, part)
        return part


def _components(*variables: Any) -> list[Any]:
    names = [v.Name() for v in variables if v is not None]
    return [Kratos.KratosGlobals.GetVariable(f"{name}_{axis}") for name in names for axis in "XYZ"]


def _strategy(part: Any) -> Any:
    scheme = Kratos.ResidualBasedBossakDisplacementScheme(0.0)
    solver = Kratos.LinearSolverFactory().Create(
        Kratos.Parameters('{"solver_type": "LinearSolversApplication.sparse_lu"}')
    )
    criteria = Kratos.ResidualCriteria(_TOLERANCE, _LEFT_N), Kratos.DisplacementCriteria(_MOVED, 1e-9)
    for one in criteria:
        one.SetEchoLevel(0)
    builder = Kratos.ResidualBasedBlockBuilderAndSolver(solver)
    strategy = Kratos.ResidualBasedNewtonRaphsonStrategy(
        part, scheme, Kratos.OrCriteria(*criteria), builder, _ITERATIONS, False, False, True
    )
    strategy.SetEchoLevel(0)
    strategy.Initialize()
    return strategy


def rod(top: Floats, way: Floats, length_m: float, radius_m: float, young_pa: float, poisson: float,
        density_kg_m3: float, elements: int) -> Mesh:  # fmt: skip
    """A round rod from ``top`` (3,) [m] along ``way`` (3,), of corotational beams that shear."""
    along = np.asarray(way) / np.linalg.norm(way)
    area, inertia = np.pi * radius_m**2, 0.25 * np.pi * radius_m**4
    nodes = top + np.linspace(0.0, length_m, elements + 1)[:, None] * along
    cells = np.stack([np.arange(elements), np.arange(1, elements + 1)], axis=1)
    properties = {
        Kratos.DENSITY: density_kg_m3, Kratos.YOUNG_MODULUS: young_pa, Kratos.POISSON_RATIO: poisson,
        Structures.CROSS_AREA: area, Structures.I22: inertia, Structures.I33: inertia,
        Structures.TORSIONAL_INERTIA: 2.0 * inertia, Structures.AREA_EFFECTIVE_Y: _SHEAR * area,
        Structures.AREA_EFFECTIVE_Z: _SHEAR * area,
    }  # fmt: skip
    return Mesh(nodes, cells, "CrBeamElement3D2N", Structures.BeamConstitutiveLaw, properties, True)


def plate(corner: Floats, width_m: float, height_m: float, cells: tuple[int, int], thickness_m: float, young_pa: float,
          poisson: float, density_kg_m3: float) -> Mesh:  # fmt: skip
    """A plate in the plane of x and z from its lowest ``corner`` (3,) [m], of corotational
    shells that do not shear."""
    nodes, quads = quadrilaterals(corner, width_m, height_m, cells)
    properties = {
        Kratos.DENSITY: density_kg_m3, Kratos.YOUNG_MODULUS: young_pa, Kratos.POISSON_RATIO: poisson,
        Kratos.THICKNESS: thickness_m,
    }  # fmt: skip
    return Mesh(nodes, quads, "ShellThinElementCorotational3D4N",
                Structures.LinearElasticPlaneStress2DLaw, properties, True)  # fmt: skip


def block(shape: Callable[[Floats], Floats], cells: tuple[int, int, int], young_pa: float, poisson: float,
          density_kg_m3: float) -> Mesh:  # fmt: skip
    """Hexahedra of a neo-Hookean solid in a unit cube that ``shape`` maps to places [m]."""
    axes = [np.linspace(0.0, 1.0, count + 1) for count in cells]
    unit = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(unit)).reshape([count + 1 for count in cells])
    low, high = slice(None, -1), slice(1, None)
    ends = ((low, low, low), (high, low, low), (high, high, low), (low, high, low), (low, low, high),
            (high, low, high), (high, high, high), (low, high, high))  # fmt: skip
    properties = {
        Kratos.DENSITY: density_kg_m3,
        Kratos.YOUNG_MODULUS: young_pa,
        Kratos.POISSON_RATIO: poisson,
    }
    return Mesh(shape(unit), np.stack([number[end].ravel() for end in ends], axis=1),
                "TotalLagrangianElement3D8N", Laws.HyperElastic3DLaw, properties, False)  # fmt: skip
