"""``python -m benchmarks.worldmodel.regrasps --json FILE``: world models of bodies that one of two hands lets go of.

A bar, a rope and a cloth between two hands, each a twin with given numbers. Of ``TAUGHT`` demonstrations seven of ten
have a hand that lets go for a while and takes hold again; a world model is learned for each set of hands that hold
(:mod:`physworld.worldmodel.holding`). It is judged on ``JUDGED`` new demonstrations of 100 frames, all with a hand that
lets go, open loop from the first frames: mean distance of the vertices from the twin's. A hand closes on the material
where the model predicted it, or, since its path is known, where it is. Beside it stand following the
hands that hold, standing still, and one model of both hands that is never told that one lets go: for it the open hand
goes straight to where it takes hold again.

Episodes are made once and kept in ``--cells``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.harness import Report, write_json, write_section
from benchmarks.worldmodel.study import CELLS, summary
from benchmarks.worldmodel.variants import MODEL, SMALL, TRAINING
from physworld.arrays import Array
from physworld.demonstrate import DemonstrationConfig, derived_seed, make_episode
from physworld.geometry.rigid import rigid_motion
from physworld.scene import UNDEFORMED_AT_REST, Body, Grip, Scene
from physworld.twin.build import build_twin
from physworld.twin.twin import Twin
from physworld.worldmodel.clock import model_dt
from physworld.worldmodel.holding.rollout import HeldModels
from physworld.worldmodel.holding.spans import train_held
from physworld.worldmodel.model.graph import build_graph

TAUGHT, JUDGED = 300, 8
TAUGHT_FRAMES, JUDGED_FRAMES = 61, 101
FPS, GRAVITY = 30.0, np.array([0.0, 0.0, -9.81])
SETS = ((0, 1), (0,), (1,))
CONFIG = replace(MODEL, **SMALL)
GIVEN = CONFIG.history + 1
Made = dict[str, Array]


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.worldmodel.regrasps", description=__doc__)
    parser.add_argument("--json", type=Path, required=True, help="bodies in it are not trained again")
    parser.add_argument("--docs", type=Path, help="a page whose section is replaced")
    parser.add_argument("--cells", type=Path, default=CELLS, help="keeps the episodes")
    parser.add_argument("--bodies", nargs="*", default=[*BODIES], choices=[*BODIES])
    parser.add_argument("--taught", type=int, default=TAUGHT, help="episodes to learn from")
    parser.add_argument("--frames", type=int, default=TAUGHT_FRAMES, help="of each of them")
    parser.add_argument("--steps", type=int, default=600, help="of each training")
    given = parser.parse_args()
    torch.set_num_threads(1)
    known = json.loads(given.json.read_text())["bodies"] if given.json.exists() else []
    rows = {row["body"]: row for row in known}
    for name in given.bodies:
        if name not in rows:
            rows[name] = cell(name, given.cells, given.taught, given.frames, given.steps)
    report = report_of([rows[name] for name in BODIES if name in rows], given.taught)
    print(report.markdown())
    write_json(report, given.json)
    if given.docs is not None:
        write_section(report, given.docs)
    return 0


def cell(name: str, folder: Path, taught: int, frames: int, steps: int) -> dict[str, Any]:
    """Errors of a body's models on the judged episodes, and of the baselines."""
    scene, twin = BODIES[name]()
    learned = episodes_of(name, scene, twin, folder, "taught", taught, frames)
    judged = episodes_of(name, scene, twin, folder, "judged", JUDGED, JUDGED_FRAMES)
    specs = {
        grips: build_graph(
            twin.particles_rest,
            twin.particles_start,
            twin.controllers_start,
            dt_s=model_dt(scene.fps),
            config=CONFIG,
            control_groups=twin.controller_groups,
            holding=grips,
            gravity_m_s2=GRAVITY,
        )
        for grips in SETS
    }
    begun = time.process_time()
    trained = train_held(learned, specs, 2, CONFIG, replace(TRAINING, steps=steps))
    seconds = time.process_time() - begun
    models = HeldModels({grips: one.model for grips, one in trained.items()}, twin.controller_groups)
    index = specs[SETS[0]].particle_index
    truth = [episode["particles"][:, index].astype(float) for episode in judged]
    quiet = HeldModels({SETS[0]: models.members[SETS[0]]}, twin.controller_groups)

    def rolled(
        known: HeldModels, episode: Made, path: Array, holding: Array, take_hold: bool = True
    ) -> Array:
        phi = episode["properties"][index, :2].astype(float)
        hands = episode["controllers"].astype(float)
        return known.rollout(path[:GIVEN], hands, holding, phi, take_hold=take_hold)

    pairs = list(zip(judged, truth, strict=True))
    guesses = {
        "a world model for each set of hands": [rolled(models, e, x, e["holding"]) for e, x in pairs],
        "the same, hands closing where they are": [
            rolled(models, e, x, e["holding"], False) for e, x in pairs
        ],
        "one model of both hands": [
            rolled(quiet, straight(e, twin.controller_groups), x, np.ones_like(e["holding"]))
            for e, x in pairs
        ],
        "following the hands that hold": [following(e, x, twin.controller_groups) for e, x in pairs],
        "standing still": [np.repeat(x[GIVEN - 1 : GIVEN], len(x), axis=0) for _, x in pairs],
    }
    gaps = {
        label: summary(
            np.stack(
                [np.linalg.norm(a - b, axis=2).mean(axis=1)[GIVEN:] for a, b in zip(own, truth, strict=True)]
            )
        )
        for label, own in guesses.items()
    }
    opened = [float((episode["holding"] == 0).any(axis=1).mean()) for episode in judged]
    return {
        "body": name,
        "errors": gaps,
        "processor_s": seconds,
        "open_share": float(np.mean(opened)),
        "priors": {str(list(grips)): one.prior for grips, one in trained.items()},
        "vertices": len(index),
    }


