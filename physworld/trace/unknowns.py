"""Numbers that a trace estimates: calibrated parameters and strengths of effects, in one scale of search."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from physworld.calibrate.parameters import BENDING_RATIO, TWIST_RATIO, Parameter, bending_ratio
from physworld.effects.base import Strength
from physworld.effects.registry import EFFECTS
from physworld.engine.terms.soft_grips import AS_HELD
from physworld.estimation.unknowns import LOG, Unknown, multiple_of
from physworld.twin.twin import Twin

SOFTNESS = "grip_softness"
_SOFTNESS_SHARES = (0.1, 1.5)  # of ``AS_HELD``: finite elements as large as the grip hold so much harder
_SOFTNESS_STEP = 0.1
KNOWN_BEFOREHAND = {"poissons_ratio": 0.08, "stretching_n": 1.0, TWIST_RATIO: 0.7, BENDING_RATIO: 0.5}
"""Deviations of what is known of a parameter before any recording, about the twin's value, in the scale of the search:
of soft solids, of a taut rope, and of a sheet's bending over that of a homogeneous plate of its thickness."""


def of_parameter(parameter: Parameter, twin: Twin, known: float | tuple[float, float] | None) -> Unknown:
    """A calibrated parameter from where the twin has it.

    Args:
        parameter: of a calibration.
        twin: that has it.
        known: its prior in the scale of the search, (mean, deviation); or the deviation of one about where it is; None.
    """
    start = parameter.searched(max(_value(twin, parameter), parameter.low))
    own = Unknown(*(getattr(parameter, own.name) for own in fields(Unknown))).starting(start)
    return replace(own, prior=(own.start, known) if isinstance(known, float) else known)


def _value(twin: Twin, parameter: Parameter) -> float:
    if parameter.read is not None:
        return float(parameter.read(twin))
    known = twin.parameters
    if parameter.name in known:
        return known[parameter.name]
    if parameter.name == BENDING_RATIO:
        return bending_ratio(twin)
    if parameter.name == "youngs_modulus_pa":  # of a sheet: what its membrane stiffness says
        thickness = twin.body.thickness_m
        return known["membrane_n_m"] * (1 - known["poissons_ratio"] ** 2) / thickness
    raise KeyError(f"the twin has no {parameter.name}; it has {sorted(known)}")


def of_strength(
    effect: str,
    strength: Strength,
    step: float | None = None,
    start: float = 0.0,
    spread: float | None = None,
) -> Unknown:
    """A strength in units of its probe, whether it is calibrated or an effect's.

    Args:
        effect: name in the registry.
        strength: as the effect declares it.
        step: of finite differences, in the strength's unit as what follows; None for its probe.
        start: where a search begins.
        spread: deviation about zero of what is known beforehand; None if nothing is.
    """
    unit = strength.probe
    return Unknown(
        f"{effect}.{strength.name}",
        strength.unit,
        strength.low,
        strength.high,
        lambda twin, value: with_strengths(twin, effect, {strength.name: value}),
        multiple_of(unit),
        step=1.0 if step is None else step / unit,
        start=start / unit,
        prior=None if spread is None else (0.0, spread / unit),
    )


def grip_softness(twin: Twin) -> Unknown | None:
    """Over how many cells grips take hold, as a logarithm; None for a twin whose grips prescribe nodes.

    What recorded the body, another engine's mesh or a real grip, holds a part of a section harder or softer than the
    declared box would. The range is what coarse finite elements do. A search starts at ``AS_HELD``: with grips that
    hold as hard as prescribed nodes another, softer body fits about as well, and nothing leads away from there.
    """
    if twin.grip_softness <= 0:
        return None
    low, high = (share * AS_HELD for share in _SOFTNESS_SHARES)
    unknown = Unknown(
        SOFTNESS, "cells", low, high, lambda changed, value: replace(changed, grip_softness=value), LOG,
        _SOFTNESS_STEP,
    )  # fmt: skip
    return unknown.starting(float(np.log(twin.grip_softness)))


def hold_unknowns(twin: Twin) -> list[Unknown]:
    """How the twin's grips hold it: their softness, and what effects say of how far they hold and give."""
    found = [grip_softness(twin)]
    for name, kind in EFFECTS.items():
        if (own := kind.calibrated(twin)) is not None:
            found.append(of_strength(name, own.strength, own.step, own.start, own.spread))
    return [unknown for unknown in found if unknown is not None]


def already(twin: Twin, gate: Unknown) -> float:
    """A gate's place where the twin has its effect, in the scale of the search; 0 where it has not."""
    effect, name = gate.name.split(".")
    values = next((known.values for known in twin.effects if known.name == effect), {})
    return float(values.get(name) or 0.0) / gate.value(1.0)


def with_strengths(twin: Twin, effect: str, strengths: dict[str, float]) -> Twin:
    """A twin whose effect of that name has these strengths, its others as they are."""
    present = [known for known in twin.effects if known.name == effect]
    now = present[0] if present else EFFECTS[effect]()
    return twin.with_effect(replace(now, **strengths))
