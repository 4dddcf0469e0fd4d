"""Which numbers of a twin a global calibration may change, their scales, bounds and units.

Stiffness and friction are positive and span decades: they are searched in the logarithm. With gravity, ground and
prescribed grips only ratios to the density show, so the density is never a parameter here: it stays as declared, or
at its prior, and the report says so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from physworld.materials.laws import RodLaw, SheetLaw, SolidLaw
from physworld.twin import Twin

_LOG_STEP = 0.02  # finite-difference step in the logarithm


@dataclass(frozen=True)
class Parameter:
    """One searched number, positive.

    Attributes:
        name: what reports call it, with its unit in ``unit``.
        unit: SI unit.
        low, high: bounds of the search.
        start: starts of the search, best first by prior knowledge.
        apply: a twin with this value.
        stage: "stiffness" parameters come first; "damping" ones are added only if the data ask for them.
    """

    name: str
    unit: str
    low: float
    high: float
    start: tuple[float, ...]
    apply: Callable[[Twin, float], Twin]
    stage: str
    step: float = _LOG_STEP


def parameters_of(twin: Twin, separate_bending: bool) -> list[Parameter]:
    """Parameters of the twin's shape.

    Args:
        twin: the twin to calibrate.
        separate_bending: sheets only: bending is searched apart from stretch (no thickness is declared).
    """
    law, density = twin.law, twin.density
    length = float(np.ptp(twin.body.start, axis=0).max())
    drag = Parameter("air_drag_per_s", "1/s", 1e-3, 30.0, (0.3,), _set("air_drag_per_s"), "damping", 0.1)
    if isinstance(law, SolidLaw):
        soft = density * 9.81 * length  # stress under the body's own weight
        grid = tuple(float(soft * f) for f in np.logspace(1.0, 4.0, 9))
        return [
            Parameter("youngs_modulus_pa", "Pa", soft * 1.5, soft * 1e5, grid, _set("youngs_modulus_pa"), "stiffness"),
            drag,
            Parameter("viscosity_pa_s", "Pa s", 1e-5 * soft, 0.1 * soft, (1e-3 * soft,), _set("viscosity_pa_s"),
                      "damping", 0.1),
        ]  # fmt: skip
    relaxation = Parameter("relaxation_s", "s", 1e-5, 0.1, (3e-3,), _set("relaxation_s"), "damping", 0.1)
    if isinstance(law, SheetLaw):
        unit = density * 9.81 * length
        grid = tuple(float(unit * f) for f in np.logspace(1.0, 3.5, 6))
        thickness = twin.body.thickness_m
        if not separate_bending:
            linked = _sheet_modulus(thickness)
            scale = (1 - law.poissons_ratio**2) / thickness
            return [
                Parameter("youngs_modulus_pa", "Pa", grid[0] * scale / 5, grid[-1] * scale * 5,
                          tuple(g * scale for g in grid), linked, "stiffness"),
                drag, relaxation,
            ]  # fmt: skip
        bend = unit * length**2
        return [
            Parameter("bending_n_m", "N m", 1e-7 * bend, 1e-1 * bend, tuple(bend * f for f in (1e-5, 1e-4, 1e-3, 1e-2)),
                      _set("bending_n_m"), "stiffness", 0.1),
            Parameter("membrane_n_m", "N/m", unit * 5, unit * 1e3, (unit * 60,), _set("membrane_n_m"), "stiffness",
                      0.1),
            drag, relaxation,
        ]  # fmt: skip
    if not isinstance(law, RodLaw):
        raise TypeError(f"no parameters for {type(law).__name__}")
    unit = density * 9.81 * length**3
    return [
        Parameter("bending_n_m2", "N m^2", 1e-6 * unit, unit, tuple(unit * f for f in (1e-4, 1e-3, 1e-2, 1e-1)),
                  _set("bending_n_m2"), "stiffness", 0.05),
        drag, relaxation,
    ]  # fmt: skip


def _set(name: str) -> Callable[[Twin, float], Twin]:
    return lambda twin, value: twin.with_parameters(**{name: value})


def _sheet_modulus(thickness: float) -> Callable[[Twin, float], Twin]:
    def apply(twin: Twin, modulus: float) -> Twin:
        nu = twin.parameters["poissons_ratio"]
        membrane = modulus * thickness / (1 - nu**2)
        return twin.with_parameters(membrane_n_m=membrane, bending_n_m=membrane * thickness**2 / 12)

    return apply
