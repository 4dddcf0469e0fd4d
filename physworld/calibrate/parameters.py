"""Which numbers of a twin a global calibration may change, their scales, bounds and units.

Stiffness and friction are positive and span decades: they are searched in the logarithm; Poisson's ratio is searched
as it is. With gravity, ground and prescribed grips only ratios to the density show, so the density is never a
parameter here: it stays as declared, or at its prior, and the report says so.

A *stiffness* is always searched, and with it where a flow law yields, the torsion of a rope that two grips turn and how
stiff a sheet is in twist beside bending, if the body has them and the data show them: the prior of a yield stress is a
value that nothing reaches. A *shape* of the bending energy is freed next, as a whole: how stiff a sheet bends beside
what its declared thickness says, and how its two curvatures are coupled. The *fibres* of a transversely isotropic
solid are freed together too, modulus and direction (:mod:`physworld.calibrate.fibres`); their prior is none. The others
are *optional*: air drag, internal friction, Poisson's ratio, the friction of a ground that declares none, the
share of a solid's stiffness that fades (:func:`relaxing`), by how much a measured frame is out of level
(:func:`level`), and what weft and shear of a woven sheet have over its warp; each is freed only if the data ask for it,
and else stays at its prior.

Internal friction that is proportional to stiffness damps the lattice's fastest motions most, and an explicit step has
to resolve that: beyond a point the stable time step is inversely proportional to it. A recording shows nothing of these
motions. So the search ends where that step is ``SLOWEST`` times smaller than without friction (:func:`affordable`); a
value found there is reported to be at the bound of its search. Beyond it a run takes sub-steps of friction
(:mod:`physworld.engine.total.relaxation`) and twice the time and more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.optimize import brentq

from physworld.arrays import Array
from physworld.effects.gravity_tilt import GravityTilt
from physworld.effects.viscoelastic_maxwell import ViscoelasticMaxwell
from physworld.engine.total.formulation import TotalLagrangian
from physworld.estimation.unknowns import LINEAR, LOG, Transform, Unknown
from physworld.materials.plastic import (
    PLASTICITIES,
    DruckerPrager,
    Identity,
    Plasticity,
    StVenantKirchhoff,
    VonMises,
)
from physworld.materials.rod import RodLaw
from physworld.materials.sheet import OrthotropicSheetLaw, SheetLaw
from physworld.materials.solid import SolidLaw
from physworld.materials.transversely_isotropic import TransverselyIsotropic
from physworld.scene import AS_MEASURED, Scene
from physworld.twin.twin import Twin

BENDING, STRETCHING = "bending_n_m2", "stretching_n"  # E I and E A of a rope
TWIST_RATIO = "bending_twist_ratio"
BENDING_RATIO = "bending_ratio"  # D over K h^2 / 12
BENDING_COUPLING = "bending_coupling"
_LOG_STEP = 0.02  # finite-difference step in the logarithm
_POISSON_BOUNDS, _POISSON_STEP = (0.0, 0.48), 0.02
_LEAST_GAIN = 0.02  # share of the training cost that an optional parameter must remove
_POISSON_GAIN = 0.15  # the same of Poisson's ratio, which absorbs a little of whatever else is missing
_TAUT = 0.98  # of its length between two grips: closer together it is slack
_TWIST_BOUNDS, _STRETCHING_BOUNDS = (0.1, 10.0), (0.01, 20.0)  # the latter: factors on what it begins with
_BENDING_BOUNDS, _COUPLING_BOUNDS = (0.1, 10.0), (-2.0, 2.0)
_BENDING_GAIN = 0.1  # share of the training cost, of the shape of a sheet's bending energy
_SHEET_STARTS = 14  # of a sheet's stiffness: its phase slips within a factor of two
FIBRE_MODULUS = "fibre_modulus_pa"
FIBRE_ANGLES = ("fibre_azimuth_rad", "fibre_elevation_rad")
WEAVE = ("weft_ratio", "shear_ratio", "bending_weft_ratio")
_WEAVE_BOUNDS = {"weft_ratio": (0.05, 20.0), "shear_ratio": (0.003, 5.0), "bending_weft_ratio": (0.02, 50.0)}
_FIBRES_GAIN = 0.1  # share of the training cost, of fibres
_FRICTION_BOUNDS = (0.02, 3.0)
RELAXING_SHARE = "relaxing_share"
RELEASE_DELAY = "release_delay_s"
TILTS = {"gravity_tilt_x_rad": "tilt_x_rad", "gravity_tilt_y_rad": "tilt_y_rad"}
OF_RECORDING = frozenset({RELEASE_DELAY, *TILTS})
"""Names of what belongs to a recording, and not to the object."""
_LONGEST_RELEASE_S = 0.1  # of a hand that opens
_RELAXING_GAIN = 0.1  # share of the training cost, of stiffness that fades
_LARGEST_TILT_RAD = 0.1  # of a measured frame: markers some centimetres apart, known to a millimetre or two
_TILT_GAIN = 0.1  # share of the training cost, of each of its two angles
_MOST_BRANCHES = 5  # of one decade each
_NEVER_PA = 1e12  # a yield stress that nothing reaches
_SAND_RAD = 0.6  # friction angle of loose dry sand
_FLOW_PRIORS: dict[type[Plasticity], dict[str, float]] = {
    VonMises: {"yield_stress_pa": _NEVER_PA},
    StVenantKirchhoff: {"yield_stress_pa": _NEVER_PA},
    DruckerPrager: {"friction_angle_rad": _SAND_RAD},
}


@dataclass(frozen=True, kw_only=True)
class Parameter(Unknown):
    """An unknown of a calibration.

    Attributes:
        starts: of the search, in its unit, best first by prior knowledge; an optional one has one.
        stage: "stiffness" parameters come first, and over a grid with them what a "flow" law or a twisted rope has,
            or a "taut" one, which are dropped again if the data do not need them; those of a "shape" and of "fibres"
            are freed together, "optional" ones one by one, if the data ask for them.
        held: value of one that is not freed.
        least_gain: share of the training cost that freeing an optional one must remove.
        proportional: what it does is proportional to it, either way, so that what it promises to first order is about
            what it removes.
        read: its value in a twin, in its unit; None: it is among the twin's ``parameters`` or follows from them.
        recording: number of the recording that it belongs to, where several are fitted; None: it is the object's.
    """

    starts: tuple[float, ...]
    stage: Literal["stiffness", "flow", "taut", "shape", "fibres", "optional"]
    transform: Transform = LOG
    step: float = _LOG_STEP
    held: float = 0.0
    least_gain: float = _LEAST_GAIN
    proportional: bool = False
    read: Callable[[Twin], float] | None = None
    recording: int | None = None


def parameters_of(
    twin: Twin,
    separate_bending: bool,
    damping: bool = True,
    ground_friction: bool = False,
    taut: bool = False,
) -> list[Parameter]:
    """Parameters of the twin's shape, those of stiffness first.

    Args:
        twin: the twin to calibrate; its values are the priors of what is optional.
        separate_bending: sheets only: bending is searched apart from stretch (no thickness is declared).
        damping: air drag and internal friction may be freed.
        ground_friction: the friction of the ground is not declared and may be freed.
        taut: it hangs taut (:func:`hangs_taut`).
    """
    law = twin.law
    optional = []
    if damping:
        optional += [_positive("air_drag_per_s", "1/s", 1e-3, 30.0, 0.3), _internal_friction(twin)]
    if isinstance(law, SolidLaw | SheetLaw):
        prior, apply = law.poissons_ratio, _poissons_ratio(twin, separate_bending)
        optional.append(
            Parameter("poissons_ratio", "1", *_POISSON_BOUNDS, apply, transform=LINEAR, step=_POISSON_STEP,
                      starts=(prior,), stage="optional", held=prior, least_gain=_POISSON_GAIN)
        )  # fmt: skip
    if ground_friction and "ground_friction" in twin.parameters:
        prior = twin.parameters["ground_friction"]
        optional.append(
            Parameter("ground_friction", "1", *_FRICTION_BOUNDS, _rubs, step=0.05, starts=(prior,),
                      stage="optional", held=prior)
        )  # fmt: skip
    return [
        *_stiffness(twin, separate_bending, taut),
        *(_stretching(twin) if taut else ()),
        *_torsion(twin),
        *_twist(twin),
        *_flow(twin),
        *_shape(twin, separate_bending),
        *_fibres(twin),
        *_weave(twin),
        *optional,
    ]


def relaxing(twin: Twin, times: Array) -> list[Parameter]:
    """How much of an elastic solid's stiffness fades, the same share in every decade from a frame to the recording.

    Elastomers lose about the same share of their energy in slow and in fast swings, and creep with it; internal
    friction alone damps slow swings too little, and makes what hangs at rest as stiff as what rings.

    Args:
        twin: the twin to calibrate.
        times: of the frames [s], (T,).
    """
    if not isinstance(twin.law, SolidLaw) or twin.plasticity is not None or twin.form.on_particles:
        return []
    first = 0.5 * float(np.median(np.diff(times)))
    decades = 1 + int(np.ceil(np.log10(float(times[-1] - times[0]) / first)))

    def apply(changed: Twin, share: float) -> Twin:
        branches = min(decades, _MOST_BRANCHES)
        return changed.with_effect(ViscoelasticMaxwell(share=share, relaxation_s=first, branches=branches))

    return [
        Parameter(RELAXING_SHARE, "1", 1e-3, 1.0, apply, step=0.1, starts=(0.04,), stage="optional",
                  least_gain=_RELAXING_GAIN)
    ]  # fmt: skip


def release(twin: Twin, times: Array) -> list[Parameter]:
    """How long after its first motion a body that somebody held swings freely: fingers open in some frames.

    Args:
        twin: the twin to calibrate.
        times: of the frames [s], (T,).
    """
    if twin.release_s == 0.0 or twin.natural is not None:
        return []
    frame = float(np.median(np.diff(times)))
    return [
        Parameter(RELEASE_DELAY, "s", -2 * frame, max(5 * frame, _LONGEST_RELEASE_S),
                  _delayed, transform=LINEAR, step=0.25 * frame, starts=(frame,), stage="optional")
    ]  # fmt: skip


def level(scene: Scene, twin: Twin) -> list[Parameter]:
    """By how much a measured frame is out of level: gravity's direction is found by markers that err by a millimetre.

    A scene that starts undeformed and at rest was not measured so, and its gravity is taken as declared.

    Args:
        scene: the recording.
        twin: its twin.
    """
    if scene.initial_state != AS_MEASURED or twin.lattice.dim < 3 or GravityTilt.refuses(twin) is not None:
        return []
    return [
        Parameter(name, "rad", -_LARGEST_TILT_RAD, _LARGEST_TILT_RAD, _tilted(angle), transform=LINEAR, step=0.01,
                  starts=(0.02,), stage="optional", least_gain=_TILT_GAIN, proportional=True)
        for name, angle in TILTS.items()
    ]  # fmt: skip


def flow_law(name: str) -> Plasticity:
    """The flow law called ``name`` with prior numbers: one that yields nowhere, or loose dry sand.

    Raises:
        ValueError: there is no such flow law.
    """
    if name not in PLASTICITIES:
        raise ValueError(f"no flow law {name!r}; there are {sorted(PLASTICITIES)}")
    law = PLASTICITIES[name]
    return law(**_FLOW_PRIORS.get(law, {}))


def hangs_taut(scene: Scene, twin: Twin) -> bool:
    """Whether a body hangs between two grips that are as far apart as it is long, for half of the training frames.

    One that is slack by more hardly stretches, whatever it is.
    """
    grips = [
        (group, nodes)
        for group, nodes in zip(twin.controller_groups, twin.held_nodes, strict=True)
        if len(nodes)
    ]
    if len(grips) < 2:
        return False
    ends, middles = [], []
    for group, nodes in (grips[0], grips[-1]):
        went = scene.controllers[: scene.train[1], group].mean(axis=1)
        ends.append(twin.body.start[nodes].mean(axis=0) + went - went[0])
        middles.append(float(twin.lattice.node_coordinates[nodes, 0].mean()))
    apart = np.linalg.norm(ends[1] - ends[0], axis=1)
    return bool(np.median(apart) > _TAUT * abs(middles[1] - middles[0]))


def _stretching(twin: Twin) -> list[Parameter]:
    """E A of a rope that hangs taut: it sags as far as it stretches, and swings by its tension."""
    law = twin.law
    if not isinstance(law, RodLaw):
        return []
    low, high = (law.stretching_n * factor for factor in _STRETCHING_BOUNDS)
    starts = tuple(
        law.stretching_n * 2.0**power for power in (0, -1, 1, -2, 2, -3, -4)
    )  # its phase slips in between
    return [
        Parameter(STRETCHING, "N", low, high, _set(STRETCHING), step=0.05, starts=starts, stage="taut",
                  held=law.stretching_n)
    ]  # fmt: skip


def _torsion(twin: Twin) -> list[Parameter]:
    """GJ / EI of a rope that two grips turn: a rope that is twisted far bends and buckles by both."""
    law = twin.law
    if not isinstance(law, RodLaw) or len(twin.turning) < 2 or law.torsion_ratio == 0:
        return []
    starts = tuple(law.torsion_ratio * factor for factor in (1.0, 0.5, 2.0))
    return [
        Parameter("torsion_ratio", "1", 0.02, 10.0, _set("torsion_ratio"), step=0.05, starts=starts, stage="flow",
                  held=law.torsion_ratio)
    ]  # fmt: skip


def _twist(twin: Twin) -> list[Parameter]:
    """How stiff a sheet is in twist beside bending, which decides in which basin its stiffness lies."""
    law = twin.law
    if not isinstance(law, SheetLaw) or not twin.lattice.smooth:
        return []
    known = law.bending_twist_ratio
    return [
        Parameter(TWIST_RATIO, "1", *_TWIST_BOUNDS, _set(TWIST_RATIO), step=0.05, starts=(known, 2.5 * known),
                  stage="flow", held=known, least_gain=_BENDING_GAIN)
    ]  # fmt: skip


def _shape(twin: Twin, separate_bending: bool) -> list[Parameter]:
    """What makes a sheet bend otherwise than a homogeneous plate of its thickness does, apart from its twist.

    The thickness of a sheet is declared roughly and enters with its cube, and what bends may not be what stretches.
    """
    law = twin.law
    if not isinstance(law, SheetLaw):
        return []
    found = [] if not twin.lattice.smooth else [
        Parameter(BENDING_COUPLING, "1", *_COUPLING_BOUNDS, _set(BENDING_COUPLING), transform=LINEAR, step=0.1,
                  starts=(law.bending_coupling,), stage="shape", held=law.bending_coupling, least_gain=_BENDING_GAIN)
    ]  # fmt: skip
    if not separate_bending:
        ratio = bending_ratio(twin)
        found.append(
            Parameter(BENDING_RATIO, "1", *_BENDING_BOUNDS, _bends, step=0.05, starts=(ratio,), stage="shape",
                      held=ratio, least_gain=_BENDING_GAIN)
        )  # fmt: skip
    return found


def _fibres(twin: Twin) -> list[Parameter]:
    """Modulus and direction of the fibres of a solid: a direction and its opposite are one, so angles have no ends."""
    law = twin.law
    if not isinstance(law, TransverselyIsotropic):
        return []
    soft = twin.density * 9.81 * float(np.ptp(twin.body.start, axis=0).max())
    angles = (law.fibre_azimuth_rad, law.fibre_elevation_rad)
    return [
        Parameter(FIBRE_MODULUS, "Pa", 0.1 * soft, 1e5 * soft, _set(FIBRE_MODULUS), step=0.05, starts=(10 * soft,),
                  stage="fibres", least_gain=_FIBRES_GAIN),
        *(
            Parameter(name, "rad", known - 2 * np.pi, known + 2 * np.pi, _set(name), transform=LINEAR, step=0.03,
                      starts=(known,), stage="fibres", held=known, least_gain=_FIBRES_GAIN)
            for name, known in zip(FIBRE_ANGLES, angles, strict=True)
        ),
    ]  # fmt: skip


def _weave(twin: Twin) -> list[Parameter]:
    """What the weft and the shear of a woven sheet have over its warp; an isotropic sheet's are the prior."""
    if not isinstance(twin.law, OrthotropicSheetLaw):
        return []
    one_bending = not twin.lattice.smooth  # hinges have no weft
    return [
        Parameter(name, "1", *_WEAVE_BOUNDS[name], _set(name), step=0.05, starts=(getattr(twin.law, name),),
                  stage="optional", held=getattr(twin.law, name))
        for name in WEAVE
        if not (one_bending and name.startswith("bending"))
    ]  # fmt: skip


