"""One demonstration episode: a planned motion and property field, simulated by the twin.

``plan_episode`` is a pure function of scene, twin, configuration and seed; ``run_episode`` runs the plan.
Times are on the world model's clock. An episode is as long as the recording, at most ``max_frames`` ticks,
and a replay at most as long as the training frames; its motion is known between the ticks too
(``control_times``), so that the twin is driven smoothly.

Rejected are episodes that the twin cannot simulate, that are not finite, or whose material leaves the
workspace: each raises a ``SimulationError`` with its numbers. ``make_episode`` plans anew with the seed of the
next try and keeps the reasons; after the last try it raises ``EpisodeRejected``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from physworld.arrays import Array
from physworld.demonstrate.config import DemonstrationConfig
from physworld.demonstrate.limits import MotionLimits, limits_of, pushers_of, training_track
from physworld.demonstrate.motion import random_motion
from physworld.demonstrate.paths import PathStyle
from physworld.demonstrate.properties import Drawn, draw_properties
from physworld.demonstrate.regrasp import (
    Regrasp,
    able,
    along_with_the_material,
    closing_times,
    drawn_regrasp,
    led_on,
    takes_elsewhere,
)
from physworld.demonstrate.replay import (
    VARIANTS,
    WARP,
    mirrored,
    playback_clock,
    playback_duration,
    replayed,
)
from physworld.errors import (
    EpisodeRejected,
    ParticlesLeftTheGrid,
    SceneUnsupported,
    SimulationError,
    UnstableSimulation,
)
from physworld.scene import Scene
from physworld.twin.openings import Opening, holding
from physworld.worldmodel.clock import model_dt

if TYPE_CHECKING:
    from physworld.twin.twin import Twin

Progress = Callable[[int, int], None]

WORKSPACE_MARGIN = 1.5  # in object sizes, around the start state and the control points' paths


@dataclass(frozen=True)
class EpisodePlan:
    """What an episode will do; T ticks, K control points, P particles.

    Attributes:
        times: ticks [s] from 0, (T,) float64.
        controllers: control points at the ticks [m], (T, K, 3) float64.
        drawn: what the episode's twin differs in.
        motion: the pattern's name.
        seed: everything random follows from it.
        control_times, control_points: the same motion between the ticks, (S,) and (S, K, 3).
        from_rest: whether the object starts without the recording's initial velocity.
        scale: how far the sampled motion was scaled down to keep its limits.
        size_m: the object's size, for the workspace check.
        openings: when each grip is open; empty where all hold all the time.
        regrasp: of a hand that is led on from where it closes; None of others.
        limits: that its motion keeps then.
        opens: whether some episode of this kind has a grip that opens, so that each says which hold.
    """

    times: Array
    controllers: Array
    drawn: Drawn
    motion: str
    seed: int
    control_times: Array
    control_points: Array
    from_rest: bool
    scale: float
    size_m: float
    openings: tuple[Opening | None, ...] = ()
    regrasp: Regrasp | None = None
    limits: MotionLimits | None = None
    opens: bool = False

    @property
    def properties(self) -> Array:
        """log(E/E_fit) and log(ρ/ρ_fit), and log(μ/μ_fit) where it is perturbed, (P, 2 or 3) float64."""
        return self.drawn.fields

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
            **({} if self.regrasp is None else {"regrasp": asdict(self.regrasp)}),
            **self.drawn.attributes(),
        }


def plan_episode(scene: Scene, twin: Twin, config: DemonstrationConfig, seed: int) -> EpisodePlan:
    """The episode that ``seed`` stands for.

    Args:
        scene: the recording whose controllers, limits and rate the motion keeps.
        twin: the object's.
        config: of the demonstrations.
        seed: of this try; equal seeds give equal plans.
    """
    if not twin.controller_groups and not pushers_of(scene):
        raise SceneUnsupported(f"scene {scene.name!r} has no controllers: no motion can be demonstrated")
    choice, motion_generator, property_generator, grasps = (
        np.random.default_rng(stream) for stream in np.random.SeedSequence(seed).spawn(4)
    )
    limits = limits_of(scene, twin)
    dt = model_dt(scene.fps)
    duration = (episode_frames(scene, config) - 1) * dt
    replays = choice.uniform() < config.replay_share
    replays &= not takes_elsewhere(twin)
    if replays and training_track(scene)[0][-1] >= dt:  # shorter training frames hold no tick to replay
        motion, rate = str(choice.choice(VARIANTS)), float(np.exp(choice.uniform(*np.log(WARP))))
        motion = "replay" if twin.openings else motion  # its grips open when they did
        from_rest, scale = motion != "replay", 1.0
        control_times, points = _replay(scene, twin, limits, motion, rate, duration, config.control_substeps)
    else:
        from_rest = True
        control_times = _control_times(duration, dt, config.control_substeps)
        first_pose = training_track(scene)[1][0]
        style = PathStyle(config.motion == "linear", config.curvature_limit, config.arc_tolerance)
        moved = random_motion(
            first_pose, limits, control_times, motion_generator, weights=config.patterns, style=style
        )
        motion, points, scale = moved.pattern, moved.points, moved.scale
    ticks = slice(None, None, config.control_substeps)
    share = regrasp_share_of(twin, config)
    regrasp, openings = None, twin.openings if motion == "replay" else ()
    if from_rest and grasps.uniform() < share:
        regrasp = drawn_regrasp(twin, control_times[ticks], grasps)
        openings = () if regrasp is None else regrasp.openings(len(twin.controller_groups))
    return EpisodePlan(
        times=control_times[ticks],
        controllers=points[ticks],
        drawn=draw_properties(scene, twin, config, property_generator),
        motion=motion,
        seed=seed,
        control_times=control_times,
        control_points=points,
        from_rest=from_rest,
        scale=scale,
        size_m=limits.size_m,
        openings=openings,
        regrasp=regrasp,
        limits=limits,
        opens=share > 0.0 or bool(twin.openings),
    )


def regrasp_share_of(twin: Twin, config: DemonstrationConfig) -> float:
    """Share of the episodes from rest in which a grip lets go; 0 where fewer than two hold something."""
    wanted = config.regrasp_share
    if wanted is None:
        wanted = 0.5 if twin.openings else 0.0
    return wanted if able(twin) else 0.0


def run_episode(twin: Twin, plan: EpisodePlan, progress: Progress | None = None) -> dict[str, Array]:
    """Simulate a plan: times (T,) f8; f4: particles (T, P, 3), controllers (T, K, 3), properties (P, 2 or 3).

    Where grips open, also holding (T, G) u1: whether each holds from a tick to the next; the controllers then stand to
    the material as at the start (:mod:`physworld.demonstrate.regrasp`).
    """
    own = replace(plan.drawn.twin(twin), openings=plan.openings)

    def nodes(points: Array, times: Array, told: Progress | None) -> Array:
        return own.simulate_nodes(
            plan.control_times,
            points,
            times,
            properties=plan.properties,
            progress=told,
            from_rest=plan.from_rest,
        )

    if plan.regrasp is not None and plan.limits is not None:
        asked = closing_times(float(plan.times[0]), plan.regrasp.close_s)
        until = nodes(plan.control_points, asked, progress)[1:]
        track = plan.control_times, plan.control_points
        points = led_on(own, plan.regrasp, *track, until, plan.limits)
        ticks = np.searchsorted(plan.control_times, plan.times - 1e-9)
        plan = replace(plan, control_points=points, controllers=points[ticks])
    moved = nodes(plan.control_points, plan.times, progress)
    if not plan.opens:
        return episode_arrays(plan, own.particles_at(moved))
    held = holding(own, plan.times)
    for grip, gripped in enumerate(own.held_nodes):  # open at the start, and all through this motion
        if not len(gripped) and (not plan.openings or plan.openings[grip] is None):
            held[:, grip] = 0
    plan = replace(plan, controllers=along_with_the_material(own, plan.controllers, moved, held))
    return {**episode_arrays(plan, own.particles_at(moved)), "holding": held}


def episode_arrays(plan: EpisodePlan, particles: Array) -> dict[str, Array]:
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
) -> tuple[dict[str, Array], dict[str, Any]]:
    """Arrays and attributes of an accepted episode; the rejected ones before it are in ``rejected``.

    Args:
        scene: the recording whose limits the motion keeps.
        twin: the object's.
        config: of the demonstrations.
        seed: of the episode; further tries follow from it.
        progress: told (frames done, frames in all) of every run, or None.

    Raises:
        EpisodeRejected: none of ``config.attempts`` tries was accepted; the message counts the reasons.
    """
    rejected: list[dict[str, Any]] = []
    while len(rejected) < config.attempts:
        tried = try_seed(seed, len(rejected))
        plan = None
        try:
            plan = plan_episode(scene, twin, config, tried)
            arrays = run_episode(twin, plan, progress)
            moved = replace(plan, controllers=arrays["controllers"].astype(float)) if plan.opens else plan
            return arrays, accepted_attributes(moved, rejected)
        except SimulationError as error:
            rejected.append(rejection(tried, plan, error))
    raise all_rejected(seed, rejected)


def try_seed(seed: int, tries_before: int) -> int:
    """The seed of the next try at the episode that ``seed`` stands for."""
    return seed if tries_before == 0 else derived_seed(seed, tries_before)


def accepted_attributes(plan: EpisodePlan, rejected: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What is recorded of an accepted plan and of the tries before it; JSON types only."""
    return {**plan.attributes(), "tries": len(rejected) + 1, "rejected": list(rejected)}


