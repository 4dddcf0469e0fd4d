"""Any number of versions of a model side by side: each against the first, as two versions are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from physworld_schemas.model import Difference, MeasuredError, ModelComparison, ModelVersion
from physworld_storage.comparison import compare_versions


@dataclass(frozen=True)
class Cell:
    """A version's error, and its gain against the first version; None where there is none."""

    error: MeasuredError | None
    gain: MeasuredError | None = None


@dataclass(frozen=True)
class ErrorRow:
    """Errors of one predictor in one metric, a cell for every version."""

    metric: str
    predictor: str
    cells: list[Cell]


@dataclass(frozen=True)
class FactRow:
    """What is known of every version under one name."""

    field: str
    values: list[Any]


@dataclass(frozen=True)
class SideBySide:
    """What a page shows of several versions.

    Attributes:
        versions: their numbers, the first is what the others are compared with.
        elsewhere: of those that were scored on other frames than the first: they have no gain.
        errors: on the held-out frames.
        differences: how they were made, where that differs.
        figures: of each.
    """

    versions: list[int]
    elsewhere: list[int]
    errors: list[ErrorRow]
    differences: list[FactRow]
    figures: list[FactRow]


def side_by_side(versions: Sequence[ModelVersion]) -> SideBySide:
    """The comparison of ready versions, each once. Raises Conflict when one is not ready."""
    first, *others = versions
    pairs = [compare_versions(first, one) for one in others]
    found = pairs or [compare_versions(first, first)]
    return SideBySide(
        versions=[one.version for one in versions],
        elsewhere=[pair.b for pair in pairs if not pair.same_recording],
        errors=_errors(found, len(pairs)),
        differences=_facts([pair.differences for pair in pairs], len(pairs)),
        figures=_facts([pair.figures for pair in found], len(pairs)),
    )


def _errors(found: Sequence[ModelComparison], others: int) -> list[ErrorRow]:
    """A row for everything that any of the versions was scored for, in the order of the first that has it."""
    names = dict.fromkeys((item.metric, item.predictor) for pair in found for item in pair.errors)
    by_name = [{(item.metric, item.predictor): item for item in pair.errors} for pair in found]
    rows = []
    for metric, predictor in names:
        items = [known.get((metric, predictor)) for known in by_name]
        own = next((item.a for item in items if item is not None), None)
        cells = [Cell(item.b, item.gain) if item else Cell(None) for item in items[:others]]
        rows.append(ErrorRow(metric, predictor, [Cell(own), *cells]))
    return rows


def _facts(pairs: Sequence[Sequence[Difference]], others: int) -> list[FactRow]:
    """A row for every name that any pair has; a pair without it holds the first version's value in both."""
    by_name = [{item.field: item for item in pair} for pair in pairs]
    rows = []
    for name in dict.fromkeys(item.field for pair in pairs for item in pair):
        own = next(known[name].a for known in by_name if name in known)
        theirs = [known[name].b if name in known else own for known in by_name[:others]]
        rows.append(FactRow(name, [own, *theirs]))
    return rows
