"""``python -m benchmarks.paper.images --json FILE [--resume DIR] [--docs docs/paper.md] [--only SCENE ...]``.

The image columns of the paper's tables, on rendered recordings of known truth: a splat of the first frame is carried by
the tracks of every predictor, rendered, and compared with the camera's pictures by PSNR, SSIM, LPIPS and IoU; beside
them the errors of the tracks. Held-out frames are the paper's future prediction, training frames its reconstruction.
Recording, twin, splat, every piece of work and every score lie in ``--resume``, each under a digest of its sources and
settings: a run that was ended goes on, and the JSON has at any time what is done. ``--minutes`` begins no piece of work
after that long. LPIPS is measured where the package with its weights is installed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
import warp as wp

from benchmarks.harness import Report, describe_machine, write_section
from benchmarks.paper.kept import Kept
from benchmarks.paper.models import METRICS, SMALL, errors_of
from benchmarks.paper.pictures import SCORES, Distance, Filmed
from benchmarks.paper.predictions import PLAN, Settings
from benchmarks.paper.recordings import judged
from physworld.arrays import Array
from physworld.video.lpips import Lpips
from physworld_workers.lpips_weights import WeightsAbsent, installed_weights

NET = "alexnet"
SCENES: dict[str, tuple[str, ...]] = {
    "beam": tuple(PLAN),
    "rope": tuple(PLAN),
    "cloth": tuple(PLAN),
    "uneven_bar": ("baselines", "stages"),
}
"""The plays, and the pieces of work on each: a field of stiffness is there in the bar alone."""
CELLS = Path(".bench") / "paper_images"
LABELS = {
    "truth": "true motion",
    "static": "static",
    "rigid_follow": "rigid follow",
    "twin": "twin, global stage",
    "local": "twin, local stage alone",
    "global_to_local": "twin, global to local",
    "world_model": "world model, no fine-tuning",
    "world_model_finetuned": "world model, fine-tuned",
    "recording_alone": "GNN on the recording alone",
    "recording_no_prior": "GNN on the recording alone, no prior",
    "phystwin": "springs after PhysTwin",
    "spring_gaus": "springs after Spring-Gaus",
    "vmp": "… VMP-Gen alone, no replays",
    "linear": "… linear motion alone, no replays",
    "none": "… no perturbation instead of P3-Pert",
    "uniform": "… uniform perturbation",
    "random": "… random perturbation",
}


def main() -> int:
    """Measure what is missing, write, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper.images", description=__doc__)
    parser.add_argument("--json", type=Path, required=True, help="all figures")
    parser.add_argument("--resume", type=Path, default=CELLS, help="folder of what is done")
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    parser.add_argument("--only", nargs="*", choices=sorted(SCENES), default=list(SCENES))
    parser.add_argument("--works", nargs="*", choices=sorted(PLAN), default=list(PLAN))
    parser.add_argument("--minutes", type=float, default=None, help="begin nothing after that long")
    given = parser.parse_args()
    wp.config.quiet = True
    torch.set_num_threads(1)
    document = measured(
        given.json, Kept(given.resume, Settings()), given.only, given.works, lpips_or_none(), given.minutes
    )
    shown = report(document)
    print(shown.markdown())
    if given.docs is not None:
        write_section(shown, given.docs)
    return 0


def lpips_or_none() -> Distance | None:
    """The distance by AlexNet, where its weights are installed."""
    try:
        return Lpips(installed_weights(NET))
    except WeightsAbsent as error:
        print(f"LPIPS is not measured: {error}", file=sys.stderr)
        return None


def measured(
    target: Path,
    kept: Kept,
    scenes: list[str],
    works: list[str],
    lpips: Distance | None,
    minutes: float | None = None,
) -> dict[str, Any]:
    """The figures of all scenes, written to ``target`` after every piece of work.

    Args:
        target: JSON; what it has of the same sources and settings stays.
        kept: what is done.
        scenes, works: by name; all others stay as they are.
        lpips: distance of two pictures, or None.
        minutes: after which nothing is begun.
    """
    until = None if minutes is None else time.monotonic() + 60.0 * minutes
    document: dict[str, Any] = json.loads(target.read_text()) if target.exists() else {}
    if document.get("key") != kept.key():
        document = {"key": kept.key(), "recordings": {}}
    document |= {"settings": in_words(kept.settings), "machine": describe_machine()}
    for work in PLAN:
        for name in scenes:
            if work not in works or work not in SCENES[name]:
                continue
            if until is not None and time.monotonic() > until:
                return document
            entry = document["recordings"].setdefault(name, {"predictors": {}, "works": {}})
            if work in entry["works"]:
                continue
            measure(entry, kept, name, work, lpips)
            partial = target.with_suffix(".part")
            partial.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
            partial.replace(target)
            print(f"{name} {work}: {entry['works'][work]}", file=sys.stderr, flush=True)
    return document


