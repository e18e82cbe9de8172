"""Force and moment over time as tables: CSV, and Parquet with types and units."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_bringup.recordings.forces import COLUMN_TYPES, COLUMNS, unit_of

__all__ = ["CsvTable", "ParquetTable", "Table", "require_parquet"]

ROWS_IN_MEMORY = 4096


class Table(Protocol):
    """Takes the rows of COLUMNS; a context manager."""

    def append(self, row: Sequence[float | str]) -> None:
        """Write the next row."""


class CsvTable:
    """A CSV file; numbers are written with all their digits."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file)
        self._writer.writerow(COLUMNS)

    def __enter__(self) -> CsvTable:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def append(self, row: Sequence[float | str]) -> None:
        """Write the next row."""
        self._writer.writerow(row)


class ParquetTable:
    """A Parquet file; each column's metadata has its `unit`, and NaN stays NaN."""

    def __init__(self, path: Path) -> None:
        """Raises OutputError where pyarrow is not installed."""
        require_parquet()
        import pyarrow as pa
        import pyarrow.parquet as pq

        self._schema = pa.schema(
            pa.field(name, _arrow_type(name), nullable=False, metadata={"unit": unit_of(name)})
            for name in COLUMNS
        )
        self._rows: list[Sequence[float | str]] = []
        self._writer = pq.ParquetWriter(path, self._schema)

    def __enter__(self) -> ParquetTable:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self._flush()
        self._writer.close()

    def append(self, row: Sequence[float | str]) -> None:
        """Write the next row, some rows at a time."""
        self._rows.append(row)
        if len(self._rows) == ROWS_IN_MEMORY:
            self._flush()

    def _flush(self) -> None:
        import pyarrow as pa

        if not self._rows:
            return
        columns = zip(*self._rows, strict=True)
        arrays = [
            pa.array(values, item.type) for values, item in zip(columns, self._schema, strict=True)
        ]
        self._writer.write_batch(pa.record_batch(arrays, self._schema))
        self._rows.clear()


def require_parquet() -> None:
    """Raise OutputError where Parquet cannot be written."""
    try:
        import pyarrow.parquet  # noqa: F401  only whether it is there
    except ImportError as error:
        msg = (
            f"--parquet: found no pyarrow ({error}), expected it installed: "
            "`pip install pyarrow`; the CSV file has the same columns"
        )
        raise OutputError(msg) from None


def _arrow_type(column: str) -> Any:
    import pyarrow as pa

    return pa.type_for_alias(COLUMN_TYPES.get(column, "double"))