def bending_ratio(twin: Twin) -> float:
    """D over K h^2 / 12: bending stiffness of a sheet over that of a homogeneous plate which stretches as it does."""
    known = twin.parameters
    return known["bending_n_m"] / (known["membrane_n_m"] * twin.body.thickness_m**2 / 12)


def _bends(twin: Twin, ratio: float) -> Twin:
    return twin.with_parameters(bending_n_m=twin.parameters["bending_n_m"] * ratio / bending_ratio(twin))


def _flow(twin: Twin) -> list[Parameter]:
    """Where the twin's flow law yields. Hardening, flow viscosity and cohesion stay as they are."""
    if isinstance(twin.plasticity, DruckerPrager):
        angle = twin.plasticity.friction_angle_rad
        return [
            Parameter("friction_angle_rad", "rad", 0.05, 1.4, _set("friction_angle_rad"), transform=LINEAR, step=0.03,
                      starts=(angle, 0.35, 0.85), stage="flow", held=angle)
        ]  # fmt: skip
    if twin.plasticity is None or isinstance(twin.plasticity, Identity):
        return []
    weight = twin.density * 9.81 * float(np.ptp(twin.body.start, axis=0).max())
    starts = tuple(weight * factor for factor in (1.0, 0.2, 5.0, 25.0))
    return [
        Parameter("yield_stress_pa", "Pa", 1e-3 * weight, 1e4 * weight, _set("yield_stress_pa"), step=0.05,
                  starts=starts, stage="flow", held=_NEVER_PA)
    ]  # fmt: skip


