"""``python -m physworld_workers.commands.fit SCENE --json FILE``: calibrate a twin in this process and measure it.

Several recordings of one object (``fit A B``) have one material. The figures at the top are the first one's;
``recordings`` has the errors of each, and ``agreement`` how far each one's own optimum lies off the common one.

The figures are those of :func:`fit_document`; ``--out DIR`` also keeps the twin and its prediction, the files of
the service's fit. Ctrl-C cancels; nothing is written before the end but the finished steps, in the file of
``--resume``, from which the next call goes on.

``--law auto`` chooses the law first: by the model behind PHYSWORLD_LAW_URL where one is set (see
:mod:`physworld_workers.law_endpoint`), else by cross-validation.
"""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from physworld_workers.commands.arguments import count_of

SCHEMA_VERSION = 1


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, fit, write."""
    given = _parser().parse_args(arguments)
    from physworld_workers.commands.terminal import guarded

    return guarded(lambda: _fit(given), lambda: _kept(given.resume))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="physworld fit", description="Calibrate a twin of a recording.")
    parser.add_argument(
        "scenes",
        metavar="SCENE",
        type=Path,
        nargs="+",
        help="folder, archive, final_data.pkl or C3D file; several: recordings of one object",
    )
    parser.add_argument("--json", type=Path, default=None, help="write the figures to this file")
    parser.add_argument("--out", type=Path, default=None, help="folder for the twin and its prediction")
    parser.add_argument("--particles", type=count_of, default=None, help="particles of the twin, about")
    parser.add_argument("--simulations", type=count_of, default=None, help="most simulations of the search")
    parser.add_argument("--law", default=None, help="elastic law by name, or auto: choose it by the data")
    parser.add_argument("--plasticity", default=None, help="flow law by name; its yield is calibrated too")
    parser.add_argument(
        "--formulation", default="auto", help="total_lagrangian, updated_lagrangian, discrete_rod or auto"
    )
    parser.add_argument("--transfer", default="apic", help="of the updated Lagrangian form: apic or asflip")
    parser.add_argument(
        "--mesh",
        default=None,
        help="of a sheet: the mesh of triangles that recorded it, such as 16x15 or 16x15odd",
    )
    parser.add_argument(
        "--stages", default="global", help="global, or global+local: a field on top if it holds"
    )
    parser.add_argument("--processes", type=count_of, default=1, help="processes that share the simulations")
    parser.add_argument(
        "--resume",
        type=Path,
        default=None,
        help="file of finished steps: a fit that was ended goes on from it",
    )
    parser.add_argument(
        "--quick", action="store_true", help="leave out the runs on finer cells and time steps"
    )
    return parser


def _fit(given: argparse.Namespace) -> None:
    import warp as wp

    wp.config.quiet = True  # before the first import that starts it
    from physworld.calibrate import CalibrationConfig, calibrate_in_stages
    from physworld.engine.thin.triangles import Mesh
    from physworld.estimation.simulations import Workers, in_turn
    from physworld_workers.commands.steps import journal_in
    from physworld_workers.commands.terminal import progress_bar, read_scene
    from physworld_workers.law_choice import AUTO, chosen_laws
    from physworld_workers.tasks.fit_accuracy import fit_accuracy, not_measured
    from physworld_workers.tasks.fit_report import fit_files, fit_report

    _refuse_places(given)
    scenes = [read_scene(path) for path in given.scenes]
    scene = scenes[0]
    numbers = {"particle_budget": given.particles, "max_simulations": given.simulations}
    config = CalibrationConfig(
        **{name: value for name, value in numbers.items() if value is not None},
        formulation=given.formulation,
        transfer=given.transfer,
        plasticity=given.plasticity,
        mesh=None if given.mesh is None else Mesh.read(given.mesh),
    )
    settings = f"{given.law} {config}"
    journal = None if given.resume is None else journal_in(given.resume, scenes, settings)
    with Workers(given.processes) if given.processes > 1 else nullcontext(in_turn) as runner:
        with progress_bar(f"law {scene.name}") if given.law == AUTO else nullcontext() as shown:
            config, choice = chosen_laws(given.law, scene, config, shown, journal=journal, runner=runner)
        with progress_bar(f"fit {scene.name}") as shown:
            fitted = calibrate_in_stages(
                scenes, config, given.stages, progress=shown, journal=journal, runner=runner
            )
        accuracy = not_measured("left out by --quick")
        if not given.quick:
            with progress_bar(f"numerics {scene.name}") as shown:
                accuracy = fit_accuracy(
                    scene, fitted, config.particle_budget, shown, journal=journal, runner=runner
                )
    report = fit_report(scene, fitted, choice, accuracy)
    document = fit_document(scene.name, report)
    _print(document)
    if given.out is not None:
        given.out.mkdir(parents=True, exist_ok=True)
        for name, content in fit_files(scene, fitted, report).items():
            (given.out / name).write_bytes(content)
    if given.json is not None:
        given.json.parent.mkdir(parents=True, exist_ok=True)
        given.json.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n")


def _refuse_places(given: argparse.Namespace) -> None:
    """Whether the answer can be written where it is asked for, before hours are spent on it. Raises OSError."""
    if given.out is not None and given.out.exists() and not given.out.is_dir():
        raise NotADirectoryError(f"--out {given.out} is a file")
    if given.json is not None and given.json.is_dir():
        raise IsADirectoryError(f"--json {given.json} is a folder")


def _kept(path: Path | None) -> str:
    """What an interrupted fit leaves behind."""
    from physworld_workers.commands.terminal import NOTHING_WRITTEN

    if path is None or not path.exists():
        return NOTHING_WRITTEN
    return f"no figures were written; the steps in {path} are kept, and the same command goes on from them"


def fit_document(scene_name: str, report: dict[str, Any]) -> dict[str, Any]:
    """The machine-readable answer: the report's figures under stable keys at the top."""
    return {
        "schema_version": SCHEMA_VERSION,
        "scene": scene_name,
        "parameters": report["parameters"],
        **report["metrics"],
        "notes": report["notes"],
    }


