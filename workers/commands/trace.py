"""``python -m physworld_workers.commands.trace SCENE --out report.json``: trace a recording's residual to a named
effect.

Several recordings of one object are fitted together (``trace A B``); those after ``--held-out`` are only predicted, for
the report. The tracks and the page are those of the first recording; with several, the tracks of the k-th (those that
are held out last) lie beside them as ``before_k`` and ``after_k``, k from 0.

The report is :func:`physworld.trace.document`; ``--predictions FILE`` keeps the open-loop tracks before and after,
``--html FILE`` shows all of it as one self-contained page.
Simulations run in two processes unless ``--processes`` says otherwise; ``--resume DIR`` keeps every simulation there,
so that the same command goes on where an earlier one was cut off. Ctrl-C cancels; nothing is written before the end.
After ``--time-limit`` minutes searches are left and the answer is made of what there is; the report says which.
"""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from physworld_workers.commands.arguments import count_of, metres, minutes

PROCESSES = 2
MINUTES = 10.0


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, trace, write."""
    given = _parser().parse_args(arguments)
    from physworld_workers.commands.terminal import NOTHING_WRITTEN, guarded

    def left() -> str:
        if given.resume is None or not given.resume.exists():
            return NOTHING_WRITTEN
        return f"no figures were written; what {given.resume} holds is kept, and the same command goes on from it"

    return guarded(lambda: _trace(given), left)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="physworld trace", description="Trace what a calibrated twin leaves to an effect that it lacks."
    )
    parser.add_argument(
        "scenes",
        metavar="SCENE",
        type=Path,
        nargs="+",
        help="folder, archive, final_data.pkl or C3D file; several: recordings of one object",
    )
    parser.add_argument(
        "--held-out", type=Path, nargs="+", default=[], metavar="SCENE", help="recordings for the report only"
    )
    parser.add_argument("--out", type=Path, default=None, help="write the report to this file")
    parser.add_argument("--predictions", type=Path, default=None, help="npz with the tracks before and after")
    parser.add_argument("--html", type=Path, default=None, help="write the report as a page to this file")
    parser.add_argument("--particles", type=count_of, default=None, help="particles of the twin, about")
    parser.add_argument(
        "--mesh",
        default=None,
        help="of a sheet: the mesh of triangles that recorded it, such as 16x15 or 16x15odd",
    )
    parser.add_argument("--processes", type=count_of, default=PROCESSES, help="processes that simulate")
    parser.add_argument(
        "--time-limit",
        type=minutes,
        default=MINUTES,
        metavar="MINUTES",
        help="after about so long searches are left and the answer is made of what there is; 0: never",
    )
    parser.add_argument(
        "--noise",
        type=metres,
        default=None,
        metavar="METRES",
        help="deviation per axis to take for the noise: how well the experiment repeats, say",
    )
    parser.add_argument("--resume", type=Path, default=None, help="folder that remembers every simulation")
    return parser


def _trace(given: argparse.Namespace) -> None:
    import warp as wp

    wp.config.quiet = True  # before the first import that starts it
    import numpy as np

    from physworld.engine.thin.triangles import Mesh
    from physworld.estimation.simulations import in_turn
    from physworld.report import render
    from physworld.trace import Memory, TraceConfig, Workers, document, trace
    from physworld_workers.commands.steps import journal_in
    from physworld_workers.commands.terminal import progress_bar, read_scene

    scenes = [read_scene(path) for path in given.scenes]
    held_out = [read_scene(path) for path in given.held_out]
    scene = scenes[0]
    config = TraceConfig(time_limit_s=60.0 * given.time_limit or None, noise_m=given.noise)
    if given.particles is not None:
        config = replace(config, calibration=replace(config.calibration, particle_budget=given.particles))
    if given.mesh is not None:
        config = replace(config, calibration=replace(config.calibration, mesh=Mesh.read(given.mesh)))
    memory = journal = None
    if given.resume is not None:
        memory = Memory(given.resume / "simulations")
        journal = journal_in(
            given.resume / "calibration.json",
            scene,
            f"{config.calibration}{given.noise or ''}",
        )
    pool = Workers(given.processes) if given.processes > 1 else nullcontext(in_turn)
    with progress_bar(f"trace {scene.name}") as shown, pool as runner:
        result = trace(
            scenes,
            config,
            held_out=held_out,
            runner=runner,
            memory=memory,
            journal=journal,
            progress=shown,
        )
    report = document(result)
    _print(report)
    if given.predictions is not None:
        given.predictions.parent.mkdir(parents=True, exist_ok=True)
        with given.predictions.open("wb") as file:
            several = result.recordings if len(result.recordings) > 1 else ()
            tracks = {f"before_{k}": known.before for k, known in enumerate(several)}
            tracks |= {f"after_{k}": known.after for k, known in enumerate(several)}
            np.savez(file, allow_pickle=False, before=result.before, after=result.after, **tracks)
    if given.html is not None:
        given.html.parent.mkdir(parents=True, exist_ok=True)
        given.html.write_text(render(report, scene, result.before, result.after), encoding="utf-8")
    if given.out is not None:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n")


def _print(report: dict[str, Any]) -> None:
    print(f"{report['verdict']}: {report['reason']}")
    for title in ("effects", "equivalent"):
        for effect in report[title]:
            for name, number in effect["parameters"].items():
                interval = number["ci95"]
                shown = "" if interval is None else f"  [{interval[0]:.4g}, {interval[1]:.4g}]"
                print(
                    f"  {title:<11} {effect['name']:<24} {name:<22} {number['value']:.4g} {number['unit']}{shown}"
                )
    held_out = report["held_out"]
    floor = held_out["noise_floor"]
    print(
        f"held-out error [mm]: before {1e3 * held_out['before']:.4g}, after {1e3 * held_out['after']:.4g}"
        + ("" if floor is None else f", noise {1e3 * floor:.4g}")
    )
    for known in report["recordings"] if len(report["recordings"]) > 1 else ():
        print(
            f"  {known['scene']:<20} {known['role']:<9} frames {known['frames'][0]} to {known['frames'][1]}: "
            f"before {1e3 * known['before']:.4g}, after {1e3 * known['after']:.4g}"
        )
    print(f"remains: {report['unexplained']['description']}")
    if report["suggested_experiment"] is not None:
        print(f"next: {report['suggested_experiment']['description']}")
    print(f"{report['simulations']} simulations, {report['seconds']:.0f} s")


if __name__ == "__main__":
    sys.exit(main())
