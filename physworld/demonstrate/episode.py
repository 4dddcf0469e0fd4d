"""One demonstration episode: a planned motion and property field, simulated by the twin.

``plan_episode`` is a pure function of scene, twin, configuration and seed; ``run_episode`` runs the plan.
Times are on the world model's clock. An episode is as long as the recording, at most ``max_frames`` ticks,
and a replay at most as long as the training frames; its motion is known between the ticks too
(``control_times``), so that the twin is driven smoothly.

Rejected are episodes that the twin cannot simulate, that are not finite, or whose material leaves the
workspace: each raises a ``SimulationError`` with its numbers. ``make_episode`` plans anew with a derived seed
and keeps the reasons.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.demonstrate.limits import MotionLimits, limits_of, training_track
from physworld.demonstrate.motion import random_motion
from physworld.demonstrate.perturbation import perturb_properties
from physworld.demonstrate.replay import (
    VARIANTS,
    WARP,
    mirrored,
    playback_clock,
    playback_duration,
    replayed,
)
from physworld.errors import ParticlesLeftTheGrid, SceneUnsupported, SimulationError, UnstableSimulation
from physworld.geometry.features import carry_features, part_features
from physworld.scene import Scene
from physworld.worldmodel.clock import model_dt

if TYPE_CHECKING:
    from physworld.twin import Twin

Progress = Callable[[int, int], None]

WORKSPACE_MARGIN = 1.5  # in object sizes, around the start state and the control points' paths


@dataclass(frozen=True)
class DemonstrationConfig:
    """How demonstrations are drawn.

    Attributes:
        frames: ticks of an episode; None: as many as the recording lasts, at most ``max_frames``.
        max_frames: keeps long recordings affordable.
        property_sigma: σ of log(E/E_fit).
        density_ratio: σ of log(ρ/ρ_fit), in shares of ``property_sigma``.
        length_scale: ℓ of the property field; 1 is the RMS feature distance of two particles.
        feature_count, landmarks: size of the spectral embedding, and of the Nyström approximation.
        replay_share: share of episodes that replay the recording's training frames, plain or varied.
        control_substeps: control points per tick that the twin is driven with.
        attempts: plans tried by ``make_episode`` before it gives up.
    """

    frames: int | None = None
    max_frames: int = 150
    property_sigma: float = 0.2
    density_ratio: float = 0.5
    length_scale: float = 1.0
    feature_count: int = 8
    landmarks: int = 96
    replay_share: float = 0.2
    control_substeps: int = 4
    attempts: int = 4

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 2:
            raise ValueError(f"{self.frames} frames; an episode has at least 2")
        if self.max_frames < 2 or self.control_substeps < 1 or self.attempts < 1:
            raise ValueError(f"not usable: {asdict(self)}")
        if not (0.0 <= self.replay_share <= 1.0 and self.property_sigma >= 0.0 and self.density_ratio >= 0.0):
            raise ValueError(f"replay share {self.replay_share:g}, property sigma {self.property_sigma:g}")


@dataclass(frozen=True)
class EpisodePlan:
    """What an episode will do; T ticks, K control points, P particles.

    Attributes:
        times: ticks [s] from 0, (T,) float64.
        controllers: control points at the ticks [m], (T, K, 3) float64.
        properties: log(E/E_fit) and log(ρ/ρ_fit), (P, 2) float64.
        motion: the pattern's name.
        seed: everything random follows from it.
        control_times, control_points: the same motion between the ticks, (S,) and (S, K, 3).
        from_rest: whether the object starts without the recording's initial velocity.
        scale: how far the sampled motion was scaled down to keep its limits.
        size_m: the object's size, for the workspace check.
    """

    times: np.ndarray
    controllers: np.ndarray
    properties: np.ndarray
    motion: str
    seed: int
    control_times: np.ndarray
    control_points: np.ndarray
    from_rest: bool
    scale: float
    size_m: float

    def attributes(self) -> dict[str, Any]:
        """What is recorded beside the arrays; JSON types only."""
        speeds = np.linalg.norm(np.diff(self.controllers, axis=0), axis=-1) / np.diff(self.times)[:, None]
        return {
            "motion": self.motion,
            "seed": self.seed,
            "from_rest": self.from_rest,
            "motion_scale": round(self.scale, 4),
            "dt_s": float(self.times[1] - self.times[0]),
            "peak_control_speed_m_s": float(speeds.max(initial=0.0)),
            "control_reach_m": float(np.abs(self.controllers - self.controllers[0]).max(initial=0.0)),
            "log_modulus_std": float(self.properties[:, 0].std()),
            "log_modulus_mean": float(self.properties[:, 0].mean()),
        }

    def rejection(self, error: SimulationError) -> dict[str, Any]:
        """What is recorded of a plan that was not accepted; JSON types only."""
        return {"seed": self.seed, "motion": self.motion, "reason": str(error)}


def plan_episode(scene: Scene, twin: Twin, config: DemonstrationConfig, seed: int) -> EpisodePlan:
    """The episode that ``seed`` stands for."""
    if not twin.controller_groups:
        raise SceneUnsupported(f"scene {scene.name!r} has no controllers: no motion can be demonstrated")
    choice, motion_generator, property_generator = (
        np.random.default_rng(stream) for stream in np.random.SeedSequence(seed).spawn(3)
    )
    limits = limits_of(scene, twin)
    dt = model_dt(scene.fps)
    duration = (episode_frames(scene, config) - 1) * dt
    if choice.uniform() < config.replay_share:
        motion, rate = str(choice.choice(VARIANTS)), float(np.exp(choice.uniform(*np.log(WARP))))
        from_rest, scale = motion != "replay", 1.0
        control_times, points = _replay(scene, twin, limits, motion, rate, duration, config.control_substeps)
    else:
        from_rest = True
        control_times = _control_times(duration, dt, config.control_substeps)
        first_pose = training_track(scene)[1][0]
        drawn = random_motion(first_pose, limits, control_times, motion_generator)
        motion, points, scale = drawn.pattern, drawn.points, drawn.scale
    ticks = slice(None, None, config.control_substeps)
    return EpisodePlan(
        times=control_times[ticks],
        controllers=points[ticks],
        properties=perturb_properties(
            _features(scene, twin, config),
            property_generator,
            sigma_modulus=config.property_sigma,
            sigma_density=config.property_sigma * config.density_ratio,
            length_scale=config.length_scale,
            landmarks=config.landmarks,
        ),
        motion=motion,
        seed=seed,
        control_times=control_times,
        control_points=points,
        from_rest=from_rest,
        scale=scale,
        size_m=limits.size_m,
    )


def run_episode(twin: Twin, plan: EpisodePlan, progress: Progress | None = None) -> dict[str, np.ndarray]:
    """Simulate a plan: times (T,) f8; f4: particles (T, P, 3), controllers (T, K, 3), properties (P, 2)."""
    particles = twin.simulate(
        plan.control_times,
        plan.control_points,
        plan.times,
        properties=plan.properties,
        progress=progress,
        from_rest=plan.from_rest,
    )
    return episode_arrays(plan, particles)


def episode_arrays(plan: EpisodePlan, particles: np.ndarray) -> dict[str, np.ndarray]:
    """What is stored of a simulated plan, as :func:`run_episode` gives it; refuses what ``check_episode`` refuses."""
    check_episode(particles, plan)
    return {
        "times": plan.times,
        "particles": particles.astype(np.float32),
        "controllers": plan.controllers.astype(np.float32),
        "properties": plan.properties.astype(np.float32),
    }


def make_episode(
    scene: Scene, twin: Twin, config: DemonstrationConfig, seed: int, progress: Progress | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and attributes of an accepted episode; the rejected ones before it are in ``rejected``."""
    rejected: list[dict[str, Any]] = []
    while True:
        tried = len(rejected)
        plan = plan_episode(scene, twin, config, seed if tried == 0 else derived_seed(seed, tried))
        try:
            return run_episode(twin, plan, progress), {**plan.attributes(), "rejected": rejected}
        except SimulationError as error:
            rejected.append(plan.rejection(error))
            if len(rejected) == config.attempts:
                raise