def _stiffness(twin: Twin, separate_bending: bool, taut: bool) -> list[Parameter]:
    law, density = twin.law, twin.density
    length = float(np.ptp(twin.body.start, axis=0).max())
    if isinstance(law, SolidLaw):
        soft = density * 9.81 * length  # stress under the body's own weight
        grid = tuple(float(soft * f) for f in np.logspace(1.0, 4.0, 9))
        return [
            Parameter("youngs_modulus_pa", "Pa", soft * 1.5, soft * 1e5, _set("youngs_modulus_pa"), starts=grid,
                      stage="stiffness"),
        ]  # fmt: skip
    if isinstance(law, SheetLaw):
        unit = density * 9.81 * length
        grid = tuple(float(unit * f) for f in np.logspace(1.0, 3.5, _SHEET_STARTS))
        thickness = twin.body.thickness_m
        if not separate_bending:
            scale = (1 - law.poissons_ratio**2) / thickness
            return [
                Parameter("youngs_modulus_pa", "Pa", grid[0] * scale / 5, grid[-1] * scale * 5,
                          _sheet_modulus(thickness), starts=tuple(g * scale for g in grid), stage="stiffness"),
            ]  # fmt: skip
        bend = unit * length**2
        return [
            Parameter("bending_n_m", "N m", 1e-7 * bend, 1e-1 * bend, _set("bending_n_m"), step=0.1,
                      starts=tuple(bend * f for f in (1e-5, 1e-4, 1e-3, 1e-2)), stage="stiffness"),
            Parameter("membrane_n_m", "N/m", unit * 5, unit * 1e3, _set("membrane_n_m"), step=0.1, starts=(unit * 60,),
                      stage="stiffness"),
        ]  # fmt: skip
    if not isinstance(law, RodLaw):
        raise TypeError(f"no parameters for {type(law).__name__}")
    unit = density * 9.81 * length**3
    tube = 0.5 * law.stretching_n * twin.body.thickness_m**2  # E I of a hollow section with this E A
    high = max(unit, _STRETCHING_BOUNDS[1] * tube) if taut else unit
    return [
        Parameter(BENDING, "N m^2", 1e-6 * unit, high, _set(BENDING), step=0.05,
                  starts=tuple(unit * f for f in (1e-4, 1e-3, 1e-2, 1e-1)), stage="stiffness"),
    ]  # fmt: skip


