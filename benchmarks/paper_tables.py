"""``python -m benchmarks.paper_tables --json FILE``: the paper's tables as relations, with their spread over seeds.

On scenes with known truth, made by engines that are not ours, and on real recordings:

* the world model against the twin that taught it, and against the same network trained on the recording alone;
* the network alone, as in the paper without a closed-form prior under it;
* with and without fine-tuning of Φ;
* VMP-Gen against uniform linear motion, both without replays of the recording;
* P3-Pert against none, uniform and random perturbation of the properties;
* steps per second of the world model and of the twin;
* motions of a kind that the training did not see (``benchmarks.unseen_motion``).

Every row stands beside the do-nothing baselines of its scene. Each cell (scene, condition, seed) is kept in
``--cells`` as soon as it is done: a run that was ended goes on where it stopped, and a report says which cells were
not run. ``--minutes`` ends a run before the next cell; ``--conditions`` and ``--seeds`` run those alone (``--seeds``
with nothing after it: none) and report all; ``--workers`` processes share the cells. Networks, episodes and optimiser
steps are those of ``benchmarks.paper_models``, smaller than the service's.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarks import unseen_motion
from benchmarks.harness import Report, write_json, write_section
from benchmarks.paper_models import (
    EPISODES,
    METRICS,
    ORIGIN,
    SCENES,
    TRAINING,
    WITHOUT_PRIOR,
    Case,
    case_of,
    demonstrations,
    learn,
    recording_alone,
    scene_of,
    score,
    settings,
)
from physworld.demonstrate import DemonstrationConfig

SEEDS = (0, 1, 2)
CELLS = Path(".bench") / "paper_tables"
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


def main() -> int:
    """Run what is missing, report what there is."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper_tables", description=__doc__)
    parser.add_argument("--json", type=Path, default=None, help="write all figures there")
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    parser.add_argument("--cells", type=Path, default=CELLS, help="folder of finished cells")
    parser.add_argument("--minutes", type=float, default=None, help="begin no cell after that long")
    parser.add_argument("--scenes", nargs="*", choices=sorted(SCENES), default=list(SCENES))
    parser.add_argument(
        "--conditions",
        nargs="*",
        choices=KINDS,
        default=KINDS,
        help="run no cells but these; all are reported",
    )
    parser.add_argument(
        "--seeds", nargs="*", type=int, choices=SEEDS, default=SEEDS, help="the same of seeds"
    )
    parser.add_argument("--workers", type=int, default=2, help="processes, one core each")
    given = parser.parse_args()
    wp.config.quiet = True
    torch.set_num_threads(1)
    scenes = [name for name in given.scenes if scene_of(name) is not None]
    for name in sorted(set(given.scenes) - set(scenes)):
        print(f"{name}: left out, {SCENES[name]} is not on this machine", file=sys.stderr)
    cells = Cells(given.cells, given.minutes)
    keys = [key for key, _ in plan(scenes) if _wanted(key, given.conditions, given.seeds)]
    missing = [key for key in keys if cells.get(key) is None]
    for name in dict.fromkeys(key.split("/")[0] for key in missing):
        cells.case(name)  # calibrated once, before processes could do it twice
    settled = (given.cells, given.minutes, scenes)
    if given.workers > 1 and missing:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(given.workers, context, _begin, settled) as pool:
            list(pool.map(_fill, missing))
    else:
        _begin(*settled)
        for key in missing:
            _fill(key)
    report = summarise(given.scenes, {key: cells.get(key) for key, _ in plan(given.scenes)})
    print(report.markdown())
    if given.json is not None:
        write_json(report, given.json)
    if given.docs is not None:
        write_section(report, given.docs)
    return 0


_own: list[tuple[Cells, dict[str, Callable[[Case], dict[str, Any]]]]] = []
"""Of a process that fills cells: where they are, and what each one takes."""


