"""A check as a document: JSON types only, ``null`` for what has no size."""

from __future__ import annotations

from typing import Any

import numpy as np

from physworld.check.motion import Change, Proposal
from physworld.check.run import CheckResult
from physworld.check.visibility import EffectFigure, ParameterFigure, View
from physworld.experiments.proposal import rounded

SCHEMA_VERSION = 1


def document(result: CheckResult) -> dict[str, Any]:
    """Everything that a check found; see docs/check.md for the keys."""
    twin = result.physics.twin
    return {
        "schema_version": SCHEMA_VERSION,
        "scene": result.scene,
        "formulation": twin.form.title,
        "law": type(twin.law).__name__,
        "noise_m": result.sigma_m,
        "noise_is": result.noise,
        "motion_m": result.motion_m,
        "frames": result.frames,
        "views": [_view(result.perfect), _view(result.usual)],
        "proposal": None if result.proposal is None else _proposal(result.proposal),
        "asked": dict(result.asked),
        "refused": dict(result.refused),
        "simulations": result.simulations,
        "seconds": round(result.seconds, 3),
    }


def _view(view: View) -> dict[str, Any]:
    return {
        "discrepancy_m": view.discrepancy_m,
        "discrepancy_share": view.share,
        "parameters": [_parameter(figure) for figure in view.parameters],
        "effects": [_effect(figure) for figure in view.effects],
        "pairs": [
            {
                "labels": list(pair.labels),
                "correlation": pair.correlation,
                "apart_from_multiple": _finite(pair.apart_from),
            }
            for pair in view.pairs
        ],
        "groups": [list(group) for group in view.groups],
    }


def _parameter(figure: ParameterFigure) -> dict[str, Any]:
    return {
        "name": figure.name,
        "unit": figure.unit,
        "value": figure.value,
        "value_is": "given" if figure.given else "prior",
        "prior95": list(figure.prior95),
        "expected95": list(figure.expected95),
        "ratio": figure.ratio,
        "optional": figure.optional,
    }


def _effect(figure: EffectFigure) -> dict[str, Any]:
    return {
        "name": figure.effect,
        "label": figure.label,
        "title": figure.title,
        "status": figure.status,
        "multiple": _finite(figure.multiple),
        "gates": [
            {
                "name": gate.name,
                "unit": gate.unit,
                "plausible": gate.plausible,
                "most": gate.most,
                "detectable": _finite(gate.detectable),
            }
            for gate in figure.gates
        ],
        "shapes": figure.shapes,
        "visible_shapes": figure.visible_shapes,
        "hidden_by": dict(figure.hidden_by),
    }


def _proposal(proposal: Proposal) -> dict[str, Any]:
    return {
        "description": proposal.description,
        "motion": proposal.motion,
        "times_s": rounded(proposal.times_s),
        "controllers": rounded(proposal.controllers),
        "frame_times_s": rounded(proposal.frame_times_s),
        "shows": [_change(change) for change in proposal.shows],
        "separates": [_change(change) for change in proposal.separates],
        "tried": proposal.tried,
        "instead": list(proposal.instead),
    }


def _change(change: Change) -> dict[str, Any]:
    return {
        "labels": list(change.labels),
        "before_multiple": _finite(change.before),
        "after_multiple": _finite(change.after),
        "shown": change.shown,
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
