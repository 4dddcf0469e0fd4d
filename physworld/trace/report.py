"""The machine-readable answer of a trace."""

from __future__ import annotations

import math
from typing import Any

from physworld.effects.registry import EFFECTS
from physworld.trace.held_out import METRIC, HeldOut
from physworld.trace.result import Named, Number, TraceResult

SCHEMA_VERSION = 1
_SHOWN = 10  # best scores of a step


def document(result: TraceResult) -> dict[str, Any]:
    """The answer under stable keys; JSON types only, numbers that are not finite as null."""
    ranked = result.path[0].scores if result.path else None
    selected = set(result.verdict.model.names) if result.effects else set()
    best: dict[str, dict[str, Any]] = {}
    for score in ranked.ranked if ranked else ():
        name = score.candidate.effect
        best.setdefault(
            name,
            {
                "name": name,
                "title": EFFECTS[name].title,
                "variant": score.candidate.variant or None,
                "score": score.share,
                "threshold": max(ranked.threshold, 0.0) if ranked else 0.0,
                "p_value": score.p_value,
                "absorbed": score.absorbed,
                "selected": name in selected,
            },
        )
    found = {
        "schema_version": SCHEMA_VERSION,
        "scene": result.scene,
        "verdict": result.verdict.name,
        "reason": result.verdict.reason,
        "effects": [_effect(effect) for effect in result.effects],
        "equivalent": [_effect(effect) for model in result.equivalent for effect in model],
        "candidates": list(best.values()),
        "refused": result.refused,
        "decoys": ranked.decoys if ranked else [],
        "path": [
            {
                "base": list(step.base.names),
                "threshold": step.scores.threshold,
                "scores": [
                    {"name": s.candidate.effect, "variant": s.candidate.variant or None, "score": s.share}
                    for s in step.scores.ranked[:_SHOWN]
                ],
                "tried": [
                    {
                        "effects": list(model.names),
                        "variants": [member.variant for member in model.members],
                        "misfit": model.fitted.misfit,
                        "left_out_error": model.validated.mean,
                        "values": {u.name: model.fitted.value(u.name) for u in model.fitted.unknowns},
                    }
                    for model in step.tried
                ],
                "kept": list(step.kept.names) if step.kept else None,
            }
            for step in result.path
        ],
        "split": {"train": list(result.split.train), "test": list(result.split.test)},
        "training": {
            "misfit_before": result.declared.fitted.misfit,
            "misfit_after": result.verdict.model.fitted.misfit,
            "numerics": result.numerics,
            "second_resolution": {" + ".join(names): values for names, values in result.finer.items()},
        },
        "held_out": _errors(result.held_out),
        "recordings": [
            {"scene": r.scene, "role": r.role, "frames": list(r.frames), **_errors(r.held_out)}
            for r in result.recordings
        ],
        "calibrated": {name: _number(number) for name, number in result.calibrated.items()},
        "unexplained": {"rms_m": result.remainder_m, "description": result.remainder},
        "suggested_experiment": None if result.experiment is None else result.experiment.document(),
        "notes": list(result.notes),
        "stages": [
            {"name": s.name, "simulations": s.simulations, "seconds": s.seconds} for s in result.stages
        ],
        "seconds": result.seconds,
        "simulations": result.simulations,
    }
    return _finite(found)


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
