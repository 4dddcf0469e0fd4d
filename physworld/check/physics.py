"""What a check simulates: the declared physics before any calibration, and the numbers that one would search.

Numbers are where nothing but the scene and priors puts them: a stiffness in the middle of the range that is searched, a
Poisson's ratio where the law has it, the numbers of a discrete rod or a hung cloth at the means of their priors, and
whatever the caller knows better. Density is never among them: only ratios to it show.

Every number has a prior here. Where a calibration has one it is that; a number with bounds only is as likely anywhere
in them, and has the deviation of that. Damping of solids and sheets begins at none, and the value that its search
starts from is its deviation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import numpy as np

from physworld.arrays import Array
from physworld.calibrate import CalibrationConfig
from physworld.calibrate.cloths import cloth_parameters, with_priors
from physworld.calibrate.global_stage import prior_twin, searched_parameters
from physworld.calibrate.parameters import Parameter
from physworld.calibrate.rod_parameters import LOSSES, rod_parameters, steps_seen
from physworld.effects.clamp_offset import REACH
from physworld.estimation.unknowns import LOG, Unknown, at, multiple_of, starts_of
from physworld.geometry.sheet_body import is_hung_sheet
from physworld.scene import Scene
from physworld.trace.unknowns import KNOWN_BEFOREHAND, hold_unknowns, of_parameter
from physworld.twin.grips import softly_held
from physworld.twin.twin import Twin

_OF_EVEN = 12.0**-0.5  # deviation over width of a number that is as likely anywhere between two bounds
_KINKED = (REACH,)  # a clamp that holds less far changes other nodes than one that holds farther
_STEPS_BY, _LEAST_STEP = (
    3.0,
    1e-3,
)  # deviations that a step of finite differences spans; over the step of a search
_GENTLE = 0.3  # step of a damping that is switched on, over the value that its search starts from


@dataclass(frozen=True)
class Physics:
    """The declared physics.

    Attributes:
        twin: with every number at its start.
        unknowns: numbers that a calibration would search, each with a prior; starting where the twin has them.
        optional: names of those that a calibration frees only where data ask for them, such as damping; to a trace
            these are effects.
        given: names of those whose value the caller gave.
    """

    twin: Twin
    unknowns: tuple[Unknown, ...]
    optional: frozenset[str]
    given: frozenset[str]

    @property
    def probed(self) -> tuple[Unknown, ...]:
        """The unknowns as they are varied: those with a kink at their start both ways, as if they were two numbers."""
        kinked = (replace(u, step=-u.step) for u in self.unknowns if u.name in _KINKED)
        return (*self.unknowns, *kinked)

    def stepped(self, ratios: Array) -> Physics:
        """With steps of the size of what is left open, for a derivative is wanted where the answer will lie.

        Args:
            ratios: posterior over prior deviations of the probed numbers, (p,).
        """
        known: dict[str, float] = {}
        for unknown, ratio in zip(self.probed, ratios, strict=True):
            assert unknown.prior is not None
            known[unknown.name] = max(known.get(unknown.name, 0.0), float(ratio) * unknown.prior[1])
        return replace(
            self,
            unknowns=tuple(
                replace(u, step=float(np.clip(_STEPS_BY * known[u.name], _LEAST_STEP * u.step, u.step)))
                for u in self.unknowns
            ),
        )


def declared_physics(scene: Scene, calibration: CalibrationConfig, values: Mapping[str, float]) -> Physics:
    """The declared physics of a scene.

    Args:
        scene: the recording, of which only the first frame and the controls are used.
        calibration: whose unknowns these are.
        values: what is known better of some of them, by name, in their unit.

    Raises:
        SceneUnsupported: the scene declares too little for a body.
        ValueError: a value is of no such number, or beyond its bounds.
    """
    twin = prior_twin(scene, calibration)
    hung = is_hung_sheet(scene, calibration.mesh)
    if twin.natural is not None:
        twin = replace(twin, drive=steps_seen(scene))
        known = rod_parameters(scene, twin)
        twin, optional = at(twin, known, starts_of(known)), {p.name for p in known if p.name in LOSSES}
    elif hung:
        twin = with_priors(scene, twin)
        known = cloth_parameters(scene, twin)
        kept = {p.name for p in cloth_parameters(scene, twin, damping=False)}
        twin, optional = at(twin, known, starts_of(known)), {p.name for p in known} - kept
    else:
        known = searched_parameters(scene, twin, calibration)
        for parameter in (p for p in known if p.stage == "stiffness"):
            twin = parameter.at(
                twin, float(np.mean([parameter.searched(start) for start in parameter.starts]))
            )
        twin = softly_held(twin)
        optional = {p.name for p in known if _only_if_asked(p)}
    for name, value in values.items():
        twin = _with_value(twin, known, name, value)
    unknowns = [_of(p, twin, values.get(p.name), own_prior=twin.natural is not None or hung) for p in known]
    holds = [] if twin.natural is not None or hung else hold_unknowns(twin)
    return Physics(
        twin, tuple(_with_prior(u) for u in (*unknowns, *holds)), frozenset(optional), frozenset(values)
    )


def _only_if_asked(parameter: Parameter) -> bool:
    """Whether a trace would not calibrate it: damping, and what else has a name among the effects or a free shape."""
    always = ("poissons_ratio", "ground_friction", *KNOWN_BEFOREHAND)
    return parameter.stage in ("shape", "optional", "fibres") and parameter.name not in always


def _with_value(twin: Twin, known: list[Parameter], name: str, value: float) -> Twin:
    parameter = next((p for p in known if p.name == name), None)
    if parameter is None:
        raise ValueError(
            f"this scene has no {name!r} to be calibrated; it has {', '.join(p.name for p in known)}"
        )
    if not parameter.low <= value <= parameter.high:
        raise ValueError(
            f"{name} of {value:g} {parameter.unit} is not within {parameter.low:g} and {parameter.high:g}"
        )
    return parameter.apply(twin, value)


def _of(parameter: Parameter, twin: Twin, value: float | None, own_prior: bool) -> Unknown:
    """A parameter as an unknown that starts where the twin has it."""
    if own_prior:
        plain = Unknown(*(getattr(parameter, own.name) for own in fields(Unknown)))
        return plain if value is None else plain.starting(plain.searched(value))
    if parameter.stage == "optional" and parameter.transform is LOG and parameter.held == 0.0:
        return _from_none(parameter, value)
    return of_parameter(parameter, twin, KNOWN_BEFOREHAND.get(parameter.name))


def _from_none(parameter: Parameter, value: float | None) -> Unknown:
    """A damping, searched about none in multiples of the value that its search starts from."""
    unit = parameter.starts[0]
    return Unknown(
        parameter.name, parameter.unit, 0.0, parameter.high, parameter.apply, multiple_of(unit), _GENTLE,
        start=0.0 if value is None else value / unit, prior=(0.0, 1.0),
    )  # fmt: skip


def _with_prior(unknown: Unknown) -> Unknown:
    if unknown.prior is not None:
        return unknown
    low, high = unknown.bounds
    return replace(unknown, prior=(unknown.start, _OF_EVEN * (high - low)))