def check_episode(particles: np.ndarray, plan: EpisodePlan) -> None:
    """Refuse particles (T, P, 3) that are not finite or leave the workspace."""
    finite = np.isfinite(particles).all(axis=(1, 2))
    if not finite.all():
        frame = int(np.argmin(finite))
        raise UnstableSimulation(
            f"seed {plan.seed}, {plan.motion}: {int((~np.isfinite(particles[frame])).any(axis=1).sum())} of "
            f"{particles.shape[1]} particles are not finite at frame {frame} of {len(particles)}"
        )
    margin = WORKSPACE_MARGIN * plan.size_m
    corners = np.concatenate([particles[0], plan.control_points.reshape(-1, 3)])
    low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    outside = ((particles < low) | (particles > high)).any(axis=2)
    if outside.any():
        frame = int(np.argmax(outside.any(axis=1)))
        worst = particles[frame, int(np.argmax(outside[frame]))]
        raise ParticlesLeftTheGrid(
            f"seed {plan.seed}, {plan.motion}: {int(outside[frame].sum())} of {particles.shape[1]} particles "
            f"leave the workspace at frame {frame} of {len(particles)}, one at {worst.round(4)} m, "
            f"allowed {low.round(4)} to {high.round(4)} m"
        )


def episode_frames(scene: Scene, config: DemonstrationConfig) -> int:
    """T: ``frames`` if stated, else the recording's duration in ticks, at most ``max_frames``."""
    if config.frames is not None:
        return config.frames
    ticks = 1 + round(float(scene.times[-1] - scene.times[0]) / model_dt(scene.fps))
    return int(np.clip(ticks, 2, config.max_frames))