def episodes_of(
    name: str, scene: Scene, twin: Twin, folder: Path, part: str, count: int, frames: int
) -> list[Made]:
    """Demonstrations of a part, made once."""
    config = DemonstrationConfig(
        frames=frames,
        replay_share=0.0,
        regrasp_share=0.7 if part == "taught" else 1.0,
    )
    path = folder / f"regrasp-{name}-{part}-{count}-{frames}.npz"
    if not path.exists():
        first = 0 if part == "taught" else 10**6
        made = [make_episode(scene, twin, config, derived_seed(first, k))[0] for k in range(count)]
        folder.mkdir(parents=True, exist_ok=True)
        stacked = {key: np.stack([episode[key] for episode in made]) for key in made[0]}
        np.savez(path.with_suffix(".part.npz"), allow_pickle=False, **stacked)
        path.with_suffix(".part.npz").replace(path)
    with np.load(path, allow_pickle=False) as held:
        arrays = {key: held[key] for key in held.files}
    return [{key: values[k] for key, values in arrays.items()} for k in range(count)]


def straight(episode: Made, groups: tuple[Array, ...]) -> Made:
    """The episode with each open hand led straight to where it closes."""
    controllers = episode["controllers"].copy()
    ticks = np.arange(len(controllers))
    for grip, group in enumerate(groups):
        held = episode["holding"][:, grip] != 0
        for point in group:
            for axis in range(3):
                path = controllers[:, point, axis]
                controllers[:, point, axis] = np.interp(ticks, ticks[held], path[held])
    return {**episode, "controllers": controllers}


def following(episode: Made, path: Array, groups: tuple[Array, ...]) -> Array:
    """The body as one rigid piece that goes with the hands that hold, tick by tick, (T, n, 3) [m]."""
    moved = path.copy()
    for tick in range(GIVEN - 1, len(path) - 1):
        hands = np.concatenate([groups[g] for g in np.flatnonzero(episode["holding"][tick])])
        now, ahead = (episode["controllers"][t, hands].astype(float) for t in (tick, tick + 1))
        turns, shifts = rigid_motion(now, ahead[None])
        moved[tick + 1] = moved[tick] @ turns[0].T + shifts[0]
    return moved


def still(points: Array, hands: tuple[Array, Array], kind: str, body: Body, **facts: Any) -> Scene:
    """A scene of 2 s in which nothing moves but the material: its twin and what its hands may do are all that is asked.

    Args:
        points: tracked (N, 3) [m].
        hands: control points of each (k, 3) [m].
        kind: of object.
        body: what is declared of it.
        facts: other fields of the scene, its grips among them.
    """
    times = np.arange(round(2.0 * FPS)) / FPS
    every = np.concatenate(hands)
    grips = (
        Grip(tuple(range(len(hands[0]))), **facts.pop("first", {})),
        Grip(tuple(range(len(hands[0]), len(every))), **facts.pop("second", {})),
    )
    return Scene(
        name=kind, kind=kind, points=np.repeat(points[None], len(times), axis=0),
        visible=np.ones((len(times), len(points)), dtype=bool), controllers=np.repeat(every[None], len(times), axis=0),
        times=times, gravity_m_s2=GRAVITY, noise_sigma_m=1e-3, train=(0, 40), test=(40, len(times)), fps=FPS,
        body=body, grips=grips, **facts,
    )  # fmt: skip


