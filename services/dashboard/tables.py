"""The held-out table of a fit or a model version: which predictor errs by how much, and the best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from physworld.report import names
from physworld.report.predictors import PREDICTORS
from physworld_schemas.library import Metric, catalogue

HeldOut = Mapping[str, Mapping[str, float | None]]


@dataclass(frozen=True)
class Cell:
    """An error, in its metric's unit, and whether no other predictor has a better one."""

    value: float | None
    best: bool


@dataclass(frozen=True)
class Row:
    """One predictor; baselines are set apart from what the service made."""

    label: str
    baseline: bool
    cells: Sequence[Cell]


def held_out_of(metrics: Mapping[str, Any]) -> HeldOut | None:
    """The table in an object's metrics: under ``held_out``, or the metrics themselves; None without one."""
    for table in (metrics.get("held_out"), metrics):
        if isinstance(table, Mapping) and held_out_columns(table):
            return table
    return None


def noise_floor_of(metrics: Mapping[str, Any]) -> float | None:
    """What a perfect prediction would show [m], where it is known."""
    table = metrics.get("held_out")
    inner = table.get("noise_floor_m") if isinstance(table, Mapping) else None
    found = metrics.get("noise_floor_m", inner)
    return float(found) if isinstance(found, int | float) else None


def held_out_columns(table: Mapping[str, Any]) -> list[Metric]:
    """Metrics of the table that are shown, in their order."""
    return [metric for metric in catalogue().listed_metrics() if isinstance(table.get(metric.name), Mapping)]


def held_out_rows(table: HeldOut) -> list[Row]:
    """One row for each predictor that any metric has, baselines first."""
    columns = held_out_columns(table)
    present = {name for metric in columns for name in table[metric.name]}
    names = [name for name in PREDICTORS if name in present] + sorted(present - set(PREDICTORS))
    best = {metric.name: _best(metric, table[metric.name]) for metric in columns}
    return [
        Row(
            label_of(name),
            name not in PREDICTORS or PREDICTORS[name].baseline,
            [
                Cell(value, value is not None and value == best[metric.name])
                for metric in columns
                for value in [table[metric.name].get(name)]
            ],
        )
        for name in names
    ]


def label_of(name: str) -> str:
    """What a predictor is called at the beginning of a row."""
    label = PREDICTORS[name].label if name in PREDICTORS else names.label(name)
    return names.sentence(label)


def _best(metric: Metric, values: Mapping[str, float | None]) -> float | None:
    better = min if metric.lower_is_better else max
    return better((value for value in values.values() if value is not None), default=None)
