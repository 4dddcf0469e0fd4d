"""``python -m benchmarks.paper.tables --json FILE``: the paper's tables as relations, with their spread over seeds.

On scenes with known truth, made by engines that are not ours, and on real recordings:

* the world model against the twin that taught it, and against the same network trained on the recording alone;
* the network alone, as in the paper without a closed-form prior under it;
* with and without fine-tuning of Φ;
* VMP-Gen against uniform linear motion, both without replays of the recording;
* P3-Pert against none, uniform and random perturbation of the properties;
* steps per second of the world model and of the twin;
* motions of a kind that the training did not see (``benchmarks.paper.unseen_motion``).

Every row stands beside the do-nothing baselines of its scene. Each cell (scene, condition, seed) is kept in
``--cells`` as soon as it is done: a run that was ended goes on where it stopped, and a report says which cells were
not run. ``--minutes`` ends a run before the next cell; ``--conditions`` and ``--seeds`` run those alone (``--seeds``
with nothing after it: none) and report all; ``--workers`` processes share the cells. Networks, episodes and optimiser
steps are those of ``benchmarks.paper.models``, smaller than the service's.
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
from pathlib import Path
from typing import Any

import torch
import warp as wp

from benchmarks.harness import Report, write_json, write_section
from benchmarks.paper import unseen_motion
from benchmarks.paper.models import (
    EPISODES,
    FIT,
    FITS,
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
from benchmarks.paper.relations import (
    ALONE,
    CONDITIONS,
    KINDS,
    LABELS,
    RELATIONS,
    SEEDS,
    TRAININGS,
    UNSEEN,
    cells_with,
    errors_by_prediction,
    hold,
    in_millimetres,
    in_words,
    learned_alone,
    not_run,
    prior_in_words,
    priors_by_condition,
    speed,
)

CELLS = Path(".bench") / "paper_tables"


def main() -> int:
    """Run what is missing, report what there is."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper.tables", description=__doc__)
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
        self._root = folder
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
            case = case_of(name, self._folder(name, "full"))
            assert case is not None, "plan() leaves out scenes that are not here"
            self._cases[name] = case
        return self._cases[name]

    def _path(self, key: str) -> Path:
        return self._folder(*key.split("/")[:2]) / f"{key.replace('/', '-')}.json"

    def _folder(self, scene: str, condition: str) -> Path:
        """One for each set of settings; it is made."""
        text = json.dumps(settings(**_own_settings(scene, condition)), sort_keys=True)
        folder = self._root / hashlib.sha256(text.encode()).hexdigest()[:12]
        folder.mkdir(parents=True, exist_ok=True)
        return folder


def _own_settings(scene: str, condition: str) -> dict[str, Any]:
    """What differs from all others: how the condition is trained, how the scene's twin is fitted."""
    training = {"training": TRAININGS[condition]} if condition in TRAININGS else {}
    return training | ({"fit": FITS[scene]} if scene in FITS else {})


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
            run = len(cells_with(name, prediction, held))
            cells = [in_millimetres(by_metric[metric], run) for metric in METRICS]
            rows.append([f"{name} ({ORIGIN[name]})", LABELS[prediction], *cells])
    notes = [
        f"{done} of {len(held)} cells are done; mean ± standard deviation over the seeds that are ({len(SEEDS)} where "
        f"nothing else is said). {not_run(held)}",
        f"The network alone is trained for {WITHOUT_PRIOR.steps} steps at {WITHOUT_PRIOR.learning_rate:g}, all others "
        f"for {TRAINING.steps} at {TRAINING.learning_rate:g}. {learned_alone(held)}",
        f"Twins are fitted with {FIT.max_simulations} simulations at {FIT.particle_budget} particles, but with the "
        f"service's settings for {', '.join(FITS)}.",
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
            "settings": settings() | {"without_prior": settings(WITHOUT_PRIOR), "fitted_in_full": list(FITS)},
        },
        header=["scene", "prediction", "track, mm", "Chamfer PhysTwin, mm", "Chamfer L2, mm"],
        rows=rows,
        notes=notes,
    )


if __name__ == "__main__":
    sys.exit(main())