def _wanted(key: str, conditions: Sequence[str], seeds: Sequence[int]) -> bool:
    _, condition, seed = key.split("/")
    return condition in conditions and int(seed) in seeds


def _begin(folder: Path, minutes: float | None, scenes: list[str]) -> None:
    wp.config.quiet = True
    torch.set_num_threads(1)
    _own[:] = [(Cells(folder, minutes), dict(plan(scenes)))]


def _fill(key: str) -> None:
    cells, works = _own[0]
    cells.fill(key, works[key])


class Cells:
    """Finished cells as JSON files; one of other settings counts as absent."""

    def __init__(self, folder: Path, minutes: float | None) -> None:
        self._root, self.folder = folder, folder / _digest(settings())
        self.folder.mkdir(parents=True, exist_ok=True)
        self._until = None if minutes is None else time.monotonic() + 60.0 * minutes
        self._cases: dict[str, Case] = {}

    def get(self, key: str) -> dict[str, Any] | None:
        """A finished cell's figures."""
        path = self._path(key)
        return json.loads(path.read_text()) if path.exists() else None

    def fill(self, key: str, work: Callable[[Case], dict[str, Any]]) -> None:
        """Do the cell's work unless it is done or the time is up."""
        if self._path(key).exists() or (self._until is not None and time.monotonic() > self._until):
            return
        begun = time.perf_counter()
        figures = work(self.case(key.split("/")[0])) | {"seconds": time.perf_counter() - begun}
        partial = self._path(key).with_suffix(".part")
        partial.write_text(json.dumps(figures))
        partial.replace(self._path(key))
        print(f"{key}: {figures['seconds']:.0f} s", file=sys.stderr, flush=True)

    def case(self, name: str) -> Case:
        """The scene with its twin."""
        if name not in self._cases:
            case = case_of(name, self.folder)
            assert case is not None, "plan() leaves out scenes that are not here"
            self._cases[name] = case
        return self._cases[name]

    def _path(self, key: str) -> Path:
        training = TRAININGS.get(key.split("/")[1])
        folder = self.folder if training is None else self._root / _digest(settings(training))
        folder.mkdir(exist_ok=True)
        return folder / f"{key.replace('/', '-')}.json"


def _digest(settled: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(settled, sort_keys=True).encode()).hexdigest()[:12]


def plan(scenes: list[str]) -> Iterator[tuple[str, Callable[[Case], dict[str, Any]]]]:
    """Every cell, a whole seed of all scenes before the next one."""
    for seed in SEEDS:
        if "soft_beam" in scenes:
            yield f"soft_beam/{UNSEEN}/{seed}", lambda case, s=seed: unseen_motion.cell(case, s)
        for name in scenes:
            for condition in CONDITIONS:
                yield f"{name}/{condition}/{seed}", lambda case, c=condition, s=seed: conditioned(case, c, s)
            yield f"{name}/{ALONE}/{seed}", lambda case, s=seed: recording_alone(case, s)


def conditioned(case: Case, condition: str, seed: int) -> dict[str, Any]:
    """A model of the condition's demonstrations, scored on the recording's held-out frames."""
    begun = time.perf_counter()
    episodes, rejected = demonstrations(case, CONDITIONS[condition], EPISODES, seed)
    simulated = time.perf_counter()
    trained = learn(case.view.spec, episodes, seed, TRAININGS.get(condition, TRAINING))
    return {
        **score(case, trained),
        "rejected": rejected,
        "demonstration_s": simulated - begun,
        "training_s": time.perf_counter() - simulated,
    }


