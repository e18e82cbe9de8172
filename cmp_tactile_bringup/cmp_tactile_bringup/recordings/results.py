"""Results of a recording: arrays and table row of each frame, and what was wrong in all of them."""

from __future__ import annotations

import math
import shutil
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.files import atomic_path
from cmp_tactile_processing.errors import Finding, Severity, warnings_of
from cmp_tactile_processing.force.advice import (
    RECORDED_ADVICE,
    UNUSABLE,
    flag_names,
    single_flags,
)
from cmp_tactile_processing.measured import ForceField, ForceFlag, Grid, GridFault, SlipState

WRENCH = ("fx_N", "fy_N", "fz_N", "mx_Nm", "my_Nm", "mz_Nm")
SLIP_FIGURES = ("slip_ratio", "traction_ratio", "friction_coefficient", "friction_std")
COLUMNS = (
    "stamp_ns",
    "time_s",
    *WRENCH,
    "contact_area_m2",
    *(f"std_{name}" for name in WRENCH),
    *(f"systematic_{name}" for name in WRENCH),
    "contacts",
    "slip_state",
    "slip",
    *SLIP_FIGURES,
    "flags",
    "flag_names",
    "usable",
    "stamp_fault",
)
# The types of the columns that are not floating-point numbers.
COLUMN_TYPES = {
    "stamp_ns": "int64",
    "contacts": "uint16",
    "slip_state": "uint8",
    "slip": "string",
    "flags": "uint16",
    "flag_names": "string",
    "usable": "uint8",
    "stamp_fault": "string",
}
# A word of the column stamp_fault: the picture is not of this time, but the one before.
OLD_PICTURE = "old_picture"
UNITS = {"s": "s", "N": "N", "Nm": "N m", "m2": "m^2", "ns": "ns"}
# Longest name of a fault: an array of texts has one length.
FAULT_TYPE = f"U{max(len(fault.value) for fault in GridFault)}"


def force_arrays(force: ForceField) -> dict[str, NDArray[Any]]:
    """Everything in a force field, by name; what it came without is NaN.

    contact_number (nodes,): 0 outside all contacts, 1 in the strongest, 2 in the next.
    """
    deviations = force.force_std
    numbers = np.zeros(len(force.contact), np.uint16)
    for number, contact in enumerate(force.contacts, 1):
        numbers[contact.nodes] = number
    return {
        "node_position": force.position,
        "force": force.force,
        "force_std": np.full(force.force.shape, np.nan) if deviations is None else deviations,
        "contact": force.contact,
        "contact_number": numbers,
        "wrench": force.wrench,
        "wrench_covariance": force.wrench_covariance,
        "systematic_covariance": force.systematic_covariance,
        "contact_area": np.array(force.contact_area, np.float64),
        "centre_of_pressure": force.centre_of_pressure,
        "valid_fraction": np.array(force.valid_fraction, np.float64),
        "slip_state": np.array(force.slip_state, np.uint8),
        **{name: np.array(getattr(force.slip, name), np.float64) for name in SLIP_FIGURES},
        "flags": np.array(force.flags, np.uint16),
        "noise_scale": np.array(force.noise_scale, np.float64),
        "corrected": np.array(force.corrected, np.bool_),
        "relaxed": np.array(force.relaxed, np.bool_),
    }


def table_row(
    stamp_ns: int, time_s: float, force: ForceField, stamp_fault: str = ""
) -> list[float | str]:
    """The values of COLUMNS; slip state and flags as numbers, as in ForceField.msg, and by name.

    time_s: from the first frame of its recording.  stamp_fault: what is wrong with the stamp, in a
    word; empty for nothing; after it OLD_PICTURE, where it is.
    """
    slip = (getattr(force.slip, name) for name in SLIP_FIGURES)
    return [
        stamp_ns,
        time_s,
        *force.wrench.tolist(),
        force.contact_area,
        *force.wrench_std.tolist(),
        *force.systematic_std.tolist(),
        len(force.contacts),
        int(force.slip_state),
        SlipState(force.slip_state).name.lower(),
        *slip,
        int(force.flags),
        flag_names(force.flags, " "),
        int(not force.flags & UNUSABLE and OLD_PICTURE not in stamp_fault),
        stamp_fault,
    ]


def unit_of(column: str) -> str:
    """The unit of one of COLUMNS, which its name ends in; "1" for a plain number."""
    return UNITS.get(column.rpartition("_")[2], "1")


