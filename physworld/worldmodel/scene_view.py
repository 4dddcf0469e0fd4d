"""A recording and its calibrated twin as the world model sees them: on the model's clock, at the graph's
vertices.

The network needs h + 1 frames to start from. They are the twin's, from the moment at which the body is let go
(tick ``first``; before it the prediction is the start itself), so that a recording that starts in motion,
or is held back for a while, starts the network as it starts the twin. Everything after these frames is the
network's own.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.scene import Scene
from physworld.twin.openings import holding as held_at
from physworld.twin.twin import Twin
from physworld.worldmodel.clock import clock_times, model_dt, resample, resample_smooth
from physworld.worldmodel.errors import GraphInvalid
from physworld.worldmodel.finetune import Recording
from physworld.worldmodel.holding.spans import sets_of
from physworld.worldmodel.model.conditioning import Conditioning
from physworld.worldmodel.model.config import WorldModelConfig
from physworld.worldmodel.model.graph import GraphSpec, build_graph
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.model.skinning import Skin, affine_skin, skin_beside
from physworld.worldmodel.published import PublishedModel

SKIN_STATES = 24


@dataclass(frozen=True)
class SceneView:
    """See the module's text.

    Attributes:
        scene: the recording.
        spec: the graph.
        times: ticks from the scene's first frame [s], (T,).
        controllers: all controllers at the ticks [m], (T, K, 3).
        vertices: the twin's object vertices at the ticks [m], (T, n, 3).
        twin_tracks: the twin's tracked points at the ticks [m], (T, N, 3).
        skin: how vertices carry tracked points.
        first: tick at which the network's history starts.
        history: h.
        twin_steps_per_second: ticks that the twin simulates in a second of computing.
        skin_error_m: mean distance between skinned and twin's own tracked points.
        grips: the controllers of each grip.
        holding: numbers of the grips whose controllers are vertices of the graph; None: all.
        held: which grips hold in the recording from each tick to the next, (T, G), where one lets go; else None.
    """

    scene: Scene
    spec: GraphSpec
    times: Array
    controllers: Array
    vertices: Array
    twin_tracks: Array
    skin: Skin
    first: int
    history: int
    twin_steps_per_second: float
    skin_error_m: float
    grips: tuple[tuple[int, ...], ...] = ()
    holding: tuple[int, ...] | None = None
    held: Array | None = None

    @property
    def as_recorded(self) -> bool:
        """Whether the graph's grips, and no others, hold all through the recording, so that it shows their motion."""
        if self.held is None:
            return self.holding is None
        own = tuple(range(len(self.grips))) if self.holding is None else self.holding
        return sets_of(self.held) == [own]

    @property
    def start_history(self) -> Array:
        """(h+1, n, 3) [m]."""
        return self.vertices[self.first : self.first + self.history + 1]

    def tracks_of(self, rolled: Array) -> Array:
        """Tracked points at the measured times (F, N, 3) of a rollout (T - first, n, 3) from tick ``first``."""
        held = np.repeat(self.vertices[:1], self.first, axis=0)
        ticks = self.skin.apply(np.concatenate([held, rolled]))
        return resample_smooth(ticks, self.times, self.scene.times - self.scene.times[0])

    def recording(self) -> Recording:
        """The training frames for fine-tuning: those after the network's history, none where other grips hold."""
        ticks = (self.scene.times - self.scene.times[0]) / self.spec.dt_s - self.first
        begin, end = self.scene.train
        taken = np.arange(begin, end)
        taken = taken[(ticks[taken] > self.history) & self.as_recorded]
        return Recording(
            history=self.start_history,
            controllers=self.controllers[self.first :],
            ticks=ticks[taken],
            points=self.scene.points[taken],
            visible=self.scene.visible[taken],
        )

    def published(
        self, model: WorldModel, phi: Array, phi_calibrated: Array, strengths: Conditioning | None = None
    ) -> PublishedModel:
        """The model with this scene's start and skin.

        Args:
            model: the trained network.
            phi: properties of its vertices after fine-tuning, (n, P).
            phi_calibrated: the same before it.
            strengths: of traced effects, at which it stands; None: it has none.
        """
        window = slice(self.first, self.first + self.history + 1)
        return PublishedModel(
            model=model,
            phi=phi,
            phi_calibrated=phi_calibrated,
            start_history=self.start_history,
            start_controllers=self.controllers[window],
            start_time_s=float(self.times[self.first]),
            skin=self.skin,
            strengths=strengths,
            grips=self.grips,
            holding=self.holding,
        )


def carried_points(twin: Twin, particles: Array, vertices: Array, rest: Array) -> tuple[Skin, Array]:
    """How vertices of the graph carry the twin's tracked points, and where these are (T, N, 3) [m].

    Args:
        twin: whose points they are.
        particles: its particles over time (T, P, 3) [m].
        vertices: of the graph at the same times (T, n, 3) [m].
        rest: the same of the undeformed body (n, 3) [m].
    """
    tracks = twin.track(particles)
    states = np.unique(np.linspace(0, len(vertices) - 1, SKIN_STATES).round().astype(np.int64))
    if twin.form.on_particles or not np.any(twin.body.offsets):
        return affine_skin(tracks[states], vertices[states]), tracks
    within = replace(twin, body=replace(twin.body, offsets=np.zeros_like(twin.body.offsets)))
    skin = affine_skin(within.track(particles)[states], vertices[states])
    return skin_beside(skin, tracks[states], vertices[states], rest), tracks


def view_scene(
    scene: Scene, twin: Twin, config: WorldModelConfig, holding: tuple[int, ...] | None = None
) -> SceneView:
    """Simulate the twin on the recording's controllers and read it with the graph. Raises GraphInvalid.

    Args:
        scene: the recording.
        twin: calibrated on it.
        config: of the graph.
        holding: numbers of the grips that the graph is for; None: all, as in the recording.
    """
    if holding == tuple(range(len(twin.controller_groups))):
        holding = None
    dt = model_dt(scene.fps)
    control_times, control_points = scene.control_track()
    times = clock_times(float(scene.times[-1] - scene.times[0]), dt)
    first = int(np.ceil(twin.release_s / dt - 1e-6))
    if first + config.history + 1 >= len(times):
        raise GraphInvalid(
            f"the recording has {len(times)} ticks of {dt:.4g} s, let go at tick {first}: too few for history "
            f"{config.history}"
        )
    started = time.perf_counter()
    particles = twin.simulate(control_times, control_points, times + scene.times[0])
    seconds = time.perf_counter() - started
    spec = build_graph(
        twin.particles_rest,
        twin.particles_start,
        twin.controllers_start,
        dt_s=dt,
        config=config,
        control_groups=twin.controller_groups,
        holding=holding,
        ground_height_m=twin.ground_height_m,
        gravity_m_s2=np.asarray(twin.gravity_m_s2),
    )
    vertices = particles[:, spec.particle_index]
    skin, tracks = carried_points(twin, particles, vertices, spec.rest_vertices)
    return SceneView(
        scene=scene,
        spec=spec,
        times=times,
        controllers=resample(control_points, control_times - scene.times[0], times),
        vertices=vertices,
        twin_tracks=tracks,
        skin=skin,
        first=first,
        history=config.history,
        twin_steps_per_second=(len(times) - 1) / seconds,
        skin_error_m=float(np.linalg.norm(skin.apply(vertices) - tracks, axis=2).mean()),
        grips=tuple(tuple(group.tolist()) for group in twin.controller_groups),
        holding=holding,
        held=held_at(twin, times + scene.times[0]) if twin.openings else None,
    )
