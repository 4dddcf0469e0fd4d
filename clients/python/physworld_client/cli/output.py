"""What the commands print: rich tables for people, JSON for programs."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

from pydantic import BaseModel
from rich.console import Console
from rich.table import Table
from rich.text import Text

from physworld_client.types import Job
from physworld_schemas.wording import roughly

NARROWEST = 110
LONGEST_LIST = 8

stdout = Console(highlight=False, width=None if sys.stdout.isatty() else NARROWEST)
stderr = Console(stderr=True, highlight=False, width=None if sys.stderr.isatty() else NARROWEST)


def print_json(value: BaseModel | Sequence[BaseModel]) -> None:
    """One JSON document: an object, or an array of objects."""
    if isinstance(value, BaseModel):
        plain: Any = value.model_dump(mode="json")
    else:
        plain = [item.model_dump(mode="json") for item in value]
    print(json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False))


def print_table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A table of texts; says so when it is empty."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in headings:
        table.add_column(Text(heading), no_wrap=True)
    for row in rows:
        table.add_row(*map(Text, row))  # brackets of units and names are no markup
    if table.row_count:
        stdout.print(table)
    else:
        stdout.print("nothing yet")


def print_fields(value: BaseModel) -> None:
    """The fields of one object, one a line; nested values as JSON, long lists of numbers by their length."""
    fields = value.model_dump(mode="json")
    width = max(len(name) for name in fields)
    for name, content in fields.items():
        if content in (None, "", [], {}):
            continue
        text = content if isinstance(content, str) else json.dumps(_shortened(content), ensure_ascii=False)
        stdout.print(f"{name:<{width}}  {text}", markup=False, soft_wrap=True)


def show(value: BaseModel, as_json: bool) -> None:
    """One object, field by field, or as JSON."""
    if as_json:
        print_json(value)
    else:
        print_fields(value)


def print_state(job: Job, as_json: bool) -> None:
    """What has become of a job, in a line or as JSON."""
    if as_json:
        print_json(job)
    else:
        stdout.print(f"{job.id} is {job.state}", markup=False)


def progress_text(job: Job) -> str:
    """``63 %, about 4 min left, 12 of 40 episodes, message``."""
    progress = job.progress
    parts = []
    if job.state == "running":
        parts.append(f"{100 * job.share:.0f} %")
        if progress.eta_s is not None:
            parts.append(f"about {roughly(progress.eta_s)} left")
    if progress.total:
        parts.append(f"{progress.done:g} of {progress.total:g} {progress.unit}".strip())
    if progress.message:
        parts.append(progress.message)
    return ", ".join(parts)


def millimetres(metres: Any) -> str:
    """A length in mm with three digits, ``?`` where there is none."""
    return f"{1e3 * metres:.3g}" if isinstance(metres, int | float) and math.isfinite(metres) else "?"


def _shortened(content: Any) -> Any:
    """The same without lists of more than ``LONGEST_LIST`` numbers; ``--json`` prints them."""
    if isinstance(content, dict):
        return {name: _shortened(value) for name, value in content.items()}
    if isinstance(content, list):
        numbers = all(item is None or isinstance(item, int | float) for item in content)
        if numbers and len(content) > LONGEST_LIST:
            return f"{len(content)} numbers"
        return [_shortened(item) for item in content]
    return content


def ago(moment: datetime) -> str:
    """How long ago, in one unit: ``12 s``, ``5 min``, ``3 h``, ``2 d``."""
    seconds = max(0.0, (datetime.now(UTC) - moment).total_seconds())
    for size, unit in ((86400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if seconds >= size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
