"""Settings of a trace. None of them was chosen on a scene: each says what it stands for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from physworld.calibrate import CalibrationConfig
from physworld.trace.experiment_search import ExperimentConfig


def _declared() -> CalibrationConfig:
    return CalibrationConfig(particle_budget=1000, damping="none")


@dataclass(frozen=True)
class TraceConfig:
    """Settings.

    Attributes:
        calibration: of the declared physics only; on coarser cells than a fit's, for a trace simulates a lot, and finer
            ones are asked in the end.
        method: "selection": effect by effect, by rules; "evidence": by one likelihood and a posterior.
        family_wise_level: probability of naming an effect where residuals are without one.
        resamples: sign patterns of the max statistic.
        blocks: time blocks of the training frames, at most; never shorter than ``shortest_block`` frames.
        shortest_block: frames.
        decoys: random sensitivities that must not score.
        material_share: share of the training misfit that an effect must explain beyond the calibrated parameters.
            The method's prototype saw at most 0.01 on bodies without an effect and at least 0.09 with one.
        near_floor: training misfit over the noise up to which a model is complete.
        acceptable: misfit up to which a name is given although something remains, if the effect explains
            ``most_of_it`` of the misfit above the noise. Where the declared physics leaves no more than this, no
            effect is named whose score chance reaches.
        most_of_it: share, see ``acceptable``.
        alike: projected sensitivities that correlate more than this are suspected to be one effect.
        confirmed: candidates that are refitted with the full simulator.
        iterations: Gauss-Newton iterations of a refit.
        effects_at_most: effects in one answer.
        refinement: cells of the second resolution are this many times smaller.
        resolved: root mean squared change by finer cells, over the noise, beside what re-tuning can do, up to which a
            twin's cells are fine enough; else a trace of one recording goes on with the finer ones.
        affordable: particles times time steps of a run on finer cells (50 ns each) up to which it does; 0: never.
        bootstraps: resamples of the intervals.
        seed: everything random follows from it.
        candidates: names of the registry to try; empty for all.
        experiment: of the search for a motion that tells an equivalent set apart; None for no search.
        time_limit_s: after about so long, by the clock, searches that have not ended are left and the answer is made of
            what there is; None: never. What was left is in the result's notes.
        noise_m: deviation per axis that counts as noise of every recording [m], positive; None: what scenes declare.
            For a camera that sees more finely than the experiment repeats, or than a twin resolves.
    """

    calibration: CalibrationConfig = field(default_factory=_declared)
    method: Literal["selection", "evidence"] = "selection"
    family_wise_level: float = 0.05
    resamples: int = 2000
    blocks: int = 12
    shortest_block: int = 3
    decoys: int = 20
    material_share: float = 0.03
    near_floor: float = 1.2
    acceptable: float = 1.5
    most_of_it: float = 0.7
    alike: float = 0.95
    confirmed: int = 8
    iterations: int = 5
    effects_at_most: int = 2
    refinement: float = 1.4
    resolved: float = 0.3
    affordable: float = 0.0
    bootstraps: int = 1000
    seed: int = 0
    candidates: tuple[str, ...] = ()
    experiment: ExperimentConfig | None = field(default_factory=ExperimentConfig)
    time_limit_s: float | None = None
    noise_m: float | None = None