def _print(document: dict[str, Any]) -> None:
    for name, parameter in document["parameters"].items():
        interval = parameter["ci95"]
        shown = "" if interval is None else f"  [{interval[0]:.5g}, {interval[1]:.5g}]"
        note = "" if parameter["identified"] and not parameter["note"] else f"  ({parameter['note']})"
        print(f"{name:<26} {parameter['value']:.5g} {parameter['unit']}{shown}{note}")
    held_out = document["held_out"]
    floor = held_out["noise_floor_m"]
    print(f"held-out track error [mm]{'' if floor is None else f', noise floor {1e3 * floor:.4g}'}:")
    for name, error in sorted(held_out["track_m"].items(), key=lambda item: item[1] or 0.0):
        print(f"  {name:<20} {'-' if error is None else format(1e3 * error, '.4g')}")
    for known in document["recordings"]:
        error, left = known["held_out"]["track_m"]["twin"], known["training"]["rms_m"]
        shown = "-" if error is None else format(1e3 * error, ".4g")
        print(f"  {known['scene']:<20} twin {shown}, training frames {1e3 * left:.4g} (rms)")
    for known in document["agreement"]:
        _print_agreement(known)
    if document["local"] is not None:
        print(f"field over the body: {document['local']['reason']}")
    law, numerics = document["law"], document["numerics"]
    print(f"laws {law['elastic']} and {law['plastic']}, decided by {law['decided_by']}: {law['reason']}")
    if numerics is not None:
        drag, cells = numerics["equivalent_drag_per_s"], numerics["finer_cells_m"]
        print(
            f"the engine's own damping: a drag of {drag:.3g} 1/s; finer cells move points by {1e3 * cells:.3g} mm"
        )
    if document["not_measured"]:
        print(f"not measured: {document['not_measured']}")
    for name, why in document["search"]["open"].items():
        print(f"{name} is not converged: {why}")
    for name, parameter in (document["converged"] or {}).items():
        interval = parameter["ci95"]
        shown = "" if interval is None else f" [{interval[0]:.5g}, {interval[1]:.5g}]"
        print(f"{name} without the lattice's error: {parameter['value']:.5g} {parameter['unit']}{shown}")
    print(f"{document['simulations']} simulations, {document['seconds']:.0f} s")


def _print_agreement(known: dict[str, Any]) -> None:
    """What every recording alone would say of a number, where it says anything."""
    each = [
        f"{one['scene']} {one['value']:.5g} ({one['shift_in_deviations']:+.1f} deviations)"
        for one in known["recordings"]
        if one["value"] is not None
    ]
    said = "recordings agree on" if known["agrees"] else "RECORDINGS DISAGREE ON"
    if each:
        print(f"{said} {known['parameter']} {known['value']:.5g} {known['unit']}: {', '.join(each)}")


if __name__ == "__main__":
    sys.exit(main())
