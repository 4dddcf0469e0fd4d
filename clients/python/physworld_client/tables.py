"""Answers of the service as tables of pandas, the extra ``pandas`` of this distribution.

A row holds every plain value of an answer; what is nested has its path as name (``config.episodes``), what is a list is
left out. Errors stay in the wire's units, which their names end with (``track_m``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from html import escape
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from physworld_client.errors import ExtraMissing

if TYPE_CHECKING:
    import pandas

Plain = str | int | float | bool | datetime | None


def to_pandas(items: Iterable[BaseModel] | Iterable[Mapping[str, Any]]) -> pandas.DataFrame:
    """A row for each answer.

    ``to_pandas(client.fits.list().auto_paging_iter())`` is of all fits, ``client.fits.list().to_pandas()`` of one page.

    Raises:
        ExtraMissing: pandas is not installed.
    """
    return frame([dict(row_of(item)) for item in items])


def frame(rows: list[dict[str, Any]], index: str | None = None) -> pandas.DataFrame:
    """A table of rows, with the column ``index`` as its index."""
    try:
        import pandas
    except ImportError as error:
        raise ExtraMissing("tables", "pandas") from error
    table = pandas.DataFrame(rows)
    return table if index is None or not len(table) else table.set_index(index)


def row_of(item: BaseModel | Mapping[str, Any]) -> Iterator[tuple[str, Plain]]:
    """The plain values of an answer with their paths."""
    values = item.model_dump() if isinstance(item, BaseModel) else item
    for name, value in values.items():
        if isinstance(value, Mapping):
            for path, inner in row_of(value):
                yield f"{name}.{path}", inner
        elif value is None or isinstance(value, str | int | float | datetime):
            yield str(name), value


def html(items: Sequence[BaseModel]) -> str:
    """The plain values of answers as a table of HTML; needs no pandas."""
    rows = [dict(row_of(item)) for item in items]
    names = [name for name in dict.fromkeys(name for row in rows for name in row) if "." not in name]
    head = "".join(f"<th>{escape(name)}</th>" for name in names)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(_text(row.get(name)))}</td>" for name in names) + "</tr>"
        for row in rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def held_out_rows(metrics: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Held-out errors of a fit or a model version: a row a predictor, a column a metric, its interval beside it.

    Rows keep the order of the service: baselines first.
    """
    table = metrics.get("held_out")
    if not isinstance(table, Mapping):
        return []
    listed = {
        name: values
        for name, values in table.items()
        if name not in ("per_frame", "ci95") and _is_column(values)
    }
    intervals = table.get("ci95") or {}
    rows: dict[str, dict[str, Any]] = {}
    for metric, values in listed.items():
        for predictor, value in values.items():
            row = rows.setdefault(predictor, {"predictor": predictor})
            row[metric] = value
            ends = (intervals.get(metric) or {}).get(predictor)
            if ends is not None:
                row[f"{metric}.low"], row[f"{metric}.high"] = ends
    return [*rows.values()]


def _is_column(values: object) -> bool:
    return isinstance(values, Mapping) and all(
        value is None or isinstance(value, int | float) for value in values.values()
    )


def _text(value: Plain) -> str:
    return "" if value is None else str(value)