def summarise(scenes: list[str], held: dict[str, dict[str, Any] | None]) -> Report:
    """Errors over seeds by scene and prediction, and the relations."""
    done = sum(cell is not None for cell in held.values())
    errors = {name: errors_by_prediction(name, held) for name in scenes}
    relations = {relation.key: hold(relation, errors) for relation in RELATIONS}
    speeds = {name: speed(name, held) for name in scenes}
    rows = []
    for name in scenes:
        if not any(by_metric["track_m"] for by_metric in errors[name].values()):
            continue
        for prediction, by_metric in errors[name].items():
            run = [cell for seed in SEEDS if (cell := held.get(f"{name}/{_source(prediction)}/{seed}"))]
            cells = [in_millimetres(by_metric[metric], len(run)) for metric in METRICS]
            rows.append([f"{name} ({ORIGIN[name]})", LABELS[prediction], *cells])
    notes = [
        f"{done} of {len(held)} cells are done; mean ± standard deviation over the seeds that are ({len(SEEDS)} where "
        f"nothing else is said). {not_run(held)}",
        f"The network alone is trained for {WITHOUT_PRIOR.steps} steps at {WITHOUT_PRIOR.learning_rate:g}, all others "
        f"for {TRAINING.steps} at {TRAINING.learning_rate:g}.",
    ]
    notes += [in_words(relation, relations[relation.key]) for relation in RELATIONS]
    notes += [
        f"{name}: world model {found['world_model']:.0f}, twin {found['twin']:.0f} steps/s ({found['ratio']:.0f} x)."
        for name, found in speeds.items()
        if found is not None
    ]
    priors = {name: priors_by_condition(name, held) for name in scenes}
    notes += [prior_in_words(name, found) for name, found in priors.items() if found]
    unseen_cells = [held.get(f"soft_beam/{UNSEEN}/{seed}") for seed in SEEDS]
    unseen = {
        kind: unseen_motion.pooled([cell and cell[kind] for cell in unseen_cells])
        for kind in unseen_motion.KINDS
    }
    notes += [unseen_motion.in_words(kind, found) for kind, found in unseen.items() if found is not None]
    return Report(
        name="paper_tables",
        title="The paper's tables as relations",
        figures={
            "cells": {
                "done": done,
                "planned": len(held),
                "missing": [key for key in held if held[key] is None],
            },
            "errors": errors,
            "relations": relations,
            "steps_per_second": speeds,
            "priors": priors,
            "unseen_motion": unseen,
            "settings": settings() | {"without_prior": settings(WITHOUT_PRIOR)},
        },
        header=["scene", "prediction", "track, mm", "Chamfer PhysTwin, mm", "Chamfer L2, mm"],
        rows=rows,
        notes=notes,
    )


def errors_by_prediction(name: str, held: dict[str, dict[str, Any] | None]) -> dict[str, Any]:
    """Prediction → metric → {seed: error [m]}; conditions other than full are fine-tuned models."""
    found: dict[str, dict[str, dict[str, float]]] = {
        label: {metric: {} for metric in METRICS} for label in LABELS
    }
    for seed in SEEDS:
        for condition in (*CONDITIONS, ALONE):
            cell = held.get(f"{name}/{condition}/{seed}")
            if cell is None:
                continue
            sources = {condition: "world_model_finetuned"}
            if condition == "full":
                sources = {key: key for key in (*BASELINES, "twin", "world_model", "world_model_finetuned")}
            elif condition == ALONE:
                sources = {ALONE: ALONE}
            for label, source in sources.items():
                for metric in METRICS:
                    error = cell[metric].get(source)
                    if error is not None:
                        found[label][metric][str(seed)] = error
    return found


def _source(prediction: str) -> str:
    """The condition whose cells hold a prediction."""
    return prediction if prediction in CONDITIONS or prediction == ALONE else "full"


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
    scenes = ", ".join(f"{name} {entry['mean']:.2f}" for name, entry in found["by_scene"].items())
    scenes += "".join(f", {name} not run" for name in found["without"])
    return (
        f"{left} / {right}: track error ratio {found['mean_ratio']:.2f} ({scenes}); below 1 in {found['holds_in']} of "
        f"{found['pairs']} pairs of scene and seed; the paper: {relation.paper}."
    )


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


if __name__ == "__main__":
    sys.exit(main())
