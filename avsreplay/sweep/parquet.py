"""Parquet files of a campaign. pyarrow ships no types and is an optional dependency."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from avsreplay.errors import MissingBackend, UnreadableInput
from avsreplay.files import output_path
from avsreplay.sweep.execute import SCAN_COLUMNS


def arrow() -> tuple[Any, Any]:
    """The modules pyarrow and pyarrow.parquet. Raises MissingBackend where pyarrow is not installed."""
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError:
        hint = "pip install 'avsreplay[sweep]'"
        raise MissingBackend("pyarrow is not installed", where="sweep", hint=hint) from None


def scan_schema() -> Any:
    """Columns of a file of scans: the run's id, then SCAN_COLUMNS."""
    pa, _ = arrow()
    types = {"seq": pa.int64(), "fault": pa.string(), "harmful": pa.bool_(), "gamma": pa.int64()}
    return pa.schema([("id", pa.string()), *((name, types.get(name, pa.float64())) for name in SCAN_COLUMNS)])


def write_scans(path: Path, rows: Sequence[tuple[Any, ...]]) -> None:
    """Write the scans of one run.

    Args:
        path: The Parquet file; its folder is created.
        rows: One tuple per scan in the order of SCAN_COLUMNS.

    Raises:
        UnreadableInput: The folder cannot be created or the file cannot be written.
    """
    schema = scan_schema().remove(0)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnreadableInput(error.strerror or "cannot be made", where=str(path.parent), hint="check it") from None
    write_batches(path, schema, [rows])


def write_batches(path: Path, schema: Any, batches: Iterable[Sequence[tuple[Any, ...]]]) -> None:
    """Write rows in batches to a file that appears once it is complete."""
    pa, pq = arrow()
    with (
        output_path(path) as part,
        pq.ParquetWriter(part, schema, compression="zstd", write_page_checksum=True) as writer,
    ):
        for rows in batches:
            columns = zip(*rows, strict=True) if rows else ([] for _ in schema)
            arrays = [pa.array(column, field.type) for column, field in zip(columns, schema, strict=True)]
            writer.write_table(pa.table(arrays, schema))


def read_scans(path: Path) -> list[tuple[Any, ...]]:
    """The scans of one run. Raises UnreadableInput where the file is damaged."""
    pa, pq = arrow()
    try:
        table = pq.read_table(path, page_checksum_verification=True)
    except (OSError, pa.ArrowException) as error:
        what = str(error).splitlines()[0]
        raise UnreadableInput(what, where=str(path), hint="run the campaign again") from None
    return list(zip(*(column.to_pylist() for column in table.columns), strict=True))
