"""Markers that another sensor has measured, and files of any tracker with their positions."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.sensor.parts import Pattern

Array = NDArray[np.float64]

POSITION, REFERENCE, TIME, STAMPS = "position", "reference", "time_s", "stamp_ns"
UNITS = {"m": 1.0, "mm": 1e-3}
PIXELS = "px"
# Neighbours at rest are so many pitches apart, and so many of the steps may be wrong.
LEAST_STEP, MOST_STEP, STRAY_SHARE = 0.5, 1.5, 0.05
LEAST_KNOWN = 0.5
# Columns of a table, by what else trackers call them: (Ox, Oy) is at rest, (Cx, Cy) now.
ALIASES = {"frameno": "frame", "cx": "x", "cy": "y"}
HEADER = re.compile(r"[#\s]*(\w+\s*[,;\t]\s*)*frame(no)?\s*[,;\t]", re.IGNORECASE)
TABLE = "the columns frame, row, col, x, y; optional: z, time_s, Ox, Oy"
NEEDED = ("frame", "row", "col", "x", "y")
NOT_SEEN = {"", "NA", "N/A", "null", "None", "-"}

_NAMES = (POSITION, REFERENCE, TIME, STAMPS)


@dataclass(frozen=True)
class MarkerRecording:
    """Markers of one sensor over time, in the gel frame.

    name: of the sensor, or of the file.  stamp_ns (n,).  lost: frames that are missing in between.
    reference (rows, cols, 3) m: markers at rest.  displacement (n, rows, cols, 3) m, NaN where a
    marker was not measured, and in z where the sensor measures none.
    """

    name: str
    stamp_ns: NDArray[np.int64]
    lost: int
    reference: Array
    displacement: Array


def read_markers(
    path: Path, pattern: Pattern, unit: str = "m", frame_rate: float = 30.0, rest_frames: int = 1
) -> MarkerRecording:
    """Positions of a sensor's markers from .npy, .npz or .csv, moved onto the pattern at rest.

    position: (frames, rows, cols, 2 or 3), or rows * cols in one; NaN where a marker was not seen.
    An .npz may have reference (rows, cols, ...), as position, and time_s or stamp_ns (frames,).
    unit: "m", "mm", or "px", which the pattern's pitch makes m.  frame_rate: Hz, without times.
    rest_frames: of the beginning, of which the median is the reference where there is none.
    Raises FrameSourceError, with file, found and expected, for what cannot be used.
    """
    shape = pattern.shape.corners
    is_table = path.suffix.lower() == ".csv"
    arrays = _read_table(path, shape) if is_table else _read_arrays(path)
    position = _on_grid(path, POSITION, arrays[POSITION], shape)
    stamps = _stamps(path, arrays, len(position), frame_rate)
    given = arrays.get(REFERENCE)
    rest = (
        position[:rest_frames] if given is None else _on_grid(path, REFERENCE, given[None], shape)
    )
    rest = median_known(rest)
    scale = _scale(path, rest, pattern, unit)
    corners = pattern.corners()
    shift = [
        np.nanmean(apart) if np.isfinite(apart).any() else 0.0
        for apart in np.moveaxis(corners - scale * rest, -1, 0)
    ]
    reference = scale * rest + shift
    # Markers that are known in the plane alone lie on the described surface.
    reference[..., 2] = np.where(np.isfinite(rest[..., 2]), reference[..., 2], corners[..., 2])
    return MarkerRecording(path.stem, stamps, 0, reference, scale * (position - rest))


def median_known(positions: Array) -> Array:
    """Median (...) of frames (n, ...), NaN left out; NaN where there is nothing else."""
    known = np.asarray(np.isfinite(positions).any(axis=0))
    median = np.nanmedian(np.where(known, positions, 0.0), axis=0)
    return np.where(known, median, np.nan)


def _read_arrays(path: Path) -> Mapping[str, NDArray[Any]]:
    try:
        # What an array of objects holds would be run.
        loaded = np.load(path, allow_pickle=False)
        arrays = {POSITION: loaded} if isinstance(loaded, np.ndarray) else dict(loaded)
        wrong = [name for name, values in arrays.items() if name in _NAMES and _no_number(values)]
    except FileNotFoundError:
        raise _error(path, "no such file", "a file with positions of markers") from None
    except OSError as error:
        raise _error(path, f"no file to read ({error.strerror})", "arrays of numpy") from None
    except Exception as error:  # noqa: BLE001  a damaged archive raises what its parts raise
        # Numpy's advice for what it cannot read is to run it.
        reason = "objects, or another format" if "pickle" in str(error) else error
        raise _error(path, f"no arrays ({reason})", "arrays of numpy, or a .csv file") from None
    if wrong or POSITION not in arrays:
        found = (
            f"{wrong[0]} with values that are not numbers"
            if wrong
            else ", ".join(arrays) or "nothing"
        )
        raise _error(path, found, f"an array {POSITION} of numbers")
    return arrays


def _no_number(values: NDArray[Any]) -> bool:
    return not np.issubdtype(values.dtype, np.number) or np.iscomplexobj(values)


@dataclass(frozen=True)
class _Table:
    """Cells of a file.

    header: the names of the columns.  rows: a number of a line and its cells.  has_decimal_commas:
    for points.
    """

    header: list[str]
    rows: list[tuple[int, list[str]]]
    has_decimal_commas: bool


def _read_columns(path: Path) -> dict[str, Array]:
    """The columns of a table by name; NaN in empty cells.  Other columns may contain text."""
    try:
        table = _read_cells(path)
    except (OSError, ValueError, csv.Error) as error:
        raise _error(path, f"no table ({error})", TABLE) from None
    missing = [name for name in NEEDED if name not in table.header]
    if missing:
        found = f"no column {missing[0]}; columns: {', '.join(table.header)}"
        raise _error(path, found, TABLE)
    used = [name for name in table.header if name in {*NEEDED, "z", "ox", "oy", TIME}]
    rows = _rows_of_markers(path, table, used)
    if not rows:
        raise _error(path, "no row", TABLE)
    return {name: _numbers(path, table, rows, name) for name in used}


def _read_cells(path: Path) -> _Table:
    """A table from its header on.

    Spreadsheets begin with a mark of UTF-8 or with "sep=;", and separate columns by semicolons
    where the decimal sign is a comma.  Raises ValueError where nothing is in it.
    """
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    headers = (n for n, line in enumerate(lines) if HEADER.match(line.replace('"', "")))
    first = next(headers, 0)
    separator = next((sign for sign in ";\t" if sign in "".join(lines[first : first + 1])), ",")
    reader = csv.reader(lines[first:], delimiter=separator, skipinitialspace=True)
    rows = [(first + reader.line_num, row) for row in reader if any(map(str.strip, row))]
    if not rows:
        msg = "it is empty"
        raise ValueError(msg)
    names = [name.strip("# \t").lower() for name in rows[0][1]]
    return _Table([ALIASES.get(name, name) for name in names], rows[1:], separator != ",")


def _rows_of_markers(path: Path, table: _Table, used: Sequence[str]) -> list[tuple[int, list[str]]]:
    """The rows without comments; FrameSourceError for one that has not as many cells as the header.

    A label may begin with #, too.
    """
    begins_with_number = table.header[0] in used
    rows = []
    for line, row in table.rows:
        is_whole = len(row) == len(table.header)
        if row[0].lstrip().startswith("#") and (begins_with_number or not is_whole):
            continue
        if not is_whole:
            expected = f"{len(table.header)} as in its header"
            raise _error(path, f"{len(row)} columns in line {line}", expected)
        rows.append((line, row))
    return rows


def _numbers(path: Path, table: _Table, rows: Sequence[tuple[int, list[str]]], name: str) -> Array:
    column = table.header.index(name)
    values = np.full(len(rows), np.nan)
    for number, (line, row) in enumerate(rows):
        text = row[column].strip()
        if text in NOT_SEEN:
            continue
        try:
            values[number] = float(text.replace(",", ".") if table.has_decimal_commas else text)
        except ValueError:
            raise _error(path, f"{name} {text!r} in line {line}", "a number") from None
    return values


def _read_table(path: Path, shape: tuple[int, int]) -> Mapping[str, NDArray[Any]]:
    """The arrays of a table with a row for each marker that was seen in a frame."""
    columns = _read_columns(path)
    at = np.stack([columns["row"], columns["col"]])
    inside = (at >= 0) & (at < np.reshape(shape, (2, 1))) & (at == np.rint(at))
    if not inside.all() or not np.isfinite(columns["frame"]).all():
        row = int(np.argmin(inside.all(axis=0) & np.isfinite(columns["frame"])))
        found = f"frame {columns['frame'][row]:g}, row {at[0, row]:g}, col {at[1, row]:g}"
        expected = f"whole numbers from 0, rows below {shape[0]} and columns below {shape[1]}"
        raise _error(path, found, expected)
    frames, frame = np.unique(columns["frame"], return_inverse=True)
    row, col = at.astype(int)
    markers, count = np.unique([frame, row, col], axis=1, return_counts=True)
    if (count > 1).any():
        k, i, j = markers[:, np.argmax(count)]
        found = f"frame {frames[k]:g}, row {i}, col {j} in {count.max()} lines"
        raise _error(path, found, "each marker once in a frame")

    def filled(names: tuple[str, ...]) -> Array:
        values = np.full((len(frames), *shape, len(names)), np.nan)
        values[frame, row, col] = np.stack([columns[name] for name in names], axis=-1)
        return values

    arrays = {POSITION: filled(("x", "y", "z") if "z" in columns else ("x", "y"))}
    if {"ox", "oy"} <= columns.keys():
        arrays[REFERENCE] = filled(("ox", "oy"))[0]
    if TIME in columns:
        arrays[TIME] = np.full(len(frames), np.nan)
        arrays[TIME][frame] = columns[TIME]
    return arrays


def _on_grid(path: Path, name: str, values: NDArray[Any], shape: tuple[int, int]) -> Array:
    """Positions (frames, rows, cols, 3); z is NaN where there are x and y alone."""
    rows, cols = shape
    fits = values.ndim >= 3 and values.shape[1:-1] in (shape, (rows * cols,))
    if not fits or values.shape[-1] not in (2, 3) or not len(values):
        frames = values.shape if name == POSITION else values.shape[1:]
        first = "frames, " if name == POSITION else ""
        expected = (
            f"the shape ({first}{rows}, {cols}, 2 or 3), or one axis of {rows * cols} for rows and "
            "columns"
        )
        raise _error(path, f"{name} of shape {frames}", expected)
    grid = np.full((len(values), rows, cols, 3), np.nan)
    grid[..., : values.shape[-1]] = values.reshape(len(values), rows, cols, -1)
    return np.where(np.isfinite(grid), grid, np.nan)


def _stamps(
    path: Path, arrays: Mapping[str, NDArray[Any]], frames: int, rate: float
) -> NDArray[np.int64]:
    name = next((name for name in (STAMPS, TIME) if name in arrays), "")
    if not name:
        return np.rint(np.arange(frames) * 1e9 / rate).astype(np.int64)
    times = arrays[name].ravel()
    if len(times) != frames or not np.isfinite(times).all() or times[0] < 0:
        found = f"{name} of {len(times)} numbers, the first {times[0] if len(times) else 'nothing'}"
        raise _error(path, found, f"{frames} numbers of at least 0, one for each frame")
    back = np.flatnonzero(np.diff(times) <= 0)
    if back.size:
        k = int(back[0])
        raise _error(path, f"{name} {times[k + 1]} after {times[k]}, frame {k + 1}", "rising times")
    if name == STAMPS:
        return times.astype(np.int64)
    return np.rint(times * 1e9).astype(np.int64)


def _scale(path: Path, rest: Array, pattern: Pattern, unit: str) -> float:
    """Metres of one unit; raises FrameSourceError unless the markers at rest fit the pattern."""
    known = np.isfinite(rest[..., :2]).all(axis=-1)
    if known.mean() < LEAST_KNOWN:
        found = f"{known.sum()} of {known.size} markers at rest"
        raise _error(path, found, "at least half of them, and NaN for the others")
    steps = np.concatenate([np.diff(rest[..., axis], axis=1 - axis).ravel() for axis in (0, 1)])
    steps = steps[np.isfinite(steps)]
    low, middle, high = np.quantile(steps, (STRAY_SHARE, 0.5, 1 - STRAY_SHARE))
    scale = UNITS[unit] if unit != PIXELS else pattern.pitch / abs(middle or np.nan)
    if not LEAST_STEP * pattern.pitch <= scale * low <= scale * high <= MOST_STEP * pattern.pitch:
        found = (
            f"distances of {low:.4g} to {high:.4g} {unit} between neighbours at rest, along x and y"
        )
        expected = (
            f"the pitch of the description, {1e3 * pattern.pitch:.4g} mm; x grows with the "
            "column, y with the row; --unit sets the unit of lengths"
        )
        raise _error(path, found, expected)
    return float(scale)


def _error(path: Path, found: str, expected: str) -> FrameSourceError:
    return FrameSourceError(f"{path}: found {found}, expected {expected}")
