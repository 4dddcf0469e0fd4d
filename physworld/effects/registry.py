"""Every effect by name, in the order in which a twin applies them.

A new one is a file beside this one and a line here; other packages add theirs after ours (:mod:`physworld.catalogue`).

Shape and fields come first, then what changes gravity (buoyancy scales it, wind adds to it), then forces and stresses,
contacts and grips; the growth of the law's stiffness puts itself before every other term. A camera scales, then
stamps, smooths and drifts.
"""

from __future__ import annotations

from physworld.catalogue import with_plugins
from physworld.effects.actuation_lag import ActuationLag
from physworld.effects.adhesion import Adhesion
from physworld.effects.air_drag_across import AirDragAcross
from physworld.effects.air_drag_linear import AirDragLinear
from physworld.effects.air_drag_quadratic import AirDragQuadratic
from physworld.effects.air_on_sheet import AirOnSheet
from physworld.effects.anisotropy import Anisotropy
from physworld.effects.base import Effect
from physworld.effects.buoyancy import Buoyancy
from physworld.effects.clamp_offset import ClampOffset
from physworld.effects.dry_friction import DryFriction
from physworld.effects.gravity_tilt import GravityTilt
from physworld.effects.grip_slip import GripSlip
from physworld.effects.ground_friction import GroundFriction
from physworld.effects.internal_friction import InternalFriction
from physworld.effects.mass_field import MassField
from physworld.effects.measurement_clock import MeasurementClock
from physworld.effects.measurement_drift import MeasurementDrift
from physworld.effects.measurement_scale import MeasurementScale
from physworld.effects.measurement_smoothing import MeasurementSmoothing
from physworld.effects.measurement_turn import MeasurementTurn
from physworld.effects.plasticity import Plasticity
from physworld.effects.region_force import RegionForce
from physworld.effects.rest_shape import RestShape
from physworld.effects.stiffness_field import StiffnessField
from physworld.effects.strain_stiffening import StrainStiffening
from physworld.effects.swirl import Swirl
from physworld.effects.tether import Tether
from physworld.effects.time_varying_stiffness import TimeVaryingStiffness
from physworld.effects.viscoelastic_maxwell import ViscoelasticMaxwell
from physworld.effects.viscosity_kelvin_voigt import ViscosityKelvinVoigt
from physworld.effects.wind import Wind
from physworld.errors import UnknownEffect

_BUILT_IN: tuple[type[Effect], ...] = (
    RestShape,
    StiffnessField,
    MassField,
    GravityTilt,
    Buoyancy,
    Wind,
    AirDragLinear,
    AirDragQuadratic,
    AirDragAcross,
    DryFriction,
    InternalFriction,
    ViscosityKelvinVoigt,
    ViscoelasticMaxwell,
    Anisotropy,
    StrainStiffening,
    Plasticity,
    Tether,
    RegionForce,
    Swirl,
    GroundFriction,
    Adhesion,
    ActuationLag,
    ClampOffset,
    GripSlip,
    AirOnSheet,
    TimeVaryingStiffness,
    MeasurementTurn,
    MeasurementScale,
    MeasurementClock,
    MeasurementSmoothing,
    MeasurementDrift,
)
EFFECTS: dict[str, type[Effect]] = with_plugins(
    "physworld.effects", Effect, {kind.name: kind for kind in _BUILT_IN}
)


def in_order(effects: tuple[Effect, ...]) -> list[Effect]:
    """Those that are active, in the order of the registry."""
    places = list(EFFECTS)
    return sorted((e for e in effects if e.active), key=lambda e: places.index(e.name))


def effect(name: str, **strengths: float | None) -> Effect:
    """The effect of that name with these strengths, the others at their defaults.

    Raises:
        UnknownEffect: no such effect, or it has no such strength.
    """
    if name not in EFFECTS:
        raise UnknownEffect(f"no effect is called {name!r}; the registry has {', '.join(sorted(EFFECTS))}")
    known = EFFECTS[name]().values
    unknown = sorted(set(strengths) - set(known))
    if unknown:
        raise UnknownEffect(f"{name} has no strengths {unknown}; it has {', '.join(known)}")
    return EFFECTS[name](**strengths)
