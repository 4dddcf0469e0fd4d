"""``python -m benchmarks.measured.springs --json FILE [--docs docs/measured.md]``: fitted spring–mass networks.

The spring–mass twin as PhysTwin's and the system as Spring-Gaus's, fitted to the training frames of the sample and of
four measured recordings, beside the default twin, the peers that have a word for the object, and rigid following: track
and Chamfer errors on the held-out frames, the time that each fit took, and how fast each predicts. A pair of recording
and predictor is written to the JSON as soon as it is there and not done again; a twin's search that was cut off goes
on. Recordings that are not on this machine are left out.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import warp as wp

from benchmarks.harness import Report, describe_machine, write_section
from benchmarks.measured import scoring
from benchmarks.measured.__main__ import SHARED, say
from benchmarks.measured.kept import fitted
from benchmarks.measured.page import mm
from benchmarks.measured.recording import fit_twin, key_of
from physworld.baselines.spring_fit import SpringModel, SpringSettings
from physworld.calibrate import CalibrationConfig
from physworld.scene import Scene
from physworld_scenes.bundle import read_bundle

SAMPLE = Path(__file__).resolve().parents[2] / "sample" / "soft_beam"
RECORDINGS = ("rope_b_shake", "rope_a_ring", "cloth_swing", "beam_free_a")
TWIN = "twin"
PREDICTORS = (TWIN, "phystwin", "spring_gaus", "elastic_rod", "linear_cloth", "rigid_follow")
METRICS = {"track_m": "track", "chamfer_phystwin_m": "Chamfer PhysTwin", "chamfer_l2_m": "Chamfer L2"}
FRAME_S = 1.0 / 30.0


def main() -> int:
    """Measure what is missing, write, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.measured.springs", description=__doc__)
    parser.add_argument("--json", type=Path, required=True, help="all figures; what it has is not done again")
    parser.add_argument(
        "--resume", type=Path, default=None, help="take over what another JSON has of the same"
    )
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    parser.add_argument("--set", type=Path, default=SHARED, help="folder of the recordings")
    parser.add_argument("--only", nargs="*", default=None, help="names of the recordings to measure")
    parser.add_argument("--predictors", nargs="*", choices=PREDICTORS, default=PREDICTORS)
    given = parser.parse_args()
    wp.config.quiet = True
    places = {SAMPLE.name: SAMPLE} | {name: given.set / name for name in RECORDINGS}
    document: dict[str, Any] = json.loads(given.json.read_text()) if given.json.exists() else {}
    other = json.loads(given.resume.read_text())["recordings"] if given.resume is not None else {}
    document.setdefault("machine", describe_machine())
    document.setdefault("recordings", {})
    steps = given.json.with_suffix(".steps")
    steps.mkdir(parents=True, exist_ok=True)
    for name, path in places.items():
        if given.only is not None and name not in given.only:
            continue
        if not (path / "scene.json").exists():
            print(f"{name}: left out, {path} is not on this machine", file=sys.stderr)
            continue
        scene, config = read_bundle(path), CalibrationConfig()
        key = f"{key_of(scene, config)} {SpringSettings()}"
        if document["recordings"].get(name, {}).get("key") != key:
            document["recordings"][name] = {"key": key, "kind": scene.kind, "predictors": {}}
        found = document["recordings"][name]["predictors"]
        if other.get(name, {}).get("key") == key:
            found.update({who: of for who, of in other[name]["predictors"].items() if who not in found})
        for predictor in (one for one in given.predictors if one not in found):
            say(f"{name} {predictor}: begun")
            found[predictor] = measure(predictor, name, scene, config, steps)
            say(f"{name} {predictor}: {found[predictor]}")
            _write(document, given.json)
        _write(document, given.json)
    shown = report(document)
    print(shown.markdown())
    if given.docs is not None:
        write_section(shown, given.docs)
    return 0


def _write(document: dict[str, Any], target: Path) -> None:
    partial = target.with_suffix(".part")
    partial.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n")
    partial.replace(target)


