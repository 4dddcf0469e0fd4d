"""``python -m benchmarks.paper.cells [--docs docs/paper.md]``: the paper's six tables cell by cell, ours beside them.

A cell of the paper is a figure of other scenes, so it stands here as a relation: the row over the table's reference
row, the paper's and ours, ours as the geometric mean over scenes (and seeds). Both sides of a relation of ours come
from one run: world models and their twin from the cells of :mod:`benchmarks.paper.tables`, spring–mass networks and
their twin from the JSON of :mod:`benchmarks.measured.springs`, all image columns and the stages of the calibration from
the JSON of :mod:`benchmarks.paper.images`. Nothing is measured here. Below a table stands, for every group of cells
that is not there, why; the first line counts those that are.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import Report, write_section
from benchmarks.paper.models import SCENES
from benchmarks.paper.relations import errors_by_prediction, speed
from benchmarks.paper.tables import Cells, plan

RECORDS = Path(__file__).resolve().parents[1] / "records"
ERRORS = {"CD": "chamfer_phystwin_m", "Track": "track_m"}
PICTURES = {"IoU": "iou", "PSNR": "psnr_db", "SSIM": "ssim", "LPIPS": "lpips"}
OF_PICTURES = (
    "their films were not measured (`benchmarks.paper.images`; LPIPS asks for its package of weights)"
)
COLUMNS = ("CD", "Track", *PICTURES, "FPS")
FINE_TUNED, WITHOUT = "world_model_finetuned", "world_model"


@dataclass(frozen=True)
class Row:
    """A row of the paper.

    Attributes:
        title: as in the paper.
        figures: by column.
        ours: our name of it, or None.
        source: the run that CD, Track and FPS are from: "tables", "springs" or "images"; pictures are always from the
            last.
        reason: why there is none.
    """

    title: str
    figures: Mapping[str, float]
    ours: str | None
    source: str = "tables"
    reason: str = ""


@dataclass(frozen=True)
class Table:
    """A table of the paper: rows, and the title of the row that the others are related to."""

    title: str
    reference: str
    rows: tuple[Row, ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """Its columns."""
        return tuple(self.rows[0].figures)


def _row(title: str, figures: str, ours: str | None, source: str = "tables") -> Row:
    values = [float(value) for value in figures.split()]
    names = ("CD", "Track", *PICTURES, "FPS")[: len(values)]
    return Row(title, dict(zip(names, values, strict=True)), ours, source)


_OURS = "0.0100 0.0154 78.66 24.666 0.921 0.067"
_VIDEO = (
    "scores of VBench, which judges films by networks that are not here; none of our figures bears these names, those "
    "of unseen interactions stand under their own in the table of `benchmarks.paper.interactions`"
)
TABLES = (
    Table("1: prediction", "Our MPM", (
        _row("Spring-Gaus", "0.062 0.094 46.4 22.488 0.924 0.113 2", "spring_gaus", "springs"),
        _row("GS-Dynamics", "0.041 0.070 49.8 22.540 0.924 0.097 236", "recording_no_prior", "images"),
        _row("PhysTwin", "0.012 0.022 72.5 25.617 0.941 0.055 17", "phystwin", "springs"),
        _row("Our MPM", "0.011 0.021 74.7 26.231 0.942 0.052 3", "twin"),
        _row("Our GNN w/o Finetuning", "0.012 0.025 70.0 25.345 0.939 0.059 799", WITHOUT),
        _row("PhysWorld", "0.010 0.021 73.3 25.940 0.941 0.055 799", FINE_TUNED),
    )),
    Table("2: unseen interactions", "PhysWorld", tuple(
        Row(title, dict(zip(("Aesthetic", "Smoothness", "Consistency"), figures, strict=True)), None, reason=_VIDEO)
        for title, figures in (("PhysTwin", (0.4315, 0.9971, 0.9155)), ("PhysWorld", (0.4440, 0.9973, 0.9312)))
    )),
    Table("3: global and local properties", "Global-to-Local", tuple(
        _row(title, figures, ours, "images")
        for title, figures, ours in (
            ("Global", "0.012 0.024 72.4 25.854 0.940 0.055", "twin"),
            ("Local", "0.016 0.032 66.5 24.901 0.935 0.066", "local"),
            ("Global-to-Local", "0.010 0.021 74.7 26.231 0.942 0.052", "global_to_local"),
        )
    )),
    Table("4: motion", "VMP-Gen", (
        _row("Uniform and linear", "0.0114 0.0175 76.95 24.475 0.920 0.067", "linear"),
        _row("VMP-Gen", _OURS, "vmp"),
    )),
    Table("5: perturbation", "P3-Pert", (
        _row("none", "0.0111 0.0179 75.84 23.984 0.919 0.070", "none"),
        _row("Random", "0.0153 0.0216 70.19 23.073 0.915 0.082", "random"),
        _row("Uniform", "0.0147 0.0258 72.00 23.101 0.914 0.079", "uniform"),
        _row("P3-Pert", _OURS, FINE_TUNED),
    )),
    Table("6: real data alone", "PhysWorld", (
        _row("GNN on real data", "0.0530 0.0802 41.32 19.925 0.881 0.132", "recording_alone"),
        _row("PhysWorld", _OURS, FINE_TUNED),
    )),
)  # fmt: skip


def main() -> int:
    """Print the tables of what was measured."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper.cells", description=__doc__)
    parser.add_argument(
        "--cells", type=Path, default=RECORDS / "paper_tables", help="of benchmarks.paper.tables"
    )
    parser.add_argument("--springs", type=Path, default=RECORDS / "measured_springs.json")
    parser.add_argument("--images", type=Path, default=RECORDS / "paper_images.json")
    parser.add_argument("--docs", type=Path, default=None, help="Markdown file whose section is replaced")
    given = parser.parse_args()
    for path in (given.cells, given.springs, given.images):
        if not path.exists():
            print(f"{path}: not there", file=sys.stderr)
            return 2
    cells = Cells(given.cells, None)
    held = {key: cells.get(key) for key, _ in plan(list(SCENES))}
    shown = report(Runs(held, *(json.loads(path.read_text()) for path in (given.springs, given.images))))
    print(shown.markdown())
    if given.docs is not None:
        write_section(shown, given.docs)
    return 0