def around(place: tuple[float, float, float], reach: float = 0.015) -> Array:
    """Control points of a hand about a place, (4, 3) [m]."""
    return np.array(place) + reach * np.array([[0, 1, 1], [0, -1, 1], [0, 1, -1], [0, -1, -1]])


def bar() -> tuple[Scene, Twin]:
    """0.3 × 0.03 × 0.03 m of 300 kPa."""
    low, high = np.array([0.0, -0.015, -0.015]), np.array([0.3, 0.015, 0.015])
    lines = np.linspace(0.0, 0.3, 10), (-0.015, 0.015), (-0.015, 0.015)
    scene = still(
        np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3),
        (around((0.0, 0.0, 0.0)), around((0.3, 0.0, 0.0))),
        "beam",
        Body(box_min_m=low, box_max_m=high, density_kg_m3=500.0),
        initial_state=UNDEFORMED_AT_REST,
        first={"region_min_m": low - 0.01, "region_max_m": low + np.array([0.03, 0.04, 0.04])},
        second={"region_min_m": high - np.array([0.03, 0.04, 0.04]), "region_max_m": high + 0.01},
    )
    return scene, build_twin(scene, 300).with_parameters(
        youngs_modulus_pa=3e5, viscosity_pa_s=100.0, air_drag_per_s=0.5
    )


def rope() -> tuple[Scene, Twin]:
    """A discrete rod of 0.6 m that sags between hands 0.45 m apart."""
    x = np.linspace(0.0, 0.45, 400)
    curve = np.stack([x, 0.0 * x, 0.75 * (x - 0.225) ** 2 / 0.225], axis=1)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    marks = np.linspace(0.0, arc[-1], 13)
    points = np.stack([np.interp(marks, arc, curve[:, k]) for k in range(3)], axis=1)
    scene = still(
        points,
        (around(tuple(points[0])), around(tuple(points[-1]))),
        "rope",
        Body(segment_rest_lengths_m=np.full(12, arc[-1] / 12), radius_m=0.005, density_kg_m3=900.0),
    )
    return scene, build_twin(scene, 60).with_parameters(relaxation_s=0.02, air_drag_per_s=0.5)


def cloth() -> tuple[Scene, Twin]:
    """A sheet of 0.24 m that hangs from its upper corners."""
    side, corner = np.linspace(-0.12, 0.12, 9), 0.03
    points = np.array([[a, 0.0, b] for a in side for b in side])
    boxes = [
        {
            "region_min_m": np.array([x - corner, -0.01, 0.12 - corner]),
            "region_max_m": np.array([x + corner, 0.01, 0.13]),
        }
        for x in (-0.12, 0.12)
    ]
    scene = still(
        points,
        (around((-0.12, 0.0, 0.12)), around((0.12, 0.0, 0.12))),
        "sheet",
        Body(thickness_m=4e-3, density_kg_m3=300.0),
        initial_state=UNDEFORMED_AT_REST,
        first=boxes[0],
        second=boxes[1],
    )
    return scene, build_twin(scene, 400).with_parameters(relaxation_s=0.005, air_drag_per_s=0.5)


def report_of(rows: list[dict[str, Any]], taught: int) -> Report:
    """The table, errors beside those of following the hands."""
    table = []
    for row in rows:
        base = row["errors"]["following the hands that hold"]["mean_m"]
        for label, own in row["errors"].items():
            mean = f"{1e3 * own['mean_m']:.2f} ± {1e3 * own['error_of_mean_m']:.2f}"
            table.append((row["body"], label, mean, f"{own['mean_m'] / base:.2f}", *(
                f"{1e3 * own['at_frame_m'][str(f)]:.1f}" for f in (25, 50, 97)
            )))  # fmt: skip
    return Report(
        name="regrasps",
        title="Hands that let go and take hold again",
        figures={"bodies": rows},
        header=("body", "model", "error [mm]", "over following", "after 25", "50", "97 frames"),
        rows=tuple(table),
        notes=(
            f"{taught} episodes taught; {JUDGED} of {JUDGED_FRAMES} frames judged, in "
            f"{np.mean([row['open_share'] for row in rows]):.0%} of whose ticks one hand is open.",
            "Trainings took "
            + ", ".join(f"{row['processor_s']:.0f} s ({row['body']})" for row in rows)
            + " of a processor, three models each.",
        ),
        seed=0,
    )


BODIES: dict[str, Callable[[], tuple[Scene, Twin]]] = {"bar": bar, "rope": rope, "cloth": cloth}

if __name__ == "__main__":
    sys.exit(main())
