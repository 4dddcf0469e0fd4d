"""``python -m benchmarks.worldmodel.going_on --json FILE``: a network of three beams, on a fourth.

Three bodies are learned in turn, each training going on from the network of the one before (``start_from`` of a
training). Then the fourth: its prior alone, that network on it without any training, a training that goes on from it,
and one from random weights with as many steps. Prior, scales and graph are the fourth's own in all of them. Errors are
those of ``benchmarks.worldmodel.study``, on the same kinds of episodes.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.harness import Report, write_json, write_section
from benchmarks.paper.models import SHARED
from benchmarks.worldmodel.bodies import BODIES, Body, Episodes, episodes_of
from benchmarks.worldmodel.study import CELLS, JUDGED, distances, summary
from benchmarks.worldmodel.variants import MODEL, SMALL, TRAINING
from physworld.worldmodel.model.model import WorldModel
from physworld.worldmodel.rollout import rollout_tracks
from physworld.worldmodel.training import TrainingResult, train

BEAMS = {
    "beam": BODIES["beam"],
    **{name: Body(SHARED / "undeclared" / name) for name in ("d01", "d02", "d09")},
}
ARCHITECTURE = replace(MODEL, **SMALL)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--docs", type=Path, help="a page whose section is replaced")
    parser.add_argument("--cells", type=Path, default=CELLS, help="keeps twins and episodes")
    parser.add_argument("--taught", type=int, default=100, help="episodes of each to learn from")
    parser.add_argument("--steps", type=int, default=300, help="of each training")
    given = parser.parse_args()
    torch.set_num_threads(1)
    BODIES.update(BEAMS)
    bodies = {name: episodes_of(name, given.cells, ARCHITECTURE, given.taught) for name in BEAMS}
    absent = [name for name, episodes in bodies.items() if episodes is None]
    if absent:
        print(f"not on this machine: {', '.join(absent)}", file=sys.stderr)
        return 1
    *others, fourth = (episodes for episodes in bodies.values() if episodes is not None)
    network: WorldModel | None = None
    for episodes in others:
        network = learned(episodes, given.steps, network).model
    own, prior = learned(fourth, given.steps), learned(fourth, 0)
    models = {
        "its prior alone": prior.model,
        "its own network": own.model,
        "the network of the three others, untrained on it": learned(fourth, 0, network).model,
        "its network, going on from that one": learned(fourth, given.steps, network).model,
    }
    rows = [
        [name, *(f"{error(model, fourth, part):.2f}" for part in JUDGED)] for name, model in models.items()
    ]
    report = Report(
        name="worldmodel.going_on",
        title="A network of three beams, on a fourth",
        figures={row[0]: dict(zip(JUDGED, map(float, row[1:]), strict=True)) for row in rows},
        header=["model of d09", "unseen episodes [mm]", "turned grips [mm]"],
        rows=rows,
        notes=[
            f"{given.taught} episodes of each body, {given.steps} steps of each training; before: beam, d01, d02."
        ],
    )
    print(report.markdown())
    write_json(report, given.json)
    if given.docs is not None:
        write_section(report, given.docs)
    return 0


def learned(episodes: Episodes, steps: int, start: WorldModel | None = None) -> TrainingResult:
    """A training of so many steps, none: a prior, or on it the network that it starts from."""
    settings = replace(TRAINING, steps=steps, validation_every=max(1, steps // 3))
    return train(episodes.tracks("taught"), episodes.spec, ARCHITECTURE, settings, start=start)


def error(model: WorldModel, episodes: Episodes, part: str) -> float:
    """Mean distance of vertices on the episodes of a part [mm]."""
    tracks = episodes.tracks(part)
    paths = [path.numpy() for path in rollout_tracks(model, tracks)]
    truth = [track.positions.numpy() for track in tracks]
    return 1e3 * float(summary(distances(paths, truth, episodes.spec.object_count))["mean_m"])


if __name__ == "__main__":
    sys.exit(main())