@dataclass(frozen=True)
class Runs:
    """What was measured.

    Attributes:
        tables: cells of ``benchmarks.paper.tables`` by key, None where one was not run.
        springs: JSON of ``benchmarks.measured.springs``.
        images: JSON of ``benchmarks.paper.images``.
    """

    tables: dict[str, dict[str, Any] | None]
    springs: dict[str, Any]
    images: dict[str, Any]

    def values(self, source: str, row: Row, column: str) -> dict[str, float]:
        """Our figure of a row by what its reference has too: scene and seed, or recording; empty where there is none.

        Args:
            source: the run.
            row: whose figure.
            column: which.
        """
        if column in PICTURES or source == "images":
            return of_images(self.images, str(row.ours), column)
        if source == "springs":
            return of_springs(self.springs, str(row.ours), column)
        return values_of(self.tables, row, column)


def values_of(held: dict[str, dict[str, Any] | None], row: Row, column: str) -> dict[str, float]:
    """Our figure of a world model's row by scene and seed, or by scene where it is a speed."""
    if column == "FPS":
        side = "twin" if row.ours == "twin" else "world_model"
        found = {name: speed(name, held) for name in SCENES}
        return {name: of[side] for name, of in found.items() if of is not None}
    return {
        f"{name}/{seed}": value
        for name in SCENES
        for seed, value in errors_by_prediction(name, held)[str(row.ours)][ERRORS[column]].items()
    }


def of_springs(document: dict[str, Any], ours: str, column: str) -> dict[str, float]:
    """Our figure of a predictor of the springs' run by recording, where it has one."""
    key = "frames_per_second" if column == "FPS" else ERRORS[column]
    found = {name: entry["predictors"].get(ours) for name, entry in document["recordings"].items()}
    return {name: of[key] for name, of in found.items() if of is not None and of["reason"] is None}


def of_images(document: dict[str, Any], ours: str, column: str) -> dict[str, float]:
    """Our figure of a prediction of the images' run by recording, on held-out frames, where it has one."""
    found: dict[str, float] = {}
    for name, entry in document["recordings"].items():
        if column == "FPS":
            of_network = entry["works"].get("recording_no_prior", {})
            key = "twin_steps_per_second" if ours == "twin" else "own_steps_per_second"
            if key in of_network:
                found[name] = of_network[key]
        elif ours in entry["predictors"]:
            of = entry["predictors"][ours]
            value = of["held_out"][PICTURES[column]] if column in PICTURES else of[ERRORS[column]]
            if value is not None:
                found[name] = value
    return found


def relation(table: Table, row: Row, column: str, runs: Runs) -> tuple[float, int | None, int] | None:
    """Ours against the reference row's, in how many pairs it lies on the paper's side, pairs.

    The geometric mean of the ratio; of a PSNR the mean of the difference in dB. The second is None where the paper has
    both alike. None for a cell that is not there.
    """
    reference = next(one for one in table.rows if one.title == table.reference)
    if row.ours is None or reference.ours is None:
        return None
    own, base = (runs.values(row.source, one, column) for one in (row, reference))
    pairs = [(own[key], base[key]) for key in own if key in base]
    if not pairs:
        return None
    apart = np.array([_apart(column, *pair) for pair in pairs])
    paper = _apart(column, row.figures[column], reference.figures[column])
    side = int(np.sum((apart < 0.0) == (paper < 0.0))) if paper != 0.0 else None
    return _from_apart(column, float(apart.mean())), side, len(apart)