def _internal_friction(twin: Twin) -> Parameter:
    if isinstance(twin.law, SolidLaw):
        soft = twin.density * 9.81 * float(np.ptp(twin.body.start, axis=0).max())
        return _positive("viscosity_pa_s", "Pa s", 1e-5 * soft, 0.1 * soft, 1e-3 * soft)
    return _positive("relaxation_s", "s", 1e-5, 0.1, 3e-3)


def _positive(name: str, unit: str, low: float, high: float, start: float) -> Parameter:
    return Parameter(name, unit, low, high, _set(name), step=0.1, starts=(start,), stage="optional")


def _set(name: str) -> Callable[[Twin, float], Twin]:
    return lambda twin, value: twin.with_parameters(**{name: value})


def _rubs(twin: Twin, friction: float) -> Twin:
    """Of several recordings some may have no ground."""
    return twin if twin.ground_height_m is None else twin.with_parameters(ground_friction=friction)


def _delayed(twin: Twin, delay_s: float) -> Twin:
    """Of several recordings some may show no release."""
    return twin if twin.release_s == 0.0 else twin.with_parameters(release_delay_s=delay_s)


def _tilted(angle: str) -> Callable[[Twin, float], Twin]:
    def apply(twin: Twin, tilt_rad: float) -> Twin:
        now = next((known for known in twin.effects if isinstance(known, GravityTilt)), GravityTilt())
        return twin.with_effect(replace(now, **{angle: tilt_rad}))

    return apply


