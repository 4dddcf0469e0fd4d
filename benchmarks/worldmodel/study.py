"""``python -m benchmarks.worldmodel.study --json FILE``: what a graph network learns with a prior under it and without.

Four bodies (``benchmarks.worldmodel.bodies``), several ways to a world model (``.variants``), the same episodes and the
same processor time for each, one thread. Errors are mean distances of vertices from the twin over whole episodes of
100 frames, open loop from the first frames, on episodes that no training saw: ``unseen`` ones of the taught kinds of
motion, and ``turned`` ones, whose grips turn by 90° to 180°. Standing still and following the grips rigidly stand
beside.

A cell (body, variant, seed) is kept in ``--cells`` as soon as it is done, under a key of its settings and of the code
that made it: a run that was ended goes on where it stopped, and what was made by other code is made anew.
``--minutes`` ends a run before the next cell, ``--bodies``, ``--variants`` and ``--seeds`` run those alone; the report
has every cell that is there.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Report, write_json, write_section
from benchmarks.worldmodel.bodies import BODIES, JUDGED_FRAMES, SUBTICKS, TAUGHT, Episodes, episodes_of
from benchmarks.worldmodel.variants import MODEL, VARIANTS, Trained
from physworld.geometry.rigid import rigid_motion
from physworld.worldmodel.dataset import Track

CELLS = Path(".bench") / "worldmodel"
BUDGET_S = 300.0
JUDGED = ("unseen", "turned")
GIVEN = MODEL.history + 1  # frames at 1/30 s that are not scored
SHOWN = (10, 25, 50, 97)
CODE = ("physworld/worldmodel", "benchmarks/worldmodel")
ROOT = Path(__file__).resolve().parents[2]


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--docs", type=Path, help="a page whose section is replaced")
    parser.add_argument("--cells", type=Path, default=CELLS)
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--budget", type=float, default=BUDGET_S, help="processor seconds a cell")
    parser.add_argument("--bodies", nargs="*", default=[*BODIES], choices=[*BODIES])
    parser.add_argument("--variants", nargs="*", default=[*VARIANTS], choices=[*VARIANTS])
    parser.add_argument("--taught", type=int, default=TAUGHT, help="episodes to learn from")
    parser.add_argument("--seeds", nargs="*", type=int, default=[0])
    given = parser.parse_args()
    until = time.monotonic() + 60.0 * given.minutes
    for seed in given.seeds:
        for variant in given.variants:
            for body in given.bodies:
                path = cell_path(given.cells, body, variant, seed, given.budget, given.taught)
                if path.exists() or time.monotonic() > until:
                    continue
                episodes = episodes_of(body, given.cells, MODEL, given.taught)
                if episodes is None:
                    print(f"{body}: left out, its scene is not on this machine", file=sys.stderr)
                    continue
                found = cell(episodes, variant, seed, given.budget)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(json.dumps(found, indent=1))
                errors = {part: round(1e3 * found[part]["mean_m"], 2) for part in JUDGED}
                print(f"{body} {variant} {seed}: {errors} mm, {found['notes']}", file=sys.stderr, flush=True)
    report = report_of(given.cells, given.budget, given.taught)
    print(report.markdown())
    if given.json is not None:
        write_json(report, given.json)
    if given.docs is not None:
        write_section(report, given.docs)
    return 0


def cell_path(
    folder: Path, body: str, variant: str, seed: int, budget_s: float, taught: int = TAUGHT
) -> Path:
    """Where the cell of these settings and this code lies.

    Args:
        folder: of all cells.
        body: by name.
        variant: by name.
        seed: of the training.
        budget_s: processor seconds of it.
        taught: episodes to learn from.
    """
    held = {
        "variant": asdict(VARIANTS[variant]),
        "budget": budget_s,
        "model": asdict(MODEL),
        "taught": taught,
        "code": code_digest(),
    }
    digest = hashlib.sha256(json.dumps(held, sort_keys=True, default=str).encode()).hexdigest()[:10]
    return folder / "cells" / f"{body}.{variant}.{seed}.{digest}.json"


def code_digest() -> str:
    """Of every file that a cell's figures come from."""
    files = sorted(path for room in CODE for path in (ROOT / room).rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]


def cell(episodes: Episodes, variant: str, seed: int, budget_s: float) -> dict[str, Any]:
    """Errors of one variant on one body, and of the baselines."""
    trained = VARIANTS[variant].learn(episodes, budget_s, seed)
    found: dict[str, Any] = {"notes": trained.notes}
    for part in JUDGED:
        truth = [track.positions.numpy() for track in episodes.tracks(part)]
        n = episodes.spec.object_count
        found[part] = summary(distances(predicted(trained, episodes, part), truth, n))
        found[part]["baselines"] = {
            name: summary(distances([guess(path, n) for path in truth], truth, n))
            for name, guess in (("static", standing_still), ("rigid_follow", following))
        }
    return found