def rejection(seed: int, plan: EpisodePlan | None, error: SimulationError) -> dict[str, Any]:
    """What is recorded of a try that was not accepted; JSON types only. ``plan`` is None where it was not even made."""
    motion = "" if plan is None else plan.motion
    return {"seed": seed, "motion": motion, "kind": type(error).__name__, "reason": str(error)}


def all_rejected(seed: int, rejected: Sequence[dict[str, Any]]) -> EpisodeRejected:
    """The error of an episode without an accepted try."""
    kinds = Counter(one["kind"] for one in rejected)
    counted = ", ".join(f"{count} x {kind}" for kind, count in kinds.most_common())
    return EpisodeRejected(
        f"seed {seed}: all {len(rejected)} tries were rejected ({counted}); the last: {rejected[-1]['reason']}"
    )


def check_episode(particles: Array, plan: EpisodePlan) -> None:
    """Refuse particles (T, P, 3) that are not finite or leave the workspace."""
    margin = WORKSPACE_MARGIN * plan.size_m
    corners = np.concatenate([particles[0], plan.control_points.reshape(-1, 3)])
    low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    # a coordinate that is not a number makes the extremes no number either, and both comparisons fail
    if np.all(particles.min(axis=(0, 1)) >= low) and np.all(particles.max(axis=(0, 1)) <= high):
        return
    finite = np.isfinite(particles).all(axis=(1, 2))
    if not finite.all():
        frame = int(np.argmin(finite))
        raise UnstableSimulation(
            f"seed {plan.seed}, {plan.motion}: {int((~np.isfinite(particles[frame])).any(axis=1).sum())} of "
            f"{particles.shape[1]} particles are not finite at frame {frame} of {len(particles)}"
        )
    outside = ((particles < low) | (particles > high)).any(axis=2)
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


def _control_times(duration_s: float, dt: float, substeps: int) -> Array:
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
) -> tuple[Array, Array]:
    """Control times (S,) and points (S, K, 3) of a variant of the training track, cut at ``duration_s``."""
    dt = model_dt(scene.fps)
    track_times, track = training_track(scene)
    if motion == "replay":
        control_times = _control_times(min(duration_s, track_times[-1]), dt, substeps)
        return control_times, replayed(track_times, track, control_times)
    if motion == "replay_mirrored":
        track, rate = mirrored(track, limits.bodies, limits.object_centre_m, limits.up), 1.0
    control_times = _control_times(min(duration_s, playback_duration(track_times[-1], rate)), dt, substeps)
    return control_times, replayed(track_times, track, playback_clock(control_times, rate))
