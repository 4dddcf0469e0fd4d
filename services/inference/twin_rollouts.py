"""A rollout by the calibrated twin that a version learned from: the same request and arrays, simulated.

From the recording's start the grips do first what they did before the model's history, so that the twin begins as it
was calibrated; from rest the body is let go of at once where the recording begins. Hands are open when the request says
so, and not when they were in the recording.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from physworld.arrays import Array
from physworld.errors import SimulationError
from physworld.scene import Scene
from physworld.twin.openings import Opening
from physworld.twin.twin import Twin
from physworld.worldmodel.clock import resample
from physworld.worldmodel.published import PublishedModel
from physworld_schemas.rollout import RolloutCreate
from physworld_services.inference.rollouts import Prepared, RolloutDiverged


def run(
    request: RolloutCreate,
    model: PublishedModel,
    prepared: Prepared,
    twin: Twin,
    scene: Scene,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[dict[str, Array], float]:
    """``points`` (B, S, N, 3) and ``vertices`` (B, S, n, 3) float32 [m] as asked for, and the seconds it took.

    Args:
        request: which parts are asked for, the factors of its properties, when its grips are open.
        model: the version: its clock, its start, its vertices.
        prepared: controllers (B, T, K, 3) [m] and the ticks that are shown.
        twin: simulated.
        scene: the recording, for what the grips did before.
        progress: called with (steps done, steps in all); may raise to stop.

    Raises:
        RolloutDiverged: a run cannot be trusted; the message says which, and why.
    """
    started, dt = time.perf_counter(), model.spec.dt_s
    resting = request.start == "rest"
    lead = int(prepared.shown[0])  # ticks of the model's history that the twin does without
    before = _before(model, scene) if not resting else model.start_controllers[:0]
    factors = np.log([request.stiffness_factor, request.density_factor])
    properties = np.tile(factors, (len(twin.particles_rest), 1)) if factors.any() else None
    twin = replace(twin, openings=_openings(twin, request.open_s, len(before) * dt))
    found: dict[str, list[Array]] = {part: [] for part in request.returns}
    total, per_candidate = prepared.steps, prepared.steps // len(prepared.controllers)
    for number, driven in enumerate(prepared.controllers):
        path = np.concatenate([before, driven[lead:]])
        times = dt * np.arange(len(path))

        def told(done: int, knots: int, number: int = number) -> None:
            if progress is not None:
                progress(round(per_candidate * (number + done / knots)), total)

        try:
            nodes = twin.simulate_nodes(
                times, path, times, properties=properties, progress=told, from_rest=resting
            )
        except SimulationError as error:
            raise RolloutDiverged(f"candidate {number}, by the twin: {error}") from error
        shown = len(before) + prepared.shown - lead
        if "points" in found:
            found["points"].append(twin.track_nodes(nodes)[shown].astype(np.float32))
        if "vertices" in found:
            particles = twin.particles_at(nodes[shown])
            found["vertices"].append(particles[:, model.spec.particle_index].astype(np.float32))
    return {part: np.stack(pieces) for part, pieces in found.items()}, time.perf_counter() - started


def _before(model: PublishedModel, scene: Scene) -> Array:
    """Where the recording's controllers were at the ticks before the model's history, (P, K, 3) [m]."""
    dt = model.spec.dt_s
    times, points = scene.control_track()
    ticks = dt * np.arange(round(model.start_time_s / dt))
    return resample(points, times - scene.times[0], ticks)


def _openings(
    twin: Twin, asked: Sequence[Sequence[tuple[float, float]]] | None, shift_s: float
) -> tuple[Opening | None, ...]:
    """When each grip of the twin is open, of the request's times, ``shift_s`` later on the twin's clock."""
    if asked is None or not any(asked):
        return ()
    radii = [None if one is None else one.radius_m for one in twin.openings] or [None] * len(asked)
    spans = [tuple((begin + shift_s, end + shift_s) for begin, end in own) for own in asked]
    spans += [()] * (len(twin.controller_groups) - len(spans))
    radii += [None] * (len(spans) - len(radii))
    return tuple(Opening(own, radius) if own else None for own, radius in zip(spans, radii, strict=True))