def predicted(trained: Trained, episodes: Episodes, part: str) -> list[np.ndarray]:
    """Positions (T, V, 3) at the frames of 1/30 s; the model starts where the last given one is."""
    every, ahead = trained.every, (GIVEN - 1) * SUBTICKS // trained.every - (trained.given - 1)
    judged = [Track(t.positions[ahead:], t.phi) for t in episodes.tracks(part, every)]
    whole = [t.positions.numpy() for t in episodes.tracks(part)]
    paths = []
    for guess, truth in zip(trained.predict(judged), whole, strict=True):
        frames = guess.numpy()[trained.given - 1 :: SUBTICKS // every]
        paths.append(np.concatenate([truth[: GIVEN - 1], frames]))
    return paths


def distances(paths: list[np.ndarray], truth: list[np.ndarray], n: int) -> np.ndarray:
    """Mean over object vertices, (episodes, frames after the given ones) [m]; infinite where numbers were left."""
    gaps = [
        np.linalg.norm(a[GIVEN:, :n] - b[GIVEN:, :n], axis=-1).mean(axis=1)
        for a, b in zip(paths, truth, strict=True)
    ]
    together = np.stack(gaps).astype(np.float64)
    return np.where(np.isfinite(together), together, np.inf)


def standing_still(path: np.ndarray, n: int) -> np.ndarray:
    """The last given frame for ever."""
    return np.concatenate([path[:GIVEN], np.repeat(path[GIVEN - 1 : GIVEN], len(path) - GIVEN, axis=0)])


def following(path: np.ndarray, n: int) -> np.ndarray:
    """As the control vertices move."""
    turns, shifts = rigid_motion(path[GIVEN - 1, n:].astype(float), path[GIVEN:, n:].astype(float))
    moved = np.einsum("tij,nj->tni", turns, path[GIVEN - 1]) + shifts[:, None]
    return np.concatenate([path[:GIVEN], moved])


def summary(errors: np.ndarray) -> dict[str, Any]:
    """Of (episodes, frames) [m]: mean, standard error over episodes, worst, against the horizon."""
    means, curve = errors.mean(axis=1), errors.mean(axis=0)
    return {
        "mean_m": float(means.mean()),
        "error_of_mean_m": float(means.std(ddof=1) / np.sqrt(len(means))),
        "largest_m": float(errors.max()),
        "at_frame_m": {str(frame): float(curve[frame - 1]) for frame in SHOWN},
    }


def report_of(folder: Path, budget_s: float, taught: int = TAUGHT) -> Report:
    """Every cell that is there."""
    rows, figures = [], {}
    for body in BODIES:
        baselines: dict[str, dict[str, Any]] = {}
        for variant in VARIANTS:
            pattern = cell_path(folder, body, variant, 0, budget_s, taught).name.replace(".0.", ".*.")
            cells = [json.loads(path.read_text()) for path in sorted((folder / "cells").glob(pattern))]
            if not cells:
                continue
            figures[f"{body}.{variant}"] = cells
            baselines = {
                name: {part: cells[0][part]["baselines"][name] for part in JUDGED}
                for name in ("static", "rigid_follow")
            }
            texts = [_spread([one[part] for one in cells]) for part in JUDGED]
            notes = cells[0]["notes"]
            rows.append(
                [body, VARIANTS[variant].label, *texts, str(notes["steps"]), f"{notes['processor_s']:.0f}"]
            )
        for name, parts in baselines.items():
            rows.append([body, name.replace("_", " "), *(_spread([parts[part]]) for part in JUDGED), "", ""])
    return Report(
        name="worldmodel.study",
        title="The network alone, with a prior, and in the grip's frame",
        figures=figures,
        header=["body", "model", "unseen episodes [mm]", "turned grips [mm]", "steps", "processor seconds"],
        rows=rows,
        notes=[
            f"{taught} episodes taught; errors over {JUDGED_FRAMES - GIVEN} frames, mean over vertices and episodes ± "
            f"its standard error over episodes; {budget_s:.0f} processor seconds for each training, one thread.",
        ],
    )


def _spread(parts: list[dict[str, Any]]) -> str:
    means = 1e3 * np.array([one["mean_m"] for one in parts])
    if len(means) > 1:
        return f"{means.mean():.2f} ({', '.join(f'{mean:.2f}' for mean in means)})"
    return f"{means[0]:.2f} ± {1e3 * parts[0]['error_of_mean_m']:.2f}"


if __name__ == "__main__":
    sys.exit(main())
