"""What ``paper_tables`` relates: conditions, predictions and the paper's inequalities, and finished cells in words.

A cell is what one model of one scene, condition and seed came to (``paper_models.score``); ``held`` has one for each
key ``scene/condition/seed``, None where it was not run. Errors are in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.paper.models import METRICS, WITHOUT_PRIOR
from physworld.demonstrate import DemonstrationConfig

SEEDS = (0, 1, 2)
CONDITIONS = {
    "full": DemonstrationConfig(),
    "vmp": DemonstrationConfig(replay_share=0.0),
    "linear": DemonstrationConfig(motion="linear", replay_share=0.0),
    "none": DemonstrationConfig(perturbation="none"),
    "uniform": DemonstrationConfig(perturbation="uniform"),
    "random": DemonstrationConfig(perturbation="random"),
    "no_prior": DemonstrationConfig(),
}
TRAININGS = {"no_prior": WITHOUT_PRIOR}
"""Of conditions that are trained in another way than ``TRAINING``."""
ALONE = "recording_alone"
UNSEEN = "unseen_motion"
KINDS = (*CONDITIONS, ALONE, UNSEEN)
BASELINES = ("static", "rigid_follow", "constant_velocity")
LABELS = {
    "static": "static",
    "rigid_follow": "rigid follow",
    "constant_velocity": "constant velocity",
    "twin": "twin",
    "recording_alone": "GNN on the recording alone",
    "world_model": "world model, no fine-tuning",
    "world_model_finetuned": "world model, fine-tuned",
    "vmp": "… VMP-Gen alone, no replays",
    "linear": "… linear motion alone, no replays",
    "none": "… no perturbation instead of P3-Pert",
    "uniform": "… uniform perturbation",
    "random": "… random perturbation",
    "no_prior": f"… the network alone, no prior ({WITHOUT_PRIOR.steps} steps)",
}


@dataclass(frozen=True)
class Relation:
    """An inequality of the paper: ``better`` errs less than ``worse``; ``paper``: the ratio of its headline table."""

    key: str
    better: str
    worse: str
    paper: str


RELATIONS = (
    Relation("finetuned_against_twin", "world_model_finetuned", "twin", "0.91 (CD), 1.0 (track)"),
    Relation("finetuned_against_recording_alone", "world_model_finetuned", ALONE, "1/3 to 1/5"),
    Relation("fine_tuning", "world_model_finetuned", "world_model", "0.84"),
    Relation("vmp_against_linear", "vmp", "linear", "below 1"),
    Relation("p3_against_none", "world_model_finetuned", "none", "below 1"),
    Relation("p3_against_uniform", "world_model_finetuned", "uniform", "below 1"),
    Relation("p3_against_random", "world_model_finetuned", "random", "below 1"),
    Relation("finetuned_against_network_alone", "world_model_finetuned", "no_prior", "has no prior"),
    Relation("network_alone_against_twin", "no_prior", "twin", "0.91 (CD), 1.0 (track)"),
    Relation("network_alone_against_recording_alone", "no_prior", ALONE, "1/3 to 1/5"),
)


def errors_by_prediction(name: str, held: dict[str, dict[str, Any] | None]) -> dict[str, Any]:
    """Prediction → metric → {seed: error [m]}; conditions other than full are fine-tuned models."""
    found: dict[str, dict[str, dict[str, float]]] = {
        label: {metric: {} for metric in METRICS} for label in LABELS
    }
    for label in LABELS:
        source = "world_model_finetuned" if label in CONDITIONS else label
        for seed, cell in cells_with(name, label, held).items():
            for metric in METRICS:
                error = cell[metric].get(source)
                if error is not None:
                    found[label][metric][seed] = error
    return found


def cells_with(
    name: str, prediction: str, held: dict[str, dict[str, Any] | None]
) -> dict[str, dict[str, Any]]:
    """By seed, the cell that holds a prediction: twin and baselines stand in the cell of every condition."""
    conditions = [prediction if prediction in CONDITIONS or prediction == ALONE else "full"]
    if prediction in (*BASELINES, "twin"):
        conditions = list(CONDITIONS)
    found = {}
    for seed in SEEDS:
        cells = (held.get(f"{name}/{condition}/{seed}") for condition in conditions)
        cell = next((cell for cell in cells if cell is not None), None)
        if cell is not None:
            found[str(seed)] = cell
    return found


def learned_alone(held: dict[str, dict[str, Any] | None]) -> str:
    """In how many cells the training of the network alone came to nothing."""
    cells = [cell for key, cell in held.items() if cell is not None and key.split("/")[1] == "no_prior"]
    idle = sum(cell.get("best_step") == 0 for cell in cells)
    return f"In {idle} of its {len(cells)} cells no step of that was better than vertices that keep their velocity."


def not_run(held: dict[str, dict[str, Any] | None]) -> str:
    """Which cells there are not, by scene and condition."""
    seeds: dict[str, list[str]] = {}
    for key in (key for key, cell in held.items() if cell is None):
        what, seed = key.rsplit("/", 1)
        seeds.setdefault(what, []).append(seed)
    if not seeds:
        return "All were run."
    parts = [
        what if len(own) == len(SEEDS) else f"{what} (seed {', '.join(own)})" for what, own in seeds.items()
    ]
    return f"Not run: {'; '.join(parts)}."


def hold(relation: Relation, errors: dict[str, Any]) -> dict[str, Any]:
    """Ratios better/worse of the track error by scene and seed, and in how many the relation holds."""
    ratios = {}
    for name, by_prediction in errors.items():
        better, worse = (by_prediction[side]["track_m"] for side in (relation.better, relation.worse))
        own = {seed: better[seed] / worse[seed] for seed in better if seed in worse}
        if own:
            logs = np.log(list(own.values()))
            ratios[name] = {
                "by_seed": own,
                "mean": float(np.exp(logs.mean())),
                "holds": bool((logs < 0.0).all()),
            }
    every = [ratio for found in ratios.values() for ratio in found["by_seed"].values()]
    return {
        "by_scene": ratios,
        "without": [name for name in errors if name not in ratios],
        "pairs": len(every),
        "holds_in": sum(ratio < 1.0 for ratio in every),
        "mean_ratio": float(np.exp(np.mean(np.log(every)))) if every else None,
        "paper": relation.paper,
    }


def in_words(relation: Relation, found: dict[str, Any]) -> str:
    """One line: the ratio here, the paper's, where it holds."""
    left, right = (LABELS[side].removeprefix("… ") for side in (relation.better, relation.worse))
    if not found["pairs"]:
        return f"{left} / {right}: not measured yet."
    scenes = ", ".join(f"{name} {_ratio(entry['mean'])}" for name, entry in found["by_scene"].items())
    scenes += "".join(f", {name} not run" for name in found["without"])
    return (
        f"{left} / {right}: track error ratio {_ratio(found['mean_ratio'])} ({scenes}); below 1 in "
        f"{found['holds_in']} of {found['pairs']} pairs of scene and seed; the paper: {relation.paper}."
    )


