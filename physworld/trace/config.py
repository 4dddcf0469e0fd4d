"""Settings of a trace. None of them was chosen on a scene: each says what it stands for."""

from __future__ import annotations

from dataclasses import dataclass, field

from physworld.calibrate import CalibrationConfig
from physworld.experiments.search import ExperimentConfig


def _declared() -> CalibrationConfig:
    return CalibrationConfig(particle_budget=1000, damping="none")


@dataclass(frozen=True)
class TraceConfig:
    """Settings.

    Attributes:
        calibration: of the declared physics only; on coarser cells than a fit's, for a trace simulates a lot.
        blocks: time blocks of the training frames, at most; never shorter than ``shortest_block`` frames.
        shortest_block: frames.
        confirmed: effects that are fitted with the full simulator where little is left; else all are asked.
        additions: effects that are fitted on top of a set.
        iterations: Gauss-Newton iterations of a fit, and one more for every eight of its numbers.
        effects_at_most: effects in one answer.
        refinement: what the solver does not know of itself is asked on cells so many times smaller and larger.
        bootstraps: resamples of the intervals.
        seed: everything random follows from it.
        candidates: names of the registry to try; empty for all.
        experiment: of the search for a motion that tells an equivalent set apart; None for no search.
        time_limit_s: after about so long, by the clock, searches that have not ended are left and the answer is made of
            what there is; None: never. What was left is in the answer's reason.
        noise_m: deviation per axis that counts as noise of every recording [m], positive; None: what scenes declare.
    """

    calibration: CalibrationConfig = field(default_factory=_declared)
    blocks: int = 12
    shortest_block: int = 3
    confirmed: int = 8
    additions: int = 2
    iterations: int = 5
    effects_at_most: int = 3
    refinement: float = 1.4
    bootstraps: int = 1000
    seed: int = 0
    candidates: tuple[str, ...] = ()
    experiment: ExperimentConfig | None = field(default_factory=ExperimentConfig)
    time_limit_s: float | None = None
    noise_m: float | None = None
