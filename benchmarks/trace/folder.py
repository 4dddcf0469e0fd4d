"""``python -m benchmarks.trace.folder --set DIR --json FILE``: trace every scene of a folder and score the answers.

Every scene is traced by the command ``physworld trace`` in a process of its own, which gets nothing but the scene: a
copy of its folder without the truth. Only this scorer opens ``truth.json``. It counts

- right: the effects that act are named, alone or in an equivalent set of at most two; where none acts none is named;
- strength: the found primary strength over the true one;
- removed: the share of the explainable held-out error that went, (before - after) / (before - floor), the floor being
  the noise.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.harness import Report, write_section

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
CLAIMS = ("named", "equivalent_set")
REGISTRY = {
    "linear_drag": ("air_drag_linear",),
    "quadratic_drag": ("air_drag_quadratic",),
    "internal_viscosity": ("viscosity_kelvin_voigt",),
    "kelvin_voigt": ("viscosity_kelvin_voigt",),
    "gravity_tilt": ("gravity_tilt",),
    "anisotropic_stiffness": ("anisotropy",),
    "fibre": ("anisotropy",),
    "control_lag": ("actuation_lag", "measurement_clock"),
    "tether": ("tether",),
}
PRIMARY = {"linear_drag": "c", "quadratic_drag": "k", "internal_viscosity": "eta", "kelvin_voigt": "eta",
           "gravity_tilt": "degrees", "anisotropic_stiffness": "modulus", "fibre": "modulus",
           "control_lag": "seconds", "tether": "k"}  # fmt: skip


def strength(effect: dict[str, Any]) -> float:
    """The primary strength of a found effect in the units of the truth."""
    values = {name: number["value"] for name, number in effect["parameters"].items()}
    first = {
        "air_drag_linear": "rate_per_s",
        "air_drag_quadratic": "coefficient_per_m",
        "gravity_tilt": "tilt_deg",
        "anisotropy": "fibre_modulus_pa",
        "viscosity_kelvin_voigt": "viscosity_pa_s",
        "actuation_lag": "lag_s",
        "measurement_clock": "offset_s",
        "tether": "stiffness_n_m",
    }
    return values.get(first.get(effect["name"], ""), float("nan"))


def score(report: dict[str, Any], truth: dict[str, Any]) -> dict[str, Any]:
    """What the answer is worth against the truth."""
    acting = sorted(truth["parameters"])
    claimed = report["verdict"] in CLAIMS
    found = report["effects"] if claimed else []
    others = report["equivalent"] if claimed else []
    names = [effect["name"] for effect in found]
    allowed = {name for effect in acting for name in REGISTRY[effect]}
    everything = {*names, *(effect["name"] for effect in others)}
    small = len(others) <= len(names)
    if acting:
        covered = all(everything & set(REGISTRY[effect]) for effect in acting)
        right = bool(covered and small and len(names) == len(acting))
    else:
        right = not claimed
    ratios = {}
    for effect in acting:
        matches = [e for e in [*found, *others] if e["name"] in REGISTRY[effect]]
        if matches:
            ratios[effect] = strength(matches[0]) / truth["parameters"][effect][PRIMARY[effect]]
    out = report["held_out"]
    return {
        "scene": report["scene"],
        "truth": " + ".join(acting) or "none",
        "truth_strength": truth["strength"],
        "verdict": report["verdict"],
        "named": names,
        "equivalent": [effect["name"] for effect in others],
        "right": right,
        "wrong_name": bool(claimed and not everything & allowed),
        "strength_ratio": ratios,
        "before_mm": 1e3 * out["before"],
        "after_mm": 1e3 * out["after"],
        "floor_mm": 1e3 * out["noise_floor"],
        "removed": out["explained_fraction"],
        "misfit_before": report["training"]["misfit_before"],
        "misfit_after": report["training"]["misfit_after"],
        "simulations": report["simulations"],
        "seconds": report["seconds"],
    }


def traced(
    scene: Path, folder: Path, resume: Path | None, processes: int, minutes: float | None = None
) -> dict[str, Any] | None:
    """The report of one scene; None where the command failed (it has said why).

    ``minutes``: its time limit; None for the command's own.
    """
    blind = folder / scene.name
    blind.mkdir()
    for name in ("scene.json", "scene.npz"):
        shutil.copy(scene / name, blind / name)
    out = folder / f"{scene.name}.json"
    command = [sys.executable, "-m", "physworld_workers.commands.trace", str(blind), "--out", str(out)]
    command += ["--predictions", str(folder / f"{scene.name}.npz"), "--processes", str(processes)]
    if minutes is not None:
        command += ["--time-limit", str(minutes)]
    if resume is not None:
        command += ["--resume", str(resume / scene.name)]
    done = subprocess.run(command, env={**os.environ, **ONE_THREAD}, check=False, stdout=subprocess.DEVNULL)
    return json.loads(out.read_text()) if done.returncode == 0 else None


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts over all scenes."""
    clear = [row for row in rows if row["truth_strength"] == "clear"]
    none = [row for row in rows if row["truth"] == "none"]
    ratios = [ratio for row in clear if row["right"] for ratio in row["strength_ratio"].values()]
    return {
        "scenes": len(rows),
        "right": sum(row["right"] for row in rows),
        "clear": len(clear),
        "clear_right": sum(row["right"] for row in clear),
        "false_names": sum(row["verdict"] in CLAIMS for row in none),
        "wrong_names": sum(row["wrong_name"] for row in rows),
        "strength_within_25_percent": sum(abs(ratio - 1.0) <= 0.25 for ratio in ratios),
        "strengths": len(ratios),
        "removed_70_percent": sum((row["removed"] or 0.0) >= 0.7 for row in clear),
        "longest_s": max((row["seconds"] for row in rows), default=0.0),
        "most_simulations": max((row["simulations"] for row in rows), default=0),
    }


