"""``python -m benchmarks.worldmodel.measured --json FILE``: world models of measured recordings beside their twins.

Runs ``physworld run`` with its defaults on every recording, one after the other, each on a service of its own, and
reads the report and the card of the version. Errors are mean distances of visible tracked points on the held-out
frames, open loop from the first frame. What is in ``--work`` already is not run again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.harness import Report, write_json, write_section
from benchmarks.trace.real import SHARED

CLOSE = 1.05
RECORDINGS = (
    "rope_a_ring", "rope_a_whip", "rope_b_shake", "rope_c_shake", "branched_a", "cloth_swing", "beam_free_a",
    "noodle_gentle",
)  # fmt: skip


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.worldmodel.measured", description=__doc__)
    parser.add_argument("--json", type=Path, required=True, help="the figures go there")
    parser.add_argument("--work", type=Path, required=True, help="keeps every run")
    parser.add_argument("--docs", type=Path, help="a page whose section is replaced")
    parser.add_argument("--set", type=Path, default=SHARED, help="folder of recordings")
    parser.add_argument("--only", nargs="*", default=[*RECORDINGS], help="names of recordings")
    given = parser.parse_args()
    if not given.set.is_dir():
        print(
            f"nothing measured: there are no recordings at {given.set}; --set names a folder", file=sys.stderr
        )
        return 2
    rows = [row_of(name, given.set / name, given.work / name) for name in given.only]
    report = report_of(rows)
    print(report.markdown())
    write_json(report, given.json)
    if given.docs is not None:
        write_section(report, given.docs)
    return 0


def row_of(name: str, recording: Path, folder: Path) -> dict[str, Any]:
    """The figures of a recording, from its run; runs it where ``folder`` has none."""
    answer, files = folder / "out.json", folder / "art"
    if not answer.exists():
        folder.mkdir(parents=True, exist_ok=True)
        command = ["physworld", "run", str(recording), "--workers", "1", "--json", str(answer)]
        subprocess.run([*command, "--out", str(files), "--data", str(folder / "data")], check=True)
    told, card = json.loads(answer.read_text()), json.loads((files / "card.json").read_text())
    errors, metrics = told["held_out"]["track_m"], card["metrics"]
    kept = metrics["fine_tuning"]["kept"]
    return {
        "recording": name,
        "twin_m": errors["twin"],
        "model_m": errors["world_model_finetuned" if kept else "world_model"],
        "calibrated_m": errors["world_model"],
        "rigid_follow_m": errors["rigid_follow"],
        "against_twin_m": metrics["world_model_against_twin_m"],
        "read_out_m": metrics["skin_error_m"],
        "validation_m": metrics["validation"]["open_loop_m"],
        "prior_m": metrics["validation"]["prior_m"],
        "prior": metrics["validation"]["prior"],
        "twin_ticks_per_s": metrics["steps_per_second"]["twin"],
        "model_ticks_per_s": metrics["steps_per_second"]["world_model"],
        "predictor": metrics["predictor"],
        "seconds": told["seconds"]["total"],
    }


def report_of(rows: list[dict[str, Any]]) -> Report:
    """The table, the model's error beside the twin's."""

    def millimetres(row: dict[str, Any], *keys: str) -> list[str]:
        return [f"{1e3 * row[key]:.2f}" for key in keys]

    table = tuple(
        (
            row["recording"],
            *millimetres(row, "rigid_follow_m", "twin_m", "model_m"),
            f"{row['model_m'] / row['twin_m']:.2f}",
            *millimetres(row, "against_twin_m", "read_out_m", "validation_m", "prior_m"),
            row["prior"].replace("_", " "),
            *(f"{row[key]:.0f}" for key in ("twin_ticks_per_s", "model_ticks_per_s")),
            {"twin": "the twin", "model": "the network"}[row["predictor"]],
        )
        for row in rows
    )
    close = [row["model_m"] <= CLOSE * row["twin_m"] for row in rows]
    answered = sum(near or row["predictor"] == "twin" for near, row in zip(close, rows, strict=True))
    return Report(
        name="worldmodels",
        title="World models of measured recordings",
        figures={"recordings": rows},
        header=(
            "recording", "rigid follow [mm]", "twin", "world model", "over twin", "model from twin", "read-out",
            "validation", "its prior", "prior", "twin, ticks/s", "world model, ticks/s",
            "rollouts by",
        ),
        rows=table,
        notes=(
            f"{sum(close)} of {len(rows)} networks err at most {CLOSE} times as much as their twins. What answers "
            f"rollouts does so of {answered}: where it is the twin, by being it.",
            "`model from twin`: between their predictions of the same frames. `read-out`: between the points that the "
            "twin's own vertices carry and the twin's points. `validation`: open loop on demonstrations kept aside. "
            "Ticks are 1/30 s, or near that; one candidate, one thread.",
        ),
        seed=0,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
