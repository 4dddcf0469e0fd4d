"""What pyarrow reads of a file of LeRobot's: the state of every row, its time and its episode."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from physworld.arrays import Array

STATE, TIME, EPISODE = "observation.state", "timestamp", "episode_index"
MOST_ROWS, MOST_COMPONENTS = 2_000_000, 256
MOST_COLUMN_BYTES = 256 << 20


def content_of(source: str) -> tuple[dict[str, Array], dict[str, Any]]:
    """``state`` (R, D), ``times`` (R,) [s] and ``episodes`` (R,), which is missing where the file has none.

    Raises:
        ValueError: pyarrow is not there, columns are missing or not of their form, or there is too much.
    """
    os.environ.setdefault(
        "ARROW_DEFAULT_MEMORY_POOL", "system"
    )  # others reserve a GiB, which the limit counts
    try:
        from pyarrow.parquet import ParquetFile
    except ImportError as error:
        raise ValueError("parquet needs the package pyarrow: pip install 'physworld[tables]'") from error

    with ParquetFile(source, pre_buffer=False) as file:
        held = file.schema_arrow.names
        missing = [name for name in (STATE, TIME) if name not in held]
        if missing:
            raise ValueError(f"has no column {' and no '.join(missing)}; it has {', '.join(held)[:120]}")
        if file.metadata.num_rows > MOST_ROWS:
            raise ValueError(f"has {file.metadata.num_rows} rows, at most {MOST_ROWS} are read")
        wanted = [name for name in (STATE, TIME, EPISODE) if name in held]
        _require_small(file.metadata, wanted)
        table = file.read(columns=wanted, use_threads=False)
    arrays = {"state": _state(table.column(STATE)), "times": _numbers(table.column(TIME), TIME)}
    if EPISODE in wanted:
        arrays["episodes"] = _numbers(table.column(EPISODE), EPISODE, whole=True)
    return arrays, {}


def _require_small(metadata: Any, wanted: list[str]) -> None:
    """Pages are unpacked one after the other, but a column is held whole."""
    size = 0
    for group in range(metadata.num_row_groups):
        row_group = metadata.row_group(group)
        for number in range(row_group.num_columns):
            column = row_group.column(number)
            if any(
                column.path_in_schema == name or column.path_in_schema.startswith(f"{name}.")
                for name in wanted
            ):
                size += column.total_uncompressed_size
    if size > MOST_COLUMN_BYTES:
        raise ValueError(f"holds {size} bytes of states, at most {MOST_COLUMN_BYTES} are read")


def _state(column: Any) -> Array:
    """Lists of one length, (R, D)."""
    import pyarrow as pa
    from pyarrow.compute import list_value_length

    whole = column.combine_chunks()
    kind = whole.type
    if not (pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)):
        raise ValueError(f"{STATE} is {str(kind)[:80]}, no list of numbers")
    lengths = np.unique(list_value_length(whole).to_numpy(zero_copy_only=False))
    if whole.null_count or len(lengths) != 1 or not 0 < lengths[0] <= MOST_COMPONENTS:
        told = ", ".join(f"{length:g}" for length in lengths[:4])
        raise ValueError(
            f"{STATE} has rows of {told or 'no'} numbers and {whole.null_count} empty ones; all are to have as many"
        )
    return _numbers(whole.flatten(), STATE).reshape(len(whole), int(lengths[0]))


def _numbers(column: Any, name: str, whole: bool = False) -> Array:
    """Values of a column, (R,) float64, of whole numbers int64."""
    import pyarrow as pa

    if not (pa.types.is_integer(column.type) or (pa.types.is_floating(column.type) and not whole)):
        raise ValueError(f"{name} holds {str(column.type)[:80]}, no {'whole ' if whole else ''}numbers")
    if column.null_count:
        raise ValueError(f"{name} has {column.null_count} empty values of {len(column)}")
    return np.asarray(column).astype(np.int64 if whole else np.float64)
