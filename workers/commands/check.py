"""``python -m physworld_workers.commands.check SCENE --json check.json``: what a recording can show before any fit.

Prints two tables: of every number that a calibration would search its expected 95 % interval, and of every effect of
the registry the smallest strength that would be detected, each for a twin that is right and for one that is off by a
share of the motion; then what looks alike, and a further motion that shows more. ``--json FILE`` keeps all of it
(:func:`physworld.check.document`). Nothing is fitted.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

PROCESSES = 2
WORDS = {"visible": "visible", "only_if_large": "only if large", "invisible": "invisible"}


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, check, write."""
    given = _parser().parse_args(arguments)
    from physworld_workers.commands.terminal import guarded

    return guarded(lambda: _check(given))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="physworld check", description="Say what a recording can show before anything is fitted."
    )
    parser.add_argument(
        "scene", metavar="SCENE", type=Path, help="folder, archive, final_data.pkl or C3D file"
    )
    parser.add_argument("--json", type=Path, default=None, help="write all figures to this file")
    parser.add_argument(
        "--noise", type=float, default=None, metavar="METRES", help="deviation per axis to take for the noise"
    )
    parser.add_argument(
        "--discrepancy",
        type=float,
        default=None,
        metavar="SHARE",
        help="how far a calibrated twin is assumed to be off, over the motion's extent",
    )
    parser.add_argument(
        "--value",
        type=_value,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a calibrated number that is known better than its prior, in SI units; may be repeated",
    )
    parser.add_argument("--particles", type=int, default=None, help="particles of the twin, about")
    parser.add_argument("--motions", type=int, default=None, help="motions that are tried; 0: none")
    parser.add_argument("--processes", type=int, default=PROCESSES, help="processes that simulate")
    return parser


def _value(text: str) -> tuple[str, float]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=VALUE")
    return name, float(value)


def _check(given: argparse.Namespace) -> None:
    import warp as wp

    wp.config.quiet = True  # before the first import that starts it
    from dataclasses import replace

    from physworld.check import CheckConfig, check, document
    from physworld.estimation.simulations import Workers, in_turn
    from physworld_workers.commands.terminal import progress_bar, read_scene
    from physworld_workers.tasks.check import worded

    scene = read_scene(given.scene)
    config = CheckConfig(noise_m=given.noise, values=dict(given.value))
    if given.discrepancy is not None:
        config = replace(config, discrepancy_share=given.discrepancy)
    if given.motions is not None:
        config = replace(config, motions=given.motions)
    if given.particles is not None:
        config = replace(config, calibration=replace(config.calibration, particle_budget=given.particles))
    pool = Workers(given.processes) if given.processes > 1 else nullcontext(in_turn)
    with progress_bar(f"check {scene.name}") as shown, pool as runner:
        report = worded(document(check(scene, config, runner=runner, progress=shown)))
    _print(report)
    if given.json is not None:
        given.json.parent.mkdir(parents=True, exist_ok=True)
        given.json.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n")


def _print(report: dict[str, Any]) -> None:
    right, usual = report["views"]
    print(
        f"{report['scene']}: {report['law']} in the {report['formulation']} form; noise of "
        f"{1e3 * report['noise_m']:.3g} mm per axis ({report['noise_is']}), {report['frames']} frames, points that "
        f"move by {1e3 * report['motion_m']:.3g} mm. Twin off: by {100 * usual['discrepancy_share']:.3g} % of that, "
        f"{1e3 * usual['discrepancy_m']:.3g} mm."
    )
    rows: list[tuple[str, ...]] = [
        ("parameter", "value", "known before", "expected, twin right", "expected, twin off", "narrower by")
    ]
    for best, worse in zip(right["parameters"], usual["parameters"], strict=True):
        name = f"{worse['name']} [{worse['unit']}]" + ("*" if worse["optional"] else "")
        value = f"{worse['value']:.4g}" + ("" if worse["value_is"] == "prior" else " (given)")
        spans = (worse["prior95"], best["expected95"], worse["expected95"])
        rows.append(
            (name, value, *(f"{low:.3g} to {high:.3g}" for low, high in spans), f"{1 / worse['ratio']:.3g}")
        )
    _table(rows)
    if any(known["optional"] for known in usual["parameters"]):
        print("* freed by a fit only where the data ask for it; to a trace an effect")
    rows = [("effect", "twin right", "twin off", "detected from: right / off (plausible)")]
    for best, worse in zip(right["effects"], usual["effects"], strict=True):
        label = worse["label"]
        if worse["shapes"] > 1:
            label += f" ({worse['visible_shapes']} of {worse['shapes']} shapes)"
        sizes = [
            f"{gate['name']} {_size(gate['detectable'])} / {_size(other['detectable'])} ({gate['plausible']:.3g})"
            for gate, other in zip(best["gates"], worse["gates"], strict=True)
        ]
        hidden = f"; hidden by {', '.join(worse['hidden_by'])}" if worse["hidden_by"] else ""
        rows.append((label, WORDS[best["status"]], WORDS[worse["status"]], ", ".join(sizes) + hidden))
    _table(rows)
    for group in usual["groups"]:
        print(f"not told apart at plausible sizes: {', '.join(group)}")
    for pair in usual["pairs"]:
        print(f"alike: {' and '.join(pair['labels'])} (correlation {pair['correlation']:.3f})")
    if report["proposal"] is not None:
        print(f"next: {report['proposal']['description']}")
    print(f"{report['simulations']} simulations, {report['seconds']:.0f} s")


def _size(value: float | None) -> str:
    return "never" if value is None else f"{value:.3g}"


def _table(rows: Sequence[tuple[str, ...]]) -> None:
    """Columns as wide as their widest cell, the first row as heading."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    print()
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


if __name__ == "__main__":
    sys.exit(main())
