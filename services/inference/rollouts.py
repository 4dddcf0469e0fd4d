"""From a request for a rollout to its arrays: checks against the model, clock, start, properties, the engine.

The same code answers at once (``app``) and as a job (``jobs``); a rollout by the twin is a job (``twin_rollouts``).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from physworld.arrays import Array
from physworld.worldmodel.controls import on_clock, peak_speed
from physworld.worldmodel.errors import ControlsInvalid, WorldModelError
from physworld.worldmodel.holding.rollout import HeldVersions
from physworld.worldmodel.holding.spans import spans_of
from physworld.worldmodel.model.properties import DENSITY, STIFFNESS
from physworld.worldmodel.published import PublishedModel
from physworld_schemas.arrays import FARTHEST_M, ArrayInput, array_of
from physworld_schemas.rollout import (
    MAX_CANDIDATES,
    MAX_LOG_RATIO,
    MAX_STEPS,
    MAX_TICKS,
    MAX_VALUES,
    RolloutCreate,
)

CLOCK_TOLERANCE = 1e-3
CHUNK_STEPS = 2000  # between two looks at whether the job was cancelled


class RolloutDiverged(WorldModelError):
    """The prediction left the numbers, or the room."""


@dataclass(frozen=True)
class Prepared:
    """A request on the model's clock.

    Attributes:
        controllers: (B, T, K, 3) [m], the first h + 1 ticks the history's.
        history: object vertices at these ticks [m], (h+1, n, 3).
        phi: log property ratios, (n, 2) or (B, n, 2).
        shown: ticks that are returned.
        times: of those, from the first tick that was asked for [s].
        holding: which grips hold from each tick to the next, (T, G), where some are open at times; else None.
    """

    controllers: Array
    history: Array
    phi: Array
    shown: Array
    times: Array
    holding: Array | None = None

    @property
    def steps(self) -> int:
        """Steps of the model, over all candidates."""
        return int(self.controllers.shape[0]) * (int(self.controllers.shape[1]) - len(self.history))


def prepare(request: RolloutCreate, model: PublishedModel) -> Prepared:
    """Check a request against its model. Raises ControlsInvalid with the field and the numbers."""
    spec, frames = model.spec, len(model.start_history)
    if request.dt_s is not None and abs(request.dt_s / spec.dt_s - 1.0) > CLOCK_TOLERANCE:
        raise ControlsInvalid(
            f"dt_s is {request.dt_s:.6g} s, the model's time step {spec.dt_s:.6g} s; give times instead, and the "
            "controllers are interpolated",
            "dt_s",
        )
    driven = _read(request.controllers, "controllers", (3, 4), FARTHEST_M)
    driven = driven[None] if driven.ndim == 3 else driven
    count = model.start_controllers.shape[1]
    if driven.shape[2:] != (count, 3):
        raise ControlsInvalid(
            f"controllers of shape {driven.shape}, not (B, T, {count}, 3): the scene has {count} controllers",
            "controllers",
        )
    if len(driven) > MAX_CANDIDATES:
        raise ControlsInvalid(f"{len(driven)} candidates; {MAX_CANDIDATES} are the most", "controllers")
    most = min(MAX_TICKS, MAX_STEPS // len(driven))  # before interpolation: two places can span every tick
    driven = on_clock(driven, None if request.times is None else np.array(request.times), spec.dt_s, most)
    lead = 0
    history = model.start_history
    if request.start == "rest":
        lead = frames - 1
        history = np.repeat(history[:1], frames, axis=0)
        driven = np.concatenate([np.repeat(driven[:, :1], lead, axis=1), driven], axis=1)
    ticks = driven.shape[1]
    if ticks <= frames:
        raise ControlsInvalid(
            f"controllers at {ticks} ticks of {spec.dt_s:.4g} s; the model's history alone has {frames}",
            "controllers",
        )
    if ticks > MAX_TICKS or ticks * len(driven) > MAX_STEPS:
        raise ControlsInvalid(
            f"{len(driven)} candidates of {ticks} ticks; at most {MAX_TICKS} ticks and {MAX_STEPS} in all",
            "controllers",
        )
    shown = np.arange(lead, ticks)[:: request.every]
    values = len(driven) * len(shown) * 3 * _places(request, model)
    if values > MAX_VALUES:
        raise ControlsInvalid(
            f"the answer would hold {values} numbers; {MAX_VALUES} are the most: return fewer ticks (every)",
            "every",
        )
    phi, moments = _phi(request, model, len(driven)), (np.arange(ticks) - lead) * spec.dt_s
    return Prepared(
        driven, history, phi, shown, (shown - lead) * spec.dt_s, _holding(request, model, moments)
    )


def run(
    request: RolloutCreate,
    model: PublishedModel,
    prepared: Prepared,
    *,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[dict[str, Array], float]:
    """``points`` (B, S, N, 3) and ``vertices`` (B, S, n, 3) float32 as asked for, and the seconds it took.

    Args:
        request: which parts are asked for.
        model: the version.
        prepared: controllers (B, T, K, 3) [m], history, Φ and the frames that are shown.
        threads: that step candidates side by side.
        progress: called with (steps done, steps in all); may raise to stop.

    Raises:
        RolloutDiverged: a prediction left the numbers; the message says where.
    """
    started = time.perf_counter()
    driven = prepared.controllers
    versions = None if prepared.holding is None else HeldVersions.of_one(model)
    found: dict[str, list[Array]] = {part: [] for part in request.returns}
    per_candidate = driven.shape[1] - len(prepared.history)
    chunk = max(threads, CHUNK_STEPS // per_candidate)
    for first in range(0, len(driven), chunk):
        taken = slice(first, first + chunk)
        phi = prepared.phi[taken] if prepared.phi.ndim == 3 else prepared.phi
        if versions is None:
            vertices = model.rollout_batch(driven[taken], history=prepared.history, phi=phi, threads=threads)
        else:
            vertices = _held(versions, prepared, driven[taken], phi)
        _check(vertices, first, prepared.shown[0], model.spec.dt_s)
        vertices = vertices[:, prepared.shown]
        for part in found:
            moved = vertices if part == "vertices" else model.skin.apply(vertices)
            found[part].append(moved.astype(np.float32))
        if progress is not None:
            progress(min(first + chunk, len(driven)) * per_candidate, len(driven) * per_candidate)
    arrays = {part: np.concatenate(pieces) for part, pieces in found.items()}
    return arrays, time.perf_counter() - started


def facts(request: RolloutCreate, model: PublishedModel, prepared: Prepared) -> dict[str, object]:
    """What an answer says beside its arrays; JSON types."""
    return {
        "by": request.by or "model",
        "dt_s": model.spec.dt_s,
        "history": model.model.config.history,
        "candidates": len(prepared.controllers),
        "ticks": prepared.controllers.shape[1],
        "times": prepared.times.tolist(),
        "speed_m_s": peak_speed(prepared.controllers, model.spec.dt_s),
    }


def _read(value: ArrayInput, field: str, dimensions: tuple[int, ...], most: float) -> Array:
    try:
        return array_of(value, field, dimensions, most)
    except ValueError as error:
        raise ControlsInvalid(str(error), field) from error


def _places(request: RolloutCreate, model: PublishedModel) -> int:
    counts = {"points": len(model.skin.index), "vertices": model.spec.object_count}
    return sum(counts[part] for part in set(request.returns))


def _phi(request: RolloutCreate, model: PublishedModel, candidates: int) -> Array:
    """(n, 2) or (B, n, 2), the factors added in the logarithm."""
    phi, n = model.phi, model.spec.object_count
    if request.phi is not None:
        phi = _read(request.phi, "phi", (2, 3), MAX_LOG_RATIO)
        if phi.shape not in ((n, 2), (candidates, n, 2)):
            raise ControlsInvalid(f"phi of shape {phi.shape}, not ({n}, 2) or ({candidates}, {n}, 2)", "phi")
    factors = {STIFFNESS: request.stiffness_factor, DENSITY: request.density_factor}
    shifts: Array = np.log([factors[column.name] for column in model.columns])
    return phi + shifts


def _holding(request: RolloutCreate, model: PublishedModel, moments: Array) -> Array | None:
    """Which grips hold from each of the ticks (T,) [s] to the next, (T, G); None where all hold all the time."""
    if request.open_s is None or not any(request.open_s):
        return None
    grips = len(model.grips)
    if len(request.open_s) > grips:
        raise ControlsInvalid(
            f"open_s is of {len(request.open_s)} grips; this version knows {grips}", "open_s"
        )
    holding = np.ones((len(moments), grips), dtype=np.uint8)
    for grip, spans in enumerate(request.open_s):
        for begin, end in spans:
            if not (0.0 <= begin < end < np.inf):
                raise ControlsInvalid(
                    f"grip {grip} is open from {begin:g} to {end:g} s; times are finite and from 0, each begins before "
                    "it ends",
                    "open_s",
                )
            holding[(moments >= begin - 1e-9) & (moments < end - 1e-9), grip] = 0
    known = {tuple(range(grips)) if one.holding is None else one.holding for one in (model, *model.others)}
    for span in spans_of(holding):
        if span.grips not in known:
            raise ControlsInvalid(
                f"from {moments[span.first]:.3g} s on only grips {list(span.grips)} hold; this version has models of "
                f"{', '.join(str(list(one)) for one in sorted(known))}",
                "open_s",
            )
    return holding


def _held(versions: HeldVersions, prepared: Prepared, driven: Array, phi: Array) -> Array:
    """Vertices (B, T, n, 3) [m] of candidates (B, T, K, 3), each by the models for the grips that hold."""
    every = np.broadcast_to(phi, (len(driven), *phi.shape[-2:]))
    holding = np.asarray(prepared.holding)
    return np.stack(
        [
            versions.models.rollout(prepared.history, path, holding, own)
            for path, own in zip(driven, every, strict=True)
        ]
    )


def _check(vertices: Array, first: int, lead: int, dt_s: float) -> None:
    """Raises RolloutDiverged; ``lead`` ticks were put before the first that was asked for."""
    broken = ~(np.abs(vertices) < 10 * FARTHEST_M).all(axis=(2, 3))
    if broken.any():
        candidate, tick = np.argwhere(broken)[0]
        raise RolloutDiverged(
            f"candidate {first + candidate} left the numbers at {(tick - lead) * dt_s:.3g} s: the controls ask more "
            "than the model has learned"
        )