def main() -> int:
    """Trace and score; 0 where every scene gave an answer."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.trace.folder", description=__doc__)
    parser.add_argument("--set", type=Path, required=True, help="folder of scenes with their truth")
    parser.add_argument(
        "--json", type=Path, default=None, help="figures; with --only, those of other scenes in it stay"
    )
    parser.add_argument("--only", nargs="*", default=[], help="names of scenes; none: all")
    parser.add_argument("--resume", type=Path, default=None, help="folder that remembers simulations")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--time-limit", type=float, default=None, help="minutes; as the command has it if left out"
    )
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    given = parser.parse_args()
    scenes = sorted(path.parent for path in given.set.glob("*/scene.json"))
    rows, failed = [], []
    with tempfile.TemporaryDirectory() as folder:
        for scene in scenes:
            if given.only and scene.name not in given.only:
                continue
            begun = time.perf_counter()
            report = traced(scene, Path(folder), given.resume, given.processes, given.time_limit)
            if report is None:
                failed.append(scene.name)
                continue
            row = score(report, json.loads((scene / "truth.json").read_text()))
            row["wall_s"] = time.perf_counter() - begun
            rows.append(row)
            print(json.dumps(row), flush=True)
    if given.only and given.json is not None and given.json.exists():
        known = json.loads(given.json.read_text())
        traced_now = {row["scene"] for row in rows} | set(failed)
        rows += [row for row in known["scenes"] if row["scene"] not in traced_now]
        failed += [name for name in known["failed"] if name not in traced_now]
        rows.sort(key=lambda row: row["scene"])
    found = summary(rows)
    print(json.dumps(found, indent=2))
    if given.json is not None:
        given.json.write_text(
            json.dumps({"scenes": rows, "summary": found, "failed": failed}, indent=2) + "\n"
        )
    if given.docs is not None:
        there = {row["scene"] for row in rows}
        write_section(_report(rows, found, [s.name for s in scenes if s.name not in there]), given.docs)
    return 1 if failed else 0


def _report(rows: list[dict[str, Any]], found: dict[str, Any], missing: list[str]) -> Report:
    header = ("scene", "acts", "verdict", "named (or)", "strength", "before", "after", "noise", "removed",
              "sims", "seconds")  # fmt: skip
    table = []
    for row in rows:
        names = " + ".join(row["named"]) + (f" ({', '.join(row['equivalent'])})" if row["equivalent"] else "")
        ratio = ", ".join(f"{value:.2f}" for value in row["strength_ratio"].values())
        removed = "-" if row["removed"] is None else f"{row['removed']:.0%}"
        table.append(
            (
                row["scene"],
                f"{row['truth']} ({row['truth_strength']})",
                row["verdict"],
                names or "-",
                ratio or "-",
                f"{row['before_mm']:.2f}",
                f"{row['after_mm']:.2f}",
                f"{row['floor_mm']:.2f}",
                removed,
                str(row["simulations"]),
                f"{row['seconds']:.0f}",
            )
        )
    notes = (
        f"{found['clear_right']} of {found['clear']} clear effects right, {found['false_names']} named where none "
        f"acts, {found['wrong_names']} wrong names; {found['strength_within_25_percent']} of {found['strengths']} "
        "strengths within 25 %. Errors in mm, root mean square per axis; strength is found over true.",
        f"Not traced in this version: {', '.join(missing) or 'none'}.",
    )
    return Report(
        name="trace", title="Undeclared effects", figures={"scenes": rows, **found}, header=header,
        rows=tuple(table), notes=notes, seed=0,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
