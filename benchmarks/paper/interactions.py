"""``python -m benchmarks.paper.interactions --resume DIR [--docs docs/paper.md]``: unseen interactions without VBench.

The paper's second table judges films of untrained motions by VBench's networks, which are not here. What stands here
has names of its own. For five kinds of motion (:mod:`benchmarks.paper.motions`) of every rendered recording: how far
the predicted points are from the twin's at some horizons; and what needs no reference:

* stretch: the longest edge between neighbouring points over its length at rest, beyond the most that the training
  frames show; 0 where nothing is stretched more than that;
* unrest: mean speed of the points in the last half second of ``stop``, in which the grip stands, over that in the half
  second before it: a passive body comes to rest, so above 1 energy is made;
* flicker: mean absolute second difference of the film's grey values in time, over that of the twin's film.

Predictions are those that ``benchmarks.paper.images`` keeps; nothing is fitted here.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from benchmarks.harness import Report, write_section
from benchmarks.paper.images import CELLS, LABELS, SCENES
from benchmarks.paper.kept import Kept
from benchmarks.paper.motions import WAYS
from benchmarks.paper.pictures import Filmed
from benchmarks.paper.predictions import Settings
from physworld.arrays import Array
from physworld.video import GaussianCarrier, Renderer

PREDICTORS = {
    "twin": "full", "world_model_finetuned": "full", "phystwin": "phystwin", "spring_gaus": "spring_gaus",
    "rigid_follow": "baselines",
}  # fmt: skip
"""By name, the piece of work that has them."""
HORIZONS_S = (0.5, 1.0, 1.9)
NEIGHBOURS = 6
STILL_S, FILM_S = 0.5, 0.5
"""At the end of ``stop``; how much of a motion is filmed."""


def main() -> int:
    """Measure all motions of what is kept, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper.interactions", description=__doc__)
    parser.add_argument("--resume", type=Path, default=CELLS, help="folder of benchmarks.paper.images")
    parser.add_argument("--json", type=Path, default=None, help="write all figures there")
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    parser.add_argument("--only", nargs="*", choices=sorted(SCENES), default=["beam", "rope", "cloth"])
    given = parser.parse_args()
    wp.config.quiet = True
    kept = Kept(given.resume, Settings())
    found = {}
    for name in given.only:
        if all(kept.has(name, work) for work in set(PREDICTORS.values())):
            found[name] = of_recording(kept, name)
        else:
            print(f"{name}: left out, benchmarks.paper.images has not done all of it", file=sys.stderr)
    shown = report(found)
    print(shown.markdown())
    if given.json is not None:
        given.json.write_text(json.dumps(found, indent=1) + "\n")
    if given.docs is not None:
        write_section(shown, given.docs)
    return 0


def of_recording(kept: Kept, name: str) -> dict[str, Any]:
    """Figures by motion and predictor."""
    filmed = kept.filmed(name)
    scene = filmed.recording.scene
    tracks: dict[str, Array] = {}
    for work in set(PREDICTORS.values()):
        tracks |= kept.predictions(name, work)[0]
    edges = edges_of(scene.points[0])
    shown = float(stretches(scene.points[slice(*scene.train)], edges).max())
    found: dict[str, Any] = {}
    for motion in WAYS:
        twin = tracks[f"twin@{motion}"]
        flickers = {}
        for predictor in PREDICTORS:
            path = tracks.get(f"{predictor}@{motion}")
            if path is None:
                continue
            apart = np.linalg.norm(path - twin, axis=2).mean(axis=1)
            flickers[predictor] = flicker(filmed, path, scene.times)
            found.setdefault(motion, {})[predictor] = {
                "off_m": {str(h): float(apart[np.searchsorted(scene.times, h)]) for h in HORIZONS_S},
                "stretch": max(0.0, float(stretches(path, edges).max()) - shown),
                "unrest": unrest(path, scene.times) if motion == "stop" else None,
                "flicker": flickers[predictor] / flickers["twin"],
            }
    return found


def edges_of(points: Array) -> Array:
    """Pairs (E, 2) of points (N, 3) with their nearest ones, each once."""
    _, near = cKDTree(points).query(points, k=min(NEIGHBOURS + 1, len(points)))
    pairs = np.stack([np.repeat(np.arange(len(points)), near.shape[1] - 1), near[:, 1:].ravel()], axis=1)
    return np.unique(np.sort(pairs, axis=1), axis=0)


def stretches(tracks: Array, edges: Array) -> Array:
    """Relative elongation (T, E) of edges (E, 2) of points (T, N, 3), against the first frame."""
    lengths = np.linalg.norm(tracks[:, edges[:, 0]] - tracks[:, edges[:, 1]], axis=2)
    relative: Array = lengths / lengths[0] - 1.0
    return relative


def unrest(tracks: Array, times: Array) -> float:
    """Mean speed of points (T, N, 3) in the last ``STILL_S`` over that in as long a time before; 0 where all stand."""
    speed = np.linalg.norm(np.diff(tracks, axis=0), axis=2).mean(axis=1) / np.diff(times)
    count = round(STILL_S / float(np.median(np.diff(times))))
    late, before = float(speed[-count:].mean()), float(speed[-2 * count : -count].mean())
    return late / before if late > 0.0 else 0.0


def flicker(filmed: Filmed, tracks: Array, times: Array) -> float:
    """Mean absolute second difference in time of the grey values of a prediction's film.

    Args:
        filmed: whose splat is carried, seen by the whole first camera.
        tracks: (T, N, 3) [m].
        times: (T,) [s].
    """
    end = int(np.searchsorted(times, times[-1] - FILM_S))
    carrier = GaussianCarrier(filmed.splat, filmed.recording.scene.points[0])
    renderer = Renderer(filmed.recording.camera)
    film = np.stack([renderer.render(*carrier.at(points)).rgb.mean(axis=2) for points in tracks[end::2]])
    return float(np.abs(np.diff(film, n=2, axis=0)).mean())


def report(found: dict[str, dict[str, Any]]) -> Report:
    """A row for every recording and predictor, means over the motions."""
    rows = []
    for name, motions in found.items():
        for predictor in PREDICTORS:
            own = [of[predictor] for of in motions.values() if predictor in of]
            if not own:
                continue
            off = [np.mean([1e3 * of["off_m"][str(horizon)] for of in own]) for horizon in HORIZONS_S]
            rest = [of["unrest"] for of in own if of["unrest"] is not None]
            rows.append(
                [
                    name, LABELS[predictor].split(",")[0], *(f"{value:.3g}" for value in off),
                    f"{100.0 * max(of['stretch'] for of in own):.3g}",
                    "–" if not rest else f"{rest[0]:.2f}",
                    f"{np.mean([of['flicker'] for of in own]):.2f}",
                ]
            )  # fmt: skip
    return Report(
        name="paper.interactions",
        title="Unseen interactions",
        figures=found,
        header=["recording", "prediction", *(f"off at {h:g} s, mm" for h in HORIZONS_S), "stretch, %", "unrest",
                "flicker"],
        rows=rows,
        notes=[
            f"Five kinds of motion that no training had ({', '.join(WAYS)}): distance from the twin, mean over points "
            "and motions.",
            "Stretch: the longest edge beyond the most in the training frames, worst motion. Unrest: speed in the last "
            "half second of `stop` over that in the half second before, while the grip stands. Flicker: second "
            "differences of the film over those of the twin's. None of these is a score of VBench. No ground and no "
            "free flight is in these motions, so penetration and momentum have no figure.",
        ],
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
