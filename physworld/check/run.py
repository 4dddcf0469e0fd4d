"""A check from beginning to end: what this recording's motion can show, before anything is fitted.

1. The declared physics, its numbers where the scene, priors and the caller put them (:mod:`.physics`).
2. Sensitivities of every number that a calibration would search, and of every effect of the registry in all its
   shapes; one simulation each.
3. Whitened by the noise, by the points' own unknown places and by an uncertain start; and once more by a discrepancy
   of the model (:mod:`.recorded`). What that says: :mod:`.information`, :mod:`.visibility`.
4. A further motion that shows more (:mod:`.motion`).

Of the measurement only the first frame, the controls, which points were seen and the noise count: nothing is fitted.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from physworld.arrays import Array
from physworld.calibrate import CalibrationConfig
from physworld.check.information import Information
from physworld.check.motion import Limits, MotionSearch, Proposal
from physworld.check.physics import Physics, declared_physics
from physworld.check.recorded import Recorded, recorded
from physworld.check.visibility import Judge, View, deviations, scaled
from physworld.errors import SceneUnsupported
from physworld.estimation.refit import sensitivities
from physworld.estimation.simulations import Drive, Memory, Progress, Runner, Simulations, in_turn
from physworld.scene import Scene
from physworld.trace.candidates import candidates
from physworld.trace.preparation import taken_with
from physworld.trace.sensitivity import candidate_responses

DISCREPANCY_SHARE = 0.03
"""Of the motion's extent: what calibrated twins leave of measured objects, in the middle (``docs/measured.md``)."""
DECLARED, GIVEN, ESTIMATED = "declared", "given", "estimated"


def _calibration() -> CalibrationConfig:
    return CalibrationConfig(particle_budget=500)


@dataclass(frozen=True)
class CheckConfig:
    """Settings.

    Attributes:
        calibration: whose numbers are checked. Coarse cells do: sensitivities converge before positions.
        noise_m: deviation per axis that counts as noise [m]; None: what the scene declares, else an estimate.
        discrepancy_share: of the motion's extent, that a calibrated twin is assumed to be off beside the noise.
        values: what is known better of calibrated numbers than their priors, by name, in their unit.
        candidates: names of the registry to ask; empty for all.
        motions: of the library, that are tried for what the recording does not show; 0: none.
        motion_simulations: about so many, at most, for these.
        longest_s: duration of a proposed motion, at most.
        seed: of the motions.
    """

    calibration: CalibrationConfig = field(default_factory=_calibration)
    noise_m: float | None = None
    discrepancy_share: float = DISCREPANCY_SHARE
    values: Mapping[str, float] = field(default_factory=dict)
    candidates: tuple[str, ...] = ()
    motions: int = 6
    motion_simulations: int = 150
    longest_s: float = 2.0
    seed: int = 0


@dataclass(frozen=True)
class CheckResult:
    """The answer.

    Attributes:
        scene: name.
        physics: what was simulated.
        sigma_m, noise: deviation of the noise per axis [m], and DECLARED, GIVEN or ESTIMATED.
        motion_m: how far the points move in the prediction: root mean squared way from their start, per axis [m].
        frames: training frames that count.
        perfect, usual: the answers for a twin that is right, and for one that is off by ``discrepancy_share``.
        proposal: a further motion, under the second assumption; None where none is needed, asked for or possible.
        asked: effects that were asked, in how many variants.
        refused: effects that were not, with the reason.
        simulations, seconds: cost.
    """

    scene: str
    physics: Physics
    sigma_m: float
    noise: str
    motion_m: float
    frames: int
    perfect: View
    usual: View
    proposal: Proposal | None
    asked: dict[str, int]
    refused: dict[str, str]
    simulations: int
    seconds: float


