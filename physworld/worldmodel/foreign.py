"""A published model on a recording that it was not trained on: the same object, moved otherwise.

The network starts from h + 1 frames of its vertices. They are those of the model's twin, put where the new recording
starts and driven by its controllers, as at home (:mod:`physworld.worldmodel.scene_view`). Everything after is the
network's own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from physworld.arrays import Array
from physworld.engine.rods.chain import Chain
from physworld.errors import SceneUnsupported
from physworld.geometry.rigid import rigid_motion
from physworld.scene import Scene
from physworld.twin.build import PRIOR_FRICTION, build_twin
from physworld.twin.colliders import twin_colliders
from physworld.twin.grips import soft_regions, with_touched_nodes
from physworld.twin.openings import holding
from physworld.twin.twin import Twin
from physworld.worldmodel.clock import clock_times, resample, resample_smooth
from physworld.worldmodel.errors import ControlsInvalid, GraphInvalid
from physworld.worldmodel.holding.rollout import HeldVersions
from physworld.worldmodel.published import PublishedModel
from physworld.worldmodel.scene_view import carried_points

_LENGTHS = 0.1  # by which lengths between the same points of a rope may differ from recording to recording
_OTHER_SHAPE = 0.1  # of the body's size: a start that is farther away is another shape, not noise


@dataclass(frozen=True)
class ForeignPrediction:
    """Open-loop predictions of a new recording.

    Attributes:
        tracks, twin_tracks: of the model and of its twin at the measured times, (T, N, 3) [m].
        first_frame: first frame that the network predicted by itself.
        start_mismatch_m: root mean squared distance of the twin's points from the measured ones at the start.
    """

    tracks: Array
    twin_tracks: Array
    first_frame: int
    start_mismatch_m: float


def twin_on(recording: Scene, home: Scene, twin: Twin, particle_budget: int) -> Twin:
    """The twin put where the recording starts: the same material, lattice, effects and parameters.

    The recording's own body is taken where its lattice is the twin's; otherwise the twin is moved as a whole, by the
    rigid motion from the home recording's first points and controllers to this one's, and starts at rest. So is a mesh
    of triangles, whose diagonals are the home recording's. Ground and colliders are always the recording's.

    Args:
        recording: where the twin is put.
        home: the recording that it was calibrated on.
        twin: of the home recording.
        particle_budget: of a body built from the recording; that of the home fit lets lattices agree.

    Raises:
        SceneUnsupported: the recording has other controllers, or, where the twin has to be moved, other points or grips
            that let go.
    """
    counts = [(scene.controllers.shape[1], scene.points.shape[1]) for scene in (home, recording)]
    if counts[0][0] != counts[1][0]:
        raise SceneUnsupported(
            f"the recording has {counts[1][0]} controllers, the model was trained with {counts[0][0]}"
        )
    try:
        own = build_twin(recording, particle_budget, device=twin.device)
    except SceneUnsupported:  # it shows too little for a body of its own
        own = None
    if own is not None and _same_lattice(own, twin):
        return replace(
            own,
            law=twin.law,
            air_drag_per_s=twin.air_drag_per_s,
            ground_friction=twin.ground_friction,
            grip_softness=twin.grip_softness,
            effects=twin.effects,
            self_friction=twin.self_friction,
            plasticity=twin.plasticity,
            formulation=twin.formulation,
            transfer=twin.transfer,
            properties=twin.properties,
            natural=twin.natural,
        )
    if counts[0][1] != counts[1][1]:
        raise SceneUnsupported(
            f"the recording shows {counts[1][1]} points of a body that looks different, the model's scene "
            f"{counts[0][1]}: it cannot be placed"
        )
    starts = [np.concatenate([scene.points[0], scene.control_track()[1][0]]) for scene in (home, recording)]
    seen = np.concatenate([home.visible[0] & recording.visible[0], np.ones(counts[0][0], dtype=bool)])
    turns, shifts = rigid_motion(starts[0][seen], starts[1][seen][None])
    if twin.openings or any(grip.open_s for grip in recording.grips):
        raise SceneUnsupported(
            "grips let go, of a body that looks different in the recording: it is not known what they hold there"
        )
    body = twin.body
    if soft_regions(twin):  # their boxes stand where the body was
        twin = with_touched_nodes(twin, body.start)
    return replace(
        twin,
        body=replace(
            body,
            start=body.start @ turns[0].T + shifts[0],
            start_velocity=np.zeros_like(body.start),
        ),
        gravity_m_s2=np.asarray(recording.gravity_m_s2, dtype=float),
        ground_height_m=None if recording.ground is None else recording.ground.height_m,
        colliders=twin_colliders(recording, body.half_thickness_m, PRIOR_FRICTION),
        controllers_start=recording.control_track()[1][0],
        release_s=0.0 if own is None else own.release_s,
    )


def predict(model: PublishedModel, recording: Scene, twin: Twin) -> ForeignPrediction:
    """Roll the model out over the recording, from a twin that :func:`twin_on` has put there.

    Raises:
        SceneUnsupported: the recording starts in another shape than the model's, is too short for its history, or has
            grips let go in a way that the version has no model for.
    """
    mismatch = start_mismatch(recording, twin)
    size = float(np.ptp(recording.points[0][recording.visible[0]], axis=0).max(initial=0.0))
    if mismatch > _OTHER_SHAPE * size:
        raise SceneUnsupported(
            f"the recording starts in another shape: its points lie {1e3 * mismatch:.3g} mm (root mean square) from "
            f"the model's, more than {_OTHER_SHAPE:.0%} of its size of {1e3 * size:.3g} mm"
        )
    dt, history = model.spec.dt_s, model.model.config.history
    control_times, control_points = recording.control_track()
    times = clock_times(float(recording.times[-1] - recording.times[0]), dt)
    first = int(np.ceil(twin.release_s / dt - 1e-6))
    if first + history + 1 >= len(times):
        raise SceneUnsupported(
            f"the recording has {len(times)} ticks of {dt:.4g} s, let go at tick {first}: too few for history {history}"
        )
    particles = twin.simulate(control_times, control_points, times + recording.times[0])
    vertices = particles[:, model.spec.particle_index]
    skin, twin_tracks = carried_points(twin, particles, vertices, model.spec.rest_vertices)
    controllers = resample(control_points, control_times - recording.times[0], times)
    lift = _lift(model, twin)
    start = vertices[first : first + history + 1]
    rolled = _rolled(
        model, twin, controllers[first:] - lift, start - lift, times[first:] + recording.times[0]
    )
    rolled += lift
    held = np.repeat(vertices[:1], first, axis=0)
    frame_times = recording.times - recording.times[0]
    tracks = resample_smooth(skin.apply(np.concatenate([held, rolled])), times, frame_times)
    own = np.flatnonzero(frame_times > times[first + history])
    return ForeignPrediction(
        tracks=tracks,
        twin_tracks=resample_smooth(twin_tracks, times, frame_times),
        first_frame=int(own[0]) if len(own) else len(frame_times),
        start_mismatch_m=mismatch,
    )


def _rolled(model: PublishedModel, twin: Twin, controllers: Array, history: Array, moments: Array) -> Array:
    """Object vertices (T, n, 3) [m], by the models for the grips that hold where some let go.

    Args:
        model: the version.
        twin: on the recording.
        controllers: (T, K, 3) [m].
        history: object vertices at the first ticks [m], (h+1, n, 3).
        moments: of the ticks, on the twin's clock [s], (T,).

    Raises:
        SceneUnsupported: no model of the version is for the grips that hold.
    """
    if not twin.openings:
        return model.rollout(controllers, history=history)
    try:
        return HeldVersions.of_one(model).rollout(controllers, holding(twin, moments), history=history)
    except (ControlsInvalid, GraphInvalid) as error:
        raise SceneUnsupported(f"grips let go in the recording: {error}") from error


def _lift(model: PublishedModel, twin: Twin) -> Array:
    """How far the recording's ground lies above the model's, which counts heights from its own, (3,) [m]."""
    own, theirs = model.spec.ground_height_m, twin.ground_height_m
    return np.array([0.0, 0.0, 0.0 if own is None or theirs is None else theirs - own])


def start_mismatch(recording: Scene, twin: Twin) -> float:
    """Root mean squared distance of the twin's tracked points at the start from the measured ones [m]."""
    seen = recording.visible[0]
    if not seen.any():
        return 0.0
    points = twin.track_nodes(twin.carriers_start[None])[0]
    return float(np.sqrt(np.mean(np.sum((points - recording.points[0])[seen] ** 2, axis=-1))))


def _same_lattice(own: Twin, twin: Twin) -> bool:
    ours, theirs = own.lattice, twin.lattice
    if isinstance(ours, Chain) and isinstance(theirs, Chain):  # lengths are measured anew in every recording
        return np.array_equal(ours.parent, theirs.parent) and np.allclose(
            ours.lengths, theirs.lengths, rtol=_LENGTHS, atol=1e-12
        )
    return (
        theirs.smooth
        and ours.cells.shape == theirs.cells.shape
        and np.array_equal(ours.cells, theirs.cells)
        and np.allclose(ours.spacing, theirs.spacing, rtol=1e-3)
        and np.allclose(ours.fill, theirs.fill, atol=1e-3)
        and len(own.held_nodes) == len(twin.held_nodes)
    )