def _sheet_modulus(thickness: float) -> Callable[[Twin, float], Twin]:
    def apply(twin: Twin, modulus: float) -> Twin:
        nu = twin.parameters["poissons_ratio"]
        membrane = modulus * thickness / (1 - nu**2)
        return _bends(twin.with_parameters(membrane_n_m=membrane), bending_ratio(twin))

    return apply


def _poissons_ratio(twin: Twin, separate_bending: bool) -> Callable[[Twin, float], Twin]:
    """Sheets of known thickness keep their modulus when the ratio changes: membrane and bending go along."""
    if not isinstance(twin.law, SheetLaw) or separate_bending:
        return _set("poissons_ratio")

    def apply(changed: Twin, ratio: float) -> Twin:
        now = changed.parameters
        gain = (1 - now["poissons_ratio"] ** 2) / (1 - ratio**2)
        return changed.with_parameters(
            poissons_ratio=ratio,
            membrane_n_m=now["membrane_n_m"] * gain,
            bending_n_m=now["bending_n_m"] * gain,
        )

    return apply


SLOWEST = 8.0  # times
_NAMES = ("relaxation_s", "viscosity_pa_s")
_CLOSE = 0.05  # in the logarithm


def affordable(scene: Scene, twin: Twin, parameter: Parameter) -> Parameter:
    """The parameter with the upper bound that ``twin``, otherwise at its optimum, can be simulated at.

    Parameters other than internal friction, and twins of the updated Lagrangian form, keep theirs.
    """
    if parameter.name not in _NAMES or twin.form.on_particles:
        return parameter
    controls = scene.control_track()

    def step_s(changed: Twin) -> float:
        run = changed.integration(*controls, scene.times)
        return float(TotalLagrangian(run.problem).steps.explicit_s())

    least_s = step_s(parameter.apply(twin, parameter.held)) / SLOWEST

    def spare(searched: float) -> float:
        return step_s(parameter.at(twin, searched)) / least_s - 1.0

    low, high = parameter.bounds
    if spare(high) >= 0.0:
        return parameter
    high = brentq(spare, low, high, xtol=_CLOSE) if spare(low) > 0.0 else low + _CLOSE
    starts = tuple(float(min(value, parameter.value(0.5 * (low + high)))) for value in parameter.starts)
    return replace(parameter, high=parameter.value(high), starts=starts)