def check(
    scene: Scene,
    config: CheckConfig | None = None,
    *,
    runner: Runner = in_turn,
    memory: Memory | None = None,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> CheckResult:
    """What a recording can show of its object's parameters and of the effects of the registry.

    Args:
        scene: the recording.
        config: settings; None for the defaults.
        runner: where simulations run.
        memory: simulations that were run before.
        progress: called with (simulations done, about how many there will be, stage).
        cancelled: polled between simulations.

    Raises:
        Cancelled: ``cancelled`` returned true.
        SceneUnsupported: the scene declares too little for a body.
        SimulationError: the declared physics cannot be simulated.
        ValueError: no noise is known; a setting is out of its range, or a value is of no number of this scene.
    """
    config = config or CheckConfig()
    begun = time.perf_counter()
    if not 0.0 <= config.discrepancy_share < 1.0:
        raise ValueError(
            f"a discrepancy of {config.discrepancy_share:g} of the motion: a share from 0 to 1 is needed"
        )
    (taken,) = taken_with([scene], config.noise_m)
    physics = declared_physics(taken, config.calibration, config.values)
    chosen, refused = candidates(physics.twin, config.candidates)
    runs = 1 + 2 * len(physics.probed) + sum(len(candidate.gates) for candidate in chosen)
    told = _counted(progress, runs + (config.motion_simulations if config.motions else 0))
    simulations = Simulations(Drive(*taken.control_track(), taken.times), runner, memory, told, cancelled)
    simulations.stage = "declared physics"
    made = recorded(simulations, taken, physics.twin, None, config.discrepancy_share)
    simulations.stage = "sensitivities"
    physics, slopes = _varied(simulations, physics, made)
    responses = candidate_responses(simulations, made.white, physics.twin, made.tracks, chosen, made.frames)
    refused |= {r.candidate.label: "its simulation cannot be trusted" for r in responses if r.failed}
    usable = [response for response in responses if not response.failed]
    columns, asked = scaled(physics.probed, slopes, usable)
    judge, library = Judge(physics, asked), len({one.effect for one in asked})
    right, known = (Information.of(columns, made.discrepancy, kappa, library) for kappa in (0.0, made.kappa))
    perfect, usual = judge.view(right, 0.0, 0.0), judge.view(known, made.kappa, config.discrepancy_share)
    proposal = None
    if config.motions:
        limits = Limits(config.motions, config.motion_simulations, config.longest_s, config.seed)
        sigma = made.white.sigma
        proposal = MotionSearch(simulations, taken, judge, known, usual, sigma, limits).proposal()
    counted: dict[str, int] = {}
    for response in usable:
        counted[response.candidate.effect] = counted.get(response.candidate.effect, 0) + 1
    source = GIVEN if config.noise_m is not None else DECLARED if scene.noise_sigma_m else ESTIMATED
    return CheckResult(
        scene=scene.name,
        physics=physics,
        sigma_m=made.white.sigma,
        noise=source,
        motion_m=made.motion_m,
        frames=made.frames,
        perfect=perfect,
        usual=usual,
        proposal=proposal,
        asked=counted,
        refused=refused,
        simulations=simulations.count,
        seconds=time.perf_counter() - begun,
    )


def _varied(simulations: Simulations, physics: Physics, made: Recorded) -> tuple[Physics, Array]:
    """Sensitivities (M, p) to the numbers, with steps of the size that is left open."""
    slopes = np.empty((0, 0))
    for again in (True, False):
        unknowns = list(physics.probed)
        slopes, failed = sensitivities(
            simulations, made.white, physics.twin, made.tracks, unknowns, made.frames
        )
        if all(failed):
            raise SceneUnsupported(f"none of {len(failed)} numbers can be varied in a simulation")
        if again:
            known = Information.of(slopes * deviations(unknowns), made.discrepancy, 0.0, 1)
            physics = physics.stepped(known.deviations(np.arange(len(unknowns))))
    return physics, slopes


def _counted(progress: Progress | None, total: int) -> Progress | None:
    """With about how many simulations there will be."""
    if progress is None:
        return None
    return lambda done, _, stage: progress(done, max(done, total), stage)
