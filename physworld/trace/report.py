"""The machine-readable answer of a trace, and what remains in words: how much, when, where, along what, with what."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from physworld.arrays import Array
from physworld.effects.registry import EFFECTS
from physworld.scene import Scene
from physworld.trace.held_out import METRIC, HeldOut
from physworld.trace.hypotheses import Hypothesis
from physworld.trace.result import Named, Number, TraceResult
from physworld.trace.search import WORTH

SCHEMA_VERSION = 1
_SHOWN = 10  # best scores of a step


def document(result: TraceResult) -> dict[str, Any]:
    """The answer under stable keys; JSON types only, numbers that are not finite as null."""
    selected = set(result.verdict.model.names) if result.effects else set()
    best: dict[str, dict[str, Any]] = {}
    for one in result.path[0].screened if result.path else ():
        name = one.candidate.effect
        best.setdefault(
            name,
            {
                "name": name,
                "title": EFFECTS[name].title,
                "variant": one.candidate.variant or None,
                "score": one.share,
                "threshold": WORTH,
                "selected": name in selected,
            },
        )
    found = {
        "schema_version": SCHEMA_VERSION,
        "scene": result.scene,
        "verdict": result.verdict.name,
        "reason": result.verdict.reason,
        "effects": [{**_effect(effect), **_support(result, effect.name)} for effect in result.effects],
        "equivalent": [_effect(effect) for model in result.equivalent for effect in model],
        "candidates": list(best.values()),
        "refused": result.refused,
        "path": [
            {
                "base": list(step.base.names),
                "threshold": WORTH,
                "scores": [
                    {"name": s.candidate.effect, "variant": s.candidate.variant or None, "score": s.share}
                    for s in step.screened[:_SHOWN]
                ],
                "tried": [
                    {
                        "effects": list(model.names),
                        "variants": [member.variant for member in model.members],
                        "misfit": model.fitted.misfit,
                        "left_out_error": model.left,
                        "values": {u.name: model.fitted.value(u.name) for u in model.fitted.unknowns},
                    }
                    for model in step.tried
                ],
                "kept": _kept(step.tried, result.verdict.model.names),
            }
            for step in result.path
        ],
        "split": {"train": list(result.split.train), "test": list(result.split.test)},
        "training": {
            "misfit_before": result.declared.fitted.misfit,
            "misfit_after": result.verdict.model.fitted.misfit,
            "numerics": result.numerics,
        },
        "held_out": _errors(result.held_out),
        "recordings": [
            {"scene": r.scene, "role": r.role, "frames": list(r.frames), **_errors(r.held_out)}
            for r in result.recordings
        ],
        "calibrated": {name: _number(number) for name, number in result.calibrated.items()},
        "unexplained": {"rms_m": result.remainder_m, "description": result.remainder},
        "remainder": _remainder(result),
        "hypotheses": [
            {
                "effects": list(s.effects),
                "posterior": s.posterior,
                "misfit": s.misfit,
                "left_out": s.left_out,
                "discrepancy_m": s.discrepancy_m,
            }
            for s in result.supported
        ],
        "suggested_experiment": None if result.experiment is None else result.experiment.document(),
        "notes": list(result.notes),
        "stages": [
            {"name": s.name, "simulations": s.simulations, "seconds": s.seconds} for s in result.stages
        ],
        "seconds": result.seconds,
        "simulations": result.simulations,
    }
    answer: dict[str, Any] = _finite(found)
    return answer


def _kept(tried: Sequence[Hypothesis], answer: Sequence[str]) -> list[str] | None:
    """What of a step is in the answer, or on the way to it."""
    found = [h for h in tried if set(h.names) <= set(answer)]
    return list(min(found, key=lambda h: h.left).names) if found else None


def _support(result: TraceResult, name: str) -> dict[str, float | None]:
    """An effect's posterior, and the share of the held-out error that it takes away; null where neither was asked."""
    asked = bool(result.supported)
    return {
        "posterior": sum(s.posterior for s in result.supported if name in s.effects) if asked else None,
        "share_of_held_out_error": result.shares.get(name),
    }


def _remainder(result: TraceResult) -> dict[str, Any]:
    """What is left on held-out frames: beyond the noise [m], over the noise, as a share of the error before."""
    out, noise = result.held_out, result.held_out.noise_floor
    return {
        "rms_m": math.sqrt(max(out.after**2 - (noise or 0.0) ** 2, 0.0)),
        "over_noise": out.after / noise if noise else None,
        "share": out.after / out.before if out.before > 0 else None,
        "description": result.remainder,
    }


