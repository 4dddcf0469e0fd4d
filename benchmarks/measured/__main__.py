"""``python -m benchmarks.measured --json FILE``: every recording of a folder, the default twin beside its rivals.

``--set DIR`` is any folder of scenes (folders with a ``scene.json``, or archives); without it the recordings that lie
beside the repository. Each is calibrated as ``physworld fit`` does, scored with every predictor
(:mod:`benchmarks.measured.scoring`), and written to the JSON at once. ``--transfer A:B,C`` predicts B and C with the
material of A, and may be repeated. ``--resume FILE`` takes over what an earlier JSON has of the same data, settings,
engine and predictors; a fit that was cut off goes on from its steps beside the JSON. Nothing here ends the others: a
predictor that fails on a recording is null there, with its reason.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import warp as wp

from benchmarks.harness import describe_machine, write_section
from benchmarks.measured.page import report
from benchmarks.measured.recording import key_of, measure, transfer, twin_file
from benchmarks.measured.scoring import FAILURES, words
from physworld.calibrate import CalibrationConfig
from physworld.scene import Scene
from physworld_workers.commands.terminal import read_scene

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "real"
SHARED_PAIRS = (
    "beam_free_a:beam_free_b,beam_load52", "rope_a_ring:rope_a_whip", "noodle_gentle:noodle_hard",
    "cloth_swing:cloth_carry",
)  # fmt: skip
SCHEMA_VERSION = 1


def main(arguments: list[str] | None = None) -> int:
    """Measure what was chosen, write, print."""
    given = _parser().parse_args(arguments)
    wp.config.quiet = True
    folder = given.set or SHARED
    if not folder.is_dir():
        print(f"nothing measured: there are no recordings at {folder}; --set names a folder", file=sys.stderr)
        return 2
    paths = {
        path.name if path.is_dir() else path.stem: path
        for path in sorted(folder.iterdir())
        if (path / "scene.json").exists() or path.suffix in (".zip", ".tar", ".gz", ".tgz")
    }
    unknown = sorted(set(given.only or ()) - set(paths))
    if unknown or not paths:
        print(f"no recordings {unknown} in {folder}; there are {sorted(paths)}", file=sys.stderr)
        return 2
    pairs = pairs_of(given.transfer if given.transfer is not None else () if given.set else SHARED_PAIRS)
    numbers = {"particle_budget": given.particles, "max_simulations": given.simulations}
    config = CalibrationConfig(**{name: value for name, value in numbers.items() if value is not None})
    document = run(
        {name: paths[name] for name in given.only or paths}, pairs, config, given.json, given.resume
    )
    shown = report(document)
    print(shown.markdown())
    if given.docs is not None:
        write_section(shown, given.docs)
    return 0


def run(
    paths: dict[str, Path],
    pairs: dict[str, list[str]],
    config: CalibrationConfig,
    target: Path,
    resume: Path | None,
) -> dict[str, Any]:
    """Measure every recording and every pair, and keep ``target`` current after each.

    Args:
        paths: recordings by name.
        pairs: from the name of the recording whose material is taken to those that it predicts.
        config: of every calibration.
        target: JSON file; steps and twins of the fits lie beside it (beside ``resume``), in a folder of its name.
        resume: JSON of an earlier run, or None.
    """
    earlier: dict[str, Any] = json.loads(resume.read_text()) if resume is not None and resume.exists() else {}
    steps = (resume or target).with_suffix(".steps")
    steps.mkdir(parents=True, exist_ok=True)
    document: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "machine": describe_machine(),
        "settings": {"particle_budget": config.particle_budget, "max_simulations": config.max_simulations},
        "recordings": {n: e for n, e in earlier.get("recordings", {}).items() if n not in paths},
        "transfers": {n: e for n, e in earlier.get("transfers", {}).items() if n.split("->")[0] not in paths},
    }
    scenes: dict[str, Scene] = {}
    for place, (name, path) in enumerate(paths.items(), 1):
        head = f"{place}/{len(paths)} {name}"
        try:
            scenes[name] = read_scene(path)
        except FAILURES as error:
            document["recordings"][name] = {
                "track_m": {},
                "reason": {"scene": words(error)},
            }
            say(f"{head}: {error}")
            continue
        known = earlier.get("recordings", {}).get(name, {})
        finished = known.get("key") == key_of(scenes[name], config) and "twin" not in known["reason"]
        if finished and twin_file(steps, name).exists():
            document["recordings"][name] = known
            say(f"{head}: taken over from {resume}")
        else:
            say(f"{head}: begun")
            document["recordings"][name] = measure(name, scenes[name], config, steps)
            say(f"{head}: {_words(document['recordings'][name])}")
        _write(document, target)
    for source, goals in pairs.items():
        for goal in goals:
            if goal not in scenes or source not in scenes:
                continue
            say(f"{source} -> {goal}: begun")
            begun = time.perf_counter()
            own = document["recordings"][goal]["track_m"]
            found = transfer(scenes[source], twin_file(steps, source), scenes[goal], config, own)
            document["transfers"][f"{source}->{goal}"] = {**found, "seconds": time.perf_counter() - begun}
            _write(document, target)
    _write(document, target)
    return document


def pairs_of(options: tuple[str, ...] | list[str]) -> dict[str, list[str]]:
    """Of ``A:B,C`` the names: A to [B, C]. Raises ValueError for another form."""
    pairs: dict[str, list[str]] = {}
    for option in options:
        source, colon, goals = option.partition(":")
        if not (source and colon and goals):
            raise ValueError(f"--transfer {option}: of the form A:B,C")
        pairs.setdefault(source, []).extend(goal for goal in goals.split(",") if goal)
    return pairs


def say(line: str) -> None:
    """A line of progress."""
    print(f"{time.strftime('%H:%M:%S')} {line}", file=sys.stderr, flush=True)


def _words(entry: dict[str, Any]) -> str:
    track = ", ".join(
        f"{name} {'-' if value is None else f'{1e3 * value:.3g}'}" for name, value in entry["track_m"].items()
    )
    failed = "".join(f"; no {name}: {why}" for name, why in entry["reason"].items())
    return f"{entry['seconds']:.0f} s, {entry['simulations']} simulations, held out [mm] {track}{failed}"


def _write(document: dict[str, Any], target: Path) -> None:
    partial = target.with_name(f"{target.name}.part")
    partial.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n")
    partial.replace(target)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.measured", description=__doc__)
    parser.add_argument(
        "--set", type=Path, default=None, help="folder of scenes; default: the shared recordings"
    )
    parser.add_argument("--only", nargs="*", default=None, help="names of the recordings to measure")
    parser.add_argument("--json", type=Path, required=True, help="write all figures there")
    parser.add_argument("--resume", type=Path, default=None, help="JSON of an earlier run, to go on from")
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    parser.add_argument(
        "--transfer", action="append", default=None, help="A:B,C: predict B and C with A's material"
    )
    parser.add_argument("--particles", type=int, default=None, help="particles of a twin, about")
    parser.add_argument("--simulations", type=int, default=None, help="most simulations of a search")
    return parser


if __name__ == "__main__":
    sys.exit(main())