def _ratio(value: float) -> str:
    """Two decimals, or one figure of what is less."""
    return f"{value:.2f}" if value >= 0.095 else f"{value:.1g}"


def speed(name: str, held: dict[str, dict[str, Any] | None]) -> dict[str, float] | None:
    """Medians over the scene's cells; None without one."""
    found = [
        cell["steps_per_second"]
        for key, cell in held.items()
        if cell is not None and key.startswith(f"{name}/") and "steps_per_second" in cell
        if key.split("/")[1] not in TRAININGS
    ]
    if not found:
        return None
    medians = {side: float(np.median([cell[side] for cell in found])) for side in ("world_model", "twin")}
    return medians | {"ratio": medians["world_model"] / medians["twin"]}


def priors_by_condition(name: str, held: dict[str, dict[str, Any] | None]) -> dict[str, dict[str, float]]:
    """Condition → mean error [m] of the closed-form prior alone on left-out episodes of that condition, and cells.

    ``untouched`` counts the cells in which the network brought no better validation error than its prior.
    """
    found = {}
    for condition in (one for one in CONDITIONS if one not in TRAININGS):
        cells = [held.get(f"{name}/{condition}/{seed}") for seed in SEEDS]
        own = [cell for cell in cells if cell is not None and "validation_prior_m" in cell]
        if own:
            found[condition] = {
                "validation_prior_m": float(np.mean([cell["validation_prior_m"] for cell in own])),
                "cells": len(own),
                "untouched": sum(cell["best_step"] == 0 for cell in own),
            }
    return found


def prior_in_words(name: str, found: dict[str, dict[str, float]]) -> str:
    """One line."""
    errors = ", ".join(f"{key} {1e3 * entry['validation_prior_m']:.1f}" for key, entry in found.items())
    untouched, cells = (sum(entry[key] for entry in found.values()) for key in ("untouched", "cells"))
    return (
        f"{name}: the closed-form prior alone on left-out episodes of each condition, mm: {errors}; in {untouched} of "
        f"{cells} cells the network brought nothing beyond it."
    )


def in_millimetres(by_seed: dict[str, float], run: int) -> str:
    """``1.76 ± 0.12`` of ``run`` seeds, and how many of them left the numbers; ``not run``."""
    if not run:
        return "not run"
    values = 1e3 * np.array(list(by_seed.values()))
    spread = f" ± {values.std(ddof=1):.2g}" if len(values) > 1 and np.ptp(values) > 0 else ""
    text = f"{values.mean():.3g}{spread}" if len(values) else ""
    seeds = f" ({run} of {len(SEEDS)} seeds)" if run < len(SEEDS) else ""
    lost = f" ({run - len(values)} of {run} left the numbers)" if len(values) < run else ""
    return f"{text}{seeds}{lost}".strip()