def measure(entry: dict[str, Any], kept: Kept, name: str, work: str, lpips: Distance | None) -> None:
    """Add a piece of work and the scores of its predictions to a recording's figures.

    Args:
        entry: of the recording.
        kept: what is done.
        name: of the recording.
        work: of ``PLAN``.
        lpips: distance of two pictures, or None.
    """
    filmed = kept.filmed(name)
    entry.setdefault("gaussians", len(filmed.splat))
    entry.setdefault("box_px", [filmed.camera.width, filmed.camera.height])
    tracks, facts = kept.predictions(name, work)
    for prediction, path in tracks.items():
        if "@" not in prediction and prediction not in entry["predictors"]:
            entry["predictors"][prediction] = scored(filmed, path, kept.settings, lpips)
    entry["works"][work] = facts


def scored(filmed: Filmed, tracks: Array, settings: Settings, lpips: Distance | None) -> dict[str, Any]:
    """Errors of the tracks on all held-out frames [m], and scores of the film on some frames of both parts.

    Args:
        filmed: the recording.
        tracks: of a prediction, (T, N, 3) [m].
        settings: which frames.
        lpips: distance of two pictures, or None.
    """
    training, held_out = judged(settings.frames, settings.held_out_every, settings.training_every)
    errors = errors_of(filmed.recording.scene, {"it": tracks})
    return {
        **{metric: errors[metric]["it"] for metric in METRICS},
        "held_out": filmed.compared(tracks, held_out, lpips),
        "training": filmed.compared(tracks, training, lpips),
    }


def report(document: dict[str, Any]) -> Report:
    """A row for every recording and prediction, and why others are not there."""
    rows, reasons, sizes = [], [], []
    for name, entry in document["recordings"].items():
        for prediction in (one for one in LABELS if one in entry["predictors"]):
            of = entry["predictors"][prediction]
            rows.append(
                [
                    name, LABELS[prediction], f"{1e3 * of['track_m']:.3g}",
                    *(_shown(score, of["held_out"][score]) for score in SCORES),
                    *(_shown(score, of["training"][score]) for score in ("psnr_db", "iou")),
                ]
            )  # fmt: skip
        reasons += [
            f"{name} {work} ({of['reason']})" for work, of in entry["works"].items() if "reason" in of
        ]
        width, height = entry["box_px"]
        sizes.append(f"{name} {entry['gaussians']} Gaussians, {width} × {height} px")
    missing = [
        f"{name} {work}"
        for name, works in SCENES.items()
        for work in works
        if work not in document["recordings"].get(name, {"works": {}})["works"]
    ]
    return Report(
        name="paper.images",
        title="Films of predictions",
        figures=document,
        header=["recording", "prediction", "track, mm", "PSNR, dB", "SSIM", "LPIPS", "IoU, %", "PSNR, training",
                "IoU, training"],
        rows=rows,
        notes=[
            "Held-out frames, the last 30 %, but for the last two columns. The row of the true motion says what the "
            "splat and its skinning lose: no prediction is to be expected above it.",
            "Tracks are exact: 80 material points spread over the surface. All films carry the same splat of the first "
            "frame, fitted to three cameras, by these points. Compared is the object in front of white as the first "
            "camera shows it, in the box that holds it in all frames with a margin; LPIPS by AlexNet.",
            f"{'; '.join(sizes)}.",
            f"One seed, small budgets for all: {document['settings']}.",
            f"Failed: {'; '.join(reasons) or 'nothing'}. Not run: {'; '.join(missing) or 'nothing'}.",
        ],
        machine=document["machine"],
    )  # fmt: skip


def in_words(settings: Settings) -> str:
    """The budgets as a reader wants them."""
    of = settings
    return (
        f"{of.frames} frames at 30 a second, every {of.held_out_every}rd held-out and every {of.training_every}th "
        f"training frame compared; twins of {of.fit.particle_budget} particles, at most {of.fit.max_simulations} "
        f"simulations; networks of hidden {SMALL.hidden}, {SMALL.message_passing_steps} steps, {SMALL.vertices} "
        f"vertices; {of.episodes} demonstrations, {of.training.steps} optimiser steps, {of.tuning.steps} of Φ, "
        f"{of.alone.steps} for the network without a prior; springs of about {of.springs.points} points, CMA-ES of "
        f"{of.springs.population} × {of.springs.generations}, {of.springs.epochs} descents; fields of "
        f"{of.local.modes} modes, {of.local.iterations} steps of BFGS; splats of {of.splat.steps} steps, at most "
        f"{of.splat.most} Gaussians"
    )


def _shown(score: str, value: float | None) -> str:
    if value is None:
        return "–"
    return {"psnr_db": f"{value:.2f}", "ssim": f"{value:.3f}", "lpips": f"{value:.3f}"}.get(
        score, f"{100.0 * value:.1f}"
    )


if __name__ == "__main__":
    sys.exit(main())