def _errors(out: HeldOut) -> dict[str, Any]:
    return {
        "metric": METRIC,
        "noise_floor": out.noise_floor,
        "before": out.before,
        "after": out.after,
        "after_ci95": list(out.after_ci95),
        "gain_ci95": list(out.gain_ci95),
        "chamfer_before": out.chamfer_before,
        "chamfer_after": out.chamfer_after,
        "baselines": out.baselines,
        "explained_fraction": out.explained_fraction,
    }


def _effect(effect: Named) -> dict[str, Any]:
    title = EFFECTS[effect.name].title
    return {
        "name": effect.name,
        "title": title,
        "parameters": {k: _number(n) for k, n in effect.parameters.items()},
    }


def _number(number: Number) -> dict[str, Any]:
    return {
        "value": number.value,
        "ci95": None if number.ci95 is None else list(number.ci95),
        "unit": number.unit,
    }


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) or hasattr(value, "dtype"):
        number = float(value)
        return number if math.isfinite(number) else None
    return value


_STRONG = 0.4  # correlation worth a word


def describe(scene: Scene, tracks: Array, frames: tuple[int, int], sigma: float) -> tuple[float, str]:
    """Root mean squared remainder per axis beyond the noise [m], and a description.

    Args:
        tracks: prediction, (T, N, 3) [m].
        frames: half-open range that is described.
        sigma: noise [m].
    """
    window = slice(*frames)
    seen = scene.visible[window]
    error = np.where(seen[..., None], scene.points[window] - tracks[window], 0.0)
    square = (error**2).sum(axis=2) / 3.0
    total = float(square[seen].mean())
    beyond = float(np.sqrt(max(total - sigma**2, 0.0)))
    if beyond < 0.5 * sigma:
        return beyond, "nothing beyond the noise that could be described"
    parts = [_when(square, seen), _where(scene, square, seen), _along(error[seen])]
    parts += _with(scene, tracks, error, seen, window)
    return beyond, "; ".join(part for part in parts if part)


def _when(square: Array, seen: Array) -> str:
    per_frame = square.sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    thirds = [float(np.sqrt(part.mean())) for part in np.array_split(per_frame, 3)]
    trend = (
        "grows" if thirds[2] > 1.5 * thirds[0] else "falls" if thirds[0] > 1.5 * thirds[2] else "is steady"
    )
    return f"it {trend} over time (thirds: {', '.join(f'{1e3 * t:.2g}' for t in thirds)} mm rms)"


def _where(scene: Scene, square: Array, seen: Array) -> str:
    per_point = square.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    start = scene.points[0]
    worst = np.argsort(per_point)[-max(len(per_point) // 10, 1) :]
    share = float(per_point[worst].sum() / max(per_point.sum(), 1e-300))
    centre = start[worst].mean(axis=0)
    place = ", ".join(f"{c:z.3f}" for c in centre)
    return f"a tenth of the points, about ({place}) m at the start, carries {share:.0%} of its square"


def _along(error: Array) -> str:
    values, vectors = np.linalg.eigh(error.T @ error)
    share = float(values[-1] / max(values.sum(), 1e-300))
    way = ", ".join(f"{c:+z.2f}" for c in vectors[:, -1])
    return f"{share:.0%} of it along ({way})" if share > 0.5 else "it has no main direction"


def _with(scene: Scene, tracks: Array, error: Array, seen: Array, window: slice) -> list[str]:
    """Correlations with motions that a missing law would depend on."""
    velocity = np.gradient(tracks, scene.times, axis=0)
    acceleration = np.gradient(velocity, scene.times, axis=0)
    steady = np.broadcast_to(tracks[:1] - tracks.mean(axis=1, keepdims=True)[:1], tracks.shape)
    fields = {
        "velocity": velocity,
        "speed times velocity": velocity * np.linalg.norm(velocity, axis=2, keepdims=True),
        "acceleration": acceleration,
        "displacement from the start": tracks - tracks[:1],
        "place in the body": steady,
    }
    if len(scene.controllers[0]):
        grip = np.gradient(scene.controllers.mean(axis=1), scene.times, axis=0)
        fields["velocity of the grips"] = np.broadcast_to(grip[:, None], tracks.shape)
    found = []
    for name, values in fields.items():
        there = values[window][seen]
        size = float(np.linalg.norm(there) * np.linalg.norm(error[seen]))
        correlation = float(np.sum(there * error[seen])) / size if size > 0 else 0.0
        if abs(correlation) > _STRONG:
            found.append((abs(correlation), f"it goes with {name} (correlation {correlation:+z.2f})"))
    return [text for _, text in sorted(found, reverse=True)[:2]]