def derived_seed(seed: int, index: int) -> int:
    """A seed for part ``index`` of what ``seed`` stands for; below 2⁵³, exact in JSON."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)[0] >> np.uint64(11))


def _control_times(duration_s: float, dt: float, substeps: int) -> np.ndarray:
    """Ticks up to ``duration_s`` with ``substeps`` control points each, (S,); at least one tick."""
    ticks = max(1, int(np.floor(duration_s / dt + 1e-6)))
    return np.arange(ticks * substeps + 1) * (dt / substeps)


def _replay(
    scene: Scene,
    twin: Twin,
    limits: MotionLimits,
    motion: str,
    rate: float,
    duration_s: float,
    substeps: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Control times (S,) and points (S, K, 3) of a variant of the training track, cut at ``duration_s``."""
    dt = model_dt(scene.fps)
    track_times, track = training_track(scene)
    if motion == "replay":
        control_times = _control_times(min(duration_s, track_times[-1]), dt, substeps)
        return control_times, replayed(track_times, track, control_times)
    if motion == "replay_mirrored":
        object_centre = twin.particles_start.mean(axis=0)
        track, rate = mirrored(track, limits.grips, object_centre, _up(scene)), 1.0
    control_times = _control_times(min(duration_s, playback_duration(track_times[-1], rate)), dt, substeps)
    return control_times, replayed(track_times, track, playback_clock(control_times, rate))


def _up(scene: Scene) -> np.ndarray:
    """The unit vector against gravity; z where there is none."""
    strength = float(np.linalg.norm(scene.gravity_m_s2))
    return -scene.gravity_m_s2 / strength if strength > 0.0 else np.array([0.0, 0.0, 1.0])


def _features(scene: Scene, twin: Twin, config: DemonstrationConfig) -> np.ndarray:
    """Supplied part features at the particles, or the spectral embedding of the rest shape."""
    supplied = scene.part_features
    if supplied is None:
        return _embedding(np.ascontiguousarray(twin.particles_rest).tobytes(), config.feature_count)
    if scene.rest_volume_points is not None and len(supplied) == len(scene.rest_volume_points):
        return carry_features(scene.rest_volume_points, supplied, twin.particles_start)
    seen = scene.visible[0]
    return carry_features(scene.points[0][seen], supplied[seen], twin.particles_start)


@lru_cache(maxsize=4)
def _embedding(points: bytes, count: int) -> np.ndarray:
    """``part_features`` of float64 points; the same for every episode of a twin, and a tenth of its cost."""
    return part_features(np.frombuffer(points).reshape(-1, 3), count)