def _apart(column: str, own: float, base: float) -> float:
    """The logarithm of a ratio, which is -inf for an IoU of 0; of a PSNR the difference [dB]."""
    if column == "PSNR":
        return own - base
    with np.errstate(divide="ignore"):
        return float(np.log(own / base))


def _from_apart(column: str, apart: float) -> float:
    return apart if column == "PSNR" else float(np.exp(apart))


def _shown(column: str, value: float) -> str:
    """Two decimals; a third of SSIM, whose ratios hardly leave 1; a difference with its sign."""
    return {"PSNR": f"{value:+.1f}", "SSIM": f"{value:.3f}"}.get(column, f"{value:.2f}")


def report(runs: Runs) -> Report:
    """Every table, the count of cells, and why the others are not there."""
    rows, missing, found = [], [], {}
    count = total = 0
    unmeasured: dict[str, int] = {}
    for table in TABLES:
        reference = next(one for one in table.rows if one.title == table.reference)
        for row in table.rows:
            shown = []
            for column in table.columns:
                ours = relation(table, row, column, runs)
                others = [one for one in table.rows if one is not row]
                if row is reference and not any(relation(table, one, column, runs) for one in others):
                    ours = None  # a reference that nothing is related to says nothing
                total += 1
                if ours is None:
                    if not row.reason:
                        unmeasured[table.title] = unmeasured.get(table.title, 0) + 1
                    continue
                count += 1
                paper = _from_apart(column, _apart(column, row.figures[column], reference.figures[column]))
                found[f"{table.title}/{row.title}/{column}"] = {
                    "ours": ours[0],
                    "paper": paper,
                    "pairs": ours[2],
                }
                tail = "" if ours[1] is None else f" ({ours[1]}/{ours[2]})"
                shown.append((column, f"{_shown(column, paper)} / {_shown(column, ours[0])}{tail}"))
            known = dict(shown)
            rows.append([table.title, row.title, *(known.get(name, "–") for name in COLUMNS)])
            if row.reason:
                missing.append((table.title, row.title, len(table.columns), row.reason))
    groups: dict[tuple[str, str], list[tuple[str, int]]] = {}
    for title, name, cells, reason in missing:
        groups.setdefault((title, reason), []).append((name, cells))
    notes = [
        f"{count} of {total} cells of the paper's six tables have a counterpart here.",
        "A cell: the paper's relation / ours, the row over its table's reference row (the row with 1.00 / 1.00), "
        "ours as the geometric mean over pairs of scene and seed, PSNR as the difference in dB; in brackets in how "
        "many pairs ours lies on the same side as the paper's. CD, Track, LPIPS: below 1 is better. IoU, SSIM, FPS: "
        "above. "
        "The line at the end names the machine that printed this; where cells were measured stands with their tables.",
        "World models, their twin and the network on the recording alone, CD, Track and FPS: small networks on "
        f"{', '.join(SCENES)}, three seeds (`benchmarks.paper.tables`). Spring–mass networks: against the twin of "
        f"their own run on {', '.join(runs.springs['recordings'])} (`benchmarks.measured.springs`). IoU, PSNR, SSIM, "
        f"LPIPS, all of table 3 and of GS-Dynamics: rendered {', '.join(runs.images['recordings'])}, one seed "
        "(`benchmarks.paper.images`).",
        "GS-Dynamics is, in the paper's words, “a learning-based approach employing a GNN-based model to learn "
        "dynamics from real videos”. Its row here is our graph network without a closed-form part, trained on the "
        "tracks of the recording's training frames alone; their own network and tracker are not here. FPS there: ticks "
        "a second of the network and of the twin.",
        *(
            f"Not there, table {title}, {cells} cells of rows that are: {OF_PICTURES}."
            for title, cells in unmeasured.items()
        ),
        *(
            f"Not there, table {title}, {sum(cells for _, cells in names)} cells of "
            f"{', '.join(name for name, _ in names)}: {reason}."
            for (title, reason), names in groups.items()
        ),
    ]  # fmt: skip
    return Report(
        name="paper.cells",
        title="The paper's tables, cell by cell",
        figures={"cells": found, "count": count, "total": total},
        header=["table", "row", *COLUMNS],
        rows=rows,
        notes=notes,
    )


if __name__ == "__main__":
    sys.exit(main())
