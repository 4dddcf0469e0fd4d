"""How demonstrations are drawn: the settings of motion, of properties, of effects and of rejection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from physworld.demonstrate.patterns import check_weights

MOTIONS = ("vmp", "linear")
PERTURBATIONS = ("p3", "uniform", "random", "none")
PROPERTIES = ("stiffness", "density", "friction")
FEATURES = ("auto", "supplied", "geometric")


@dataclass(frozen=True)
class StrengthRange:
    """A strength of an effect that a trace found, and its 95 % interval.

    Attributes:
        effect, name: of the registry, and of the effect's field.
        value: the estimate.
        low, high: the interval's ends.
    """

    effect: str
    name: str
    value: float
    low: float
    high: float

    def __post_init__(self) -> None:
        if not (np.isfinite([self.value, self.low, self.high]).all() and self.low <= self.value <= self.high):
            raise ValueError(
                f"{self.effect}.{self.name} = {self.value:g} with the interval {self.low:g} to {self.high:g}"
            )


@dataclass(frozen=True)
class DemonstrationConfig:
    """How demonstrations are drawn.

    Attributes:
        frames: ticks of an episode; None: as many as the recording lasts, at most ``max_frames``.
        max_frames: keeps long recordings affordable.
        motion: ``vmp``: Bézier paths at three-phase speed (VMP-Gen); ``linear``: straight lines at constant speed.
        patterns: weights of the patterns of ``physworld.demonstrate.patterns``; None: the free ones alike.
        replay_share: share of episodes that replay the recording's training frames, plain or varied.
        curvature_limit: largest curvature of a path times its chord (6: no turn tighter than a sixth of the chord).
        arc_tolerance: relative accuracy of the arc-length parameterisation.
        perturbation: ``p3``: a Gaussian field over part features (P3-Pert); ``uniform``: one factor for the whole body;
            ``random``: each particle on its own; ``none``.
        properties: what is perturbed: ``stiffness`` and ``density`` per particle, ``friction`` of the ground under
            each particle too; one factor for the whole ground where the twin is of the updated Lagrangian form.
        property_sigma: σ of log(E/E_fit).
        density_ratio, friction_ratio: σ of log(ρ/ρ_fit) and log(μ/μ_fit), in shares of ``property_sigma``.
        largest_factor: no property leaves its fitted value by more than this factor.
        length_scale: ℓ of the property field; 1 is the RMS feature distance of two particles.
        space_scale: length scale in space, in object sizes; None: features alone, as in the paper.
        features: ``supplied`` (the scene's ``part_features``), ``geometric`` (spectral), ``auto``: supplied if there.
        feature_count, landmarks: size of the spectral embedding, and of the Nyström approximation at first.
        unresolved: share of variance that the landmarks may miss anywhere; more are taken until it holds.
        strengths: intervals of effects' strengths; each episode draws its own within them.
        control_substeps: control points per tick that the twin is driven with.
        regrasp_share: share of episodes in which one of several grips lets go for a while; None: half of them where a
            grip of the recording lets go, else none.
        attempts: plans tried by ``make_episode`` before it gives up.
    """

    frames: int | None = None
    max_frames: int = 150
    motion: str = "vmp"
    patterns: Mapping[str, float] | None = None
    replay_share: float = 0.2
    curvature_limit: float = 6.0
    arc_tolerance: float = 1e-9
    perturbation: str = "p3"
    properties: tuple[str, ...] = ("stiffness", "density")
    property_sigma: float = 0.2
    density_ratio: float = 0.5
    friction_ratio: float = 1.0
    largest_factor: float = 4.0
    length_scale: float = 1.0
    space_scale: float | None = None
    features: str = "auto"
    feature_count: int = 8
    landmarks: int = 96
    unresolved: float = 0.05
    strengths: tuple[StrengthRange, ...] = ()
    control_substeps: int = 4
    regrasp_share: float | None = None
    attempts: int = 4

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 2:
            raise ValueError(f"{self.frames} frames; an episode has at least 2")
        if self.max_frames < 2 or self.control_substeps < 1 or self.attempts < 1:
            raise ValueError(f"not usable: {asdict(self)}")
        for name, known in (("motion", MOTIONS), ("perturbation", PERTURBATIONS), ("features", FEATURES)):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} {getattr(self, name)!r}; known are {', '.join(known)}")
        if set(self.properties) - set(PROPERTIES) or len(set(self.properties)) < len(self.properties):
            raise ValueError(f"properties {self.properties}; known are {', '.join(PROPERTIES)}, each once")
        if not (0.0 <= self.replay_share <= 1.0 and self.property_sigma >= 0.0):
            raise ValueError(f"replay share {self.replay_share:g}, property sigma {self.property_sigma:g}")
        if self.regrasp_share is not None and not 0.0 <= self.regrasp_share <= 1.0:
            raise ValueError(f"regrasp share {self.regrasp_share:g}; it is from 0 to 1")
        if not (self.density_ratio >= 0.0 and self.friction_ratio >= 0.0 and self.largest_factor > 1.0):
            raise ValueError(
                f"density ratio {self.density_ratio:g}, friction ratio {self.friction_ratio:g}, largest factor "
                f"{self.largest_factor:g} (more than 1)"
            )
        if not (
            self.curvature_limit > 0.0 and 0.0 < self.arc_tolerance < 1.0 and 0.0 < self.unresolved < 1.0
        ):
            raise ValueError(
                f"curvature limit {self.curvature_limit:g}, arc tolerance {self.arc_tolerance:g}, unresolved "
                f"variance {self.unresolved:g}"
            )
        if self.patterns is not None:
            check_weights(self.patterns)
            object.__setattr__(self, "patterns", dict(self.patterns))

    def sigma_of(self, name: str) -> float:
        """σ of the log of one of ``PROPERTIES``; 0 where it is not perturbed."""
        if name not in self.properties or self.perturbation == "none":
            return 0.0
        ratios = {"stiffness": 1.0, "density": self.density_ratio, "friction": self.friction_ratio}
        return self.property_sigma * ratios[name]