class ForceFlags:
    """Counts the frames of a recording with each flag."""

    def __init__(self) -> None:
        self._frames = self._unusable = 0
        self._flagged: Counter[ForceFlag] = Counter()

    def add(self, force: ForceField) -> None:
        """Take the force field of a frame into account."""
        self._frames += 1
        self._unusable += bool(force.flags & UNUSABLE)
        self._flagged.update(single_flags(force.flags))

    @property
    def findings(self) -> Iterator[Finding]:
        """In how many frames the force must not be used, and a line for each flag that was set."""
        if self._unusable:
            count = f"{self._unusable} of {self._frames} frames"
            yield from warnings_of(f"do not use the force of {count} (column usable)")
        for flag in sorted(self._flagged, key=lambda flag: not flag & UNUSABLE):
            frames = f"in {self._flagged[flag]} of {self._frames} frames {flag_names(flag)}"
            use = "not usable" if flag & UNUSABLE else "use with care"
            yield from warnings_of(f"{frames}: {use}; {RECORDED_ADVICE[flag]}")


def grid_arrays(grid: Grid) -> dict[str, NDArray[Any]]:
    """Everything in a grid, by name; what it came without is NaN."""
    return {
        "corners": grid.corners,
        "corner_status": grid.corner_status,
        "corner_std": _known(grid.corner_std, grid.corner_status),
        "row_lines": grid.row_lines,
        "row_line_status": grid.row_line_status,
        "row_line_std": _known(grid.row_line_std, grid.row_line_status),
        "col_lines": grid.col_lines,
        "col_line_status": grid.col_line_status,
        "col_line_std": _known(grid.col_line_std, grid.col_line_status),
        "confidence": np.array(grid.confidence, np.float64),
        "followed": np.array(grid.followed),
        "fault": np.array(grid.fault.value, FAULT_TYPE),
    }


def _known(values: NDArray[np.float64] | None, status: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.full(status.shape, np.nan) if values is None else values


class GridFaults:
    """Counts the frames of a recording in which a view's pattern was not found."""

    def __init__(self) -> None:
        self._frames = self._frames_with_fault = 0
        self._faulty: Counter[str] = Counter()
        self._last: dict[str, str] = {}

    def add(self, grids: dict[str, Grid | None]) -> None:
        """Take the grids of a frame, by view, into account."""
        self._frames += 1
        has_fault = False
        for view, grid in grids.items():
            # Parts of the pattern may be hidden at any time.
            if grid is not None and grid.fault not in (GridFault.NONE, GridFault.PARTLY_HIDDEN):
                self._faulty[view] += 1
                self._last[view] = f"{grid.fault.value}: {grid.reason}"
                has_fault = True
        self._frames_with_fault += has_fault

    @property
    def in_all(self) -> bool:
        """Whether all frames have a fault."""
        return 0 < self._frames == self._frames_with_fault

    @property
    def findings(self) -> Iterator[Finding]:
        """One for each view with faults, and an error where all frames have one."""
        for view, count in self._faulty.items():
            last = self._last[view]
            yield from warnings_of(f"{view} view: in {count} of {self._frames} frames {last}")
        if self.in_all:
            yield Finding(Severity.ERROR, f"all {self._frames} frames have a fault")


class ArrayLog:
    """Appends rows of named arrays; memory does not grow with their number.

    A context manager: the file appears, whole, when it is left without an error, and not before.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._folder = path.with_name(f".{path.name}.partial")
        self._files: dict[str, IO[bytes]] = {}
        self._rows: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        self._count = 0

    def __enter__(self) -> ArrayLog:
        if self._folder.exists():
            shutil.rmtree(self._folder)
        self._folder.mkdir(parents=True)
        return self

    def __exit__(self, *error: object) -> None:
        for file in self._files.values():
            file.close()
        try:
            if error[0] is None:
                self._assemble()
        finally:
            shutil.rmtree(self._folder)

    def append(self, row: Mapping[str, NDArray[Any]]) -> None:
        """Add one row; names, shapes and types must be those of the first row."""
        if not self._rows:
            for name, values in row.items():
                self._rows[name] = (values.dtype, values.shape)
                self._files[name] = (self._folder / f"{name}.raw").open("wb")
        found = {name: (values.dtype, values.shape) for name, values in row.items()}
        if found != self._rows:
            msg = f"found arrays {found}, expected {self._rows}"
            raise ValueError(msg)
        for name, values in row.items():
            self._files[name].write(np.ascontiguousarray(values).tobytes())
        self._count += 1

    def _assemble(self) -> None:
        with (
            atomic_path(self._path) as beside,
            zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        ):
            for name, (dtype, shape) in self._rows.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as target:
                    np.lib.format.write_array(target, self._column(name, dtype, shape))

    def _column(self, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        """All rows of an array, which stay on the disk."""
        rows = (self._count, *shape)
        # Nothing cannot be mapped.
        if not math.prod(rows):
            return np.empty(rows, dtype)
        return np.memmap(self._folder / f"{name}.raw", dtype, "r", shape=rows)
