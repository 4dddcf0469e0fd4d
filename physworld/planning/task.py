"""A world model, its twin and its recording as one planning task: predict with the first, check with the second.

A plan begins where the model's history ends: until then the grips do what they did in the recording, in the model and
in the twin alike, and the velocities that they have there bound the first tick of a plan. Grips move as the twin's do;
a controller that belongs to none (a pusher) stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.demonstrate.limits import limits_of
from physworld.errors import SceneUnsupported
from physworld.planning.goals import GripLimits
from physworld.scene import Scene
from physworld.twin.twin import Twin
from physworld.worldmodel.clock import resample
from physworld.worldmodel.published import PublishedModel


@dataclass(frozen=True)
class PlanningTask:
    """See the module's text.

    Attributes:
        model, twin, scene: of one object.
        grips: controllers of every grip.
        limits: the recording's.
        threads: that share a batch of rollouts.
    """

    model: PublishedModel
    twin: Twin
    scene: Scene
    grips: tuple[Array, ...]
    limits: GripLimits
    threads: int = 1

    @classmethod
    def of(cls, model: PublishedModel, twin: Twin, scene: Scene, threads: int = 1) -> PlanningTask:
        """The task with the limits of the recording. Raises SceneUnsupported without grips.

        Args:
            model: published.
            twin, scene: of the same object.
            threads: that share a batch of rollouts.
        """
        motion = limits_of(scene, twin)
        if not motion.grips:
            raise SceneUnsupported(f"scene {scene.name!r} has no grips: nothing can be planned")
        first, start = scene.control_track()[1][0], model.start_controllers[-1]
        centres = np.array([start[grip].mean(axis=0) for grip in motion.grips])
        before = np.array([model.start_controllers[-2][grip].mean(axis=0) for grip in motion.grips])
        gone = centres - np.array([first[grip].mean(axis=0) for grip in motion.grips])
        limits = GripLimits(
            speed_m_s=motion.speed_m_s,
            acceleration_m_s2=motion.acceleration_m_s2,
            box_min_m=np.minimum(motion.reach_min_m - gone, 0.0),
            box_max_m=np.maximum(motion.reach_max_m - gone, 0.0),
            spread_max_m=motion.spread_max_m,
            centres_m=centres,
            start_m_s=(centres - before) / model.spec.dt_s,
        )
        return cls(model, twin, scene, motion.grips, limits, threads)

    @property
    def dt_s(self) -> float:
        """The model's time step [s]."""
        return self.model.spec.dt_s

    @property
    def start_points(self) -> Array:
        """Measured points where a plan begins [m], (N, 3), as the model carries them."""
        return self.model.skin.apply(self.model.start_history[-1])

    def with_limits(
        self,
        speed_m_s: float | None = None,
        acceleration_m_s2: float | None = None,
        box_min_m: Array | None = None,
        box_max_m: Array | None = None,
    ) -> PlanningTask:
        """The task with other limits where they are given; boxes (3,) hold for every grip and hold its start.

        Args:
            speed_m_s, acceleration_m_s2: largest of every grip; None: as it is.
            box_min_m, box_max_m: of a grip's displacement from where the plan starts [m], (3,) or (G, 3); None: as
                it is.
        """
        old = self.limits
        limits = replace(
            old,
            speed_m_s=old.speed_m_s if speed_m_s is None else speed_m_s,
            acceleration_m_s2=old.acceleration_m_s2 if acceleration_m_s2 is None else acceleration_m_s2,
            box_min_m=old.box_min_m if box_min_m is None else np.broadcast_to(box_min_m, old.centres_m.shape),
            box_max_m=old.box_max_m if box_max_m is None else np.broadcast_to(box_max_m, old.centres_m.shape),
        )
        if (limits.box_min_m > 0.0).any() or (limits.box_max_m < 0.0).any():
            raise ValueError(
                f"the workspace {limits.box_min_m.tolist()} to {limits.box_max_m.tolist()} leaves out the start, 0"
            )
        return replace(self, limits=limits)

    def controllers(self, displacements: Array) -> Array:
        """All controllers (…, h+1+T, K, 3) [m] for displacements (…, T, G, 3) of the grips after the history."""
        past = self.model.start_controllers
        lead, ticks = displacements.shape[:-3], displacements.shape[-3]
        path = np.broadcast_to(past[-1], (*lead, len(past) + ticks, *past.shape[1:])).copy()
        path[..., : len(past), :, :] = past
        for g, grip in enumerate(self.grips):
            path[..., len(past) :, grip, :] += displacements[..., g, None, :]
        return path

    def predict(self, displacements: Array) -> Array:
        """Measured points (B, T, N, 3) [m] that the model predicts at the ticks of (B, T, G, 3)."""
        rolled = self.model.rollout_batch(self.controllers(displacements), threads=self.threads)
        return self.model.skin.apply(rolled[:, len(self.model.start_history) :])

    def execute(self, displacements: Array) -> Array:
        """Measured points (T, N, 3) [m] that the twin gives for (T, G, 3), from its own start.

        Raises SimulationError when the run cannot be trusted.
        """
        past = round(self.model.start_time_s / self.dt_s) + len(self.model.start_history)
        path = self.controllers(displacements)[len(self.model.start_history) :]
        times = self.dt_s * np.arange(past + len(path))
        control_times, control_points = self.scene.control_track()
        recorded = resample(control_points, control_times - self.scene.times[0], times[:past])
        twin = replace(self.twin, openings=())  # the hands hold on, as the model has it
        nodes = twin.simulate_nodes(times, np.concatenate([recorded, path]), times)
        return self.twin.track_nodes(nodes)[past:]