def measure(
    predictor: str, name: str, scene: Scene, config: CalibrationConfig, steps: Path
) -> dict[str, Any]:
    """One predictor on one recording: errors on the held-out frames [m], seconds of its fit, frames a second.

    A frame is 1/30 s of the recording, whatever its own rate. ``reason`` says why there are none.
    """
    begun = time.perf_counter()
    failure: str | None = None
    fit: dict[str, Any] = {}
    if predictor == TWIN:
        twin, failure = fit_twin(name, scene, config, steps)
        if twin is None:
            return {"reason": failure}
        fit = {"fit_s": twin.seconds, "simulations": twin.simulations}
        settled = twin.twin

        def model(of: Scene) -> Any:
            return scoring.tracks_of(settled, of)
    else:
        try:
            model = fitted(predictor, scoring.fits().get(predictor) or scoring.PEERS[predictor], scene, steps)
        except scoring.FAILURES as error:
            return {"reason": scoring.words(error)}
        fit = {"fit_s": time.perf_counter() - begun, "simulations": None}
        if isinstance(model, SpringModel):
            fit = {
                "fit_s": model.seconds,
                "simulations": model.simulations,
                "points": model.points,
                "springs": len(model.springs.pairs),
                "training_m": model.loss_m,
                "training_of_global_numbers_m": model.started_m,
            }
    begun = time.perf_counter()
    tracks, failure = scoring.attempt(lambda: model(scene), scene)
    spent = time.perf_counter() - begun
    if tracks is None:
        return {"reason": failure, **fit}
    errors = scoring.held_out(scene, {predictor: tracks})
    span = float(scene.times[-1] - scene.times[0])
    return {
        "reason": None,
        **{metric: errors[metric][predictor] for metric in METRICS},
        **fit,
        "frames_per_second": span / FRAME_S / spent,
    }


def report(document: dict[str, Any]) -> Report:
    """A row for every recording and predictor, and why others are not there."""
    rows, reasons, notes = [], [], []
    for name, recording in document["recordings"].items():
        known = {who: of for who, of in recording["predictors"].items() if of["reason"] is None}
        least = {metric: min(of[metric] for of in known.values()) for metric in METRICS} if known else {}
        for who in (one for one in PREDICTORS if one in known):
            of = known[who]
            errors = [
                f"**{mm(of[metric])}**" if of[metric] == least[metric] else mm(of[metric])
                for metric in METRICS
            ]
            simulations = "" if of["simulations"] is None else f"{of['simulations']}"
            rows.append(
                [name, who.replace("_", " "), *errors, f"{of['fit_s']:.3g}", simulations,
                 f"{of['frames_per_second']:.3g}"]
            )  # fmt: skip
            if "springs" in of:
                notes.append(
                    f"{name} {who} {of['points']} points, {of['springs']} springs: "
                    f"{mm(of['training_of_global_numbers_m'])} → {mm(of['training_m'])}"
                )
        reasons += [
            f"{name} {who} ({of['reason']})"
            for who, of in recording["predictors"].items()
            if of["reason"] is not None
        ]
    return Report(
        name="measured.springs",
        title="Fitted spring–mass networks",
        figures=document,
        header=["recording", "predictor", *METRICS.values(), "fit, s", "simulations", "frames/s"],
        rows=rows,
        notes=[
            "Errors [mm] on the held-out frames, in open loop from the first frame; the least is bold. All were fitted "
            "to the training frames alone, on one thread beside other loads, so that seconds are upper bounds and "
            "frames a second lower ones. A frame is 1/30 s of the recording.",
            f"Networks by {SpringSettings()}; the twin by the library's default.",
            f"Training error [mm] before and after the descent by gradient: {'; '.join(notes)}.",
            f"Not there: {'; '.join(reasons)}.",
        ],
        machine=document["machine"],
    )


if __name__ == "__main__":
    sys.exit(main())
