"""Every effect by name. A new one is a file beside this one and a line here."""

from __future__ import annotations

from physworld.effects.actuation_lag import ActuationLag
from physworld.effects.air_drag_linear import AirDragLinear
from physworld.effects.base import Effect
from physworld.effects.gravity_tilt import GravityTilt
from physworld.errors import UnknownEffect

EFFECTS: dict[str, type[Effect]] = {
    kind.name: kind
    for kind in (
        AirDragLinear,
        GravityTilt,
        ActuationLag,
    )
}


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
