"""Forces of a recording: arrays and table of one frame, and what was the matter in all frames."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.force.advice import ADVICE, flag_names, single_flags
from cmp_tactile_processing.measured.force_field import ForceField, ForceFlag, SlipState

__all__ = ["COLUMNS", "COLUMN_TYPES", "ForceFlags", "force_arrays", "table_row", "unit_of"]

WRENCH = ("fx_N", "fy_N", "fz_N", "mx_Nm", "my_Nm", "mz_Nm")
SLIP_FIGURES = ("slip_ratio", "traction_ratio", "friction_coefficient", "friction_std")
COLUMNS = (
    "stamp_ns",
    "time_s",
    *WRENCH,
    "contact_area_m2",
    *(f"std_{name}" for name in WRENCH),
    "contacts",
    "slip_state",
    "slip",
    *SLIP_FIGURES,
    "flags",
    "flag_names",
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
    "stamp_fault": "string",
}
UNITS = {"s": "s", "N": "N", "Nm": "N m", "m2": "m^2", "ns": "ns"}
# These spoil the forces; too few markers are told with the views' faults, and the others belong to
# ordinary use.
WARNED_OF = ForceFlag.NOT_CONVERGED | ForceFlag.POOR_FIT | ForceFlag.IMPLAUSIBLE


def force_arrays(force: ForceField) -> dict[str, NDArray[Any]]:
    """Everything that a force field tells, by name; what it came without is NaN.

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
    stamp_ns: int, force: ForceField, begin_ns: int, stamp_fault: str = ""
) -> list[float | str]:
    """The values of COLUMNS; slip state and flags as numbers, as in ForceField.msg, and by name.

    begin_ns: the stamp from which time_s counts.  stamp_fault: what is wrong with the stamp, in a
    word; empty for nothing.
    """
    slip = (getattr(force.slip, name) for name in SLIP_FIGURES)
    return [
        stamp_ns,
        (stamp_ns - begin_ns) * 1e-9,
        *force.wrench.tolist(),
        force.contact_area,
        *force.wrench_std.tolist(),
        len(force.contacts),
        int(force.slip_state),
        SlipState(force.slip_state).name.lower(),
        *slip,
        int(force.flags),
        flag_names(force.flags, " "),
        stamp_fault,
    ]


def unit_of(column: str) -> str:
    """The unit of one of COLUMNS, which its name ends in; "1" for a plain number."""
    return UNITS.get(column.rpartition("_")[2], "1")


class ForceFlags:
    """Counts the frames of a recording whose force is not to be trusted."""

    def __init__(self) -> None:
        self._frames = 0
        self._flagged: dict[ForceFlag, int] = {}

    def add(self, force: ForceField) -> None:
        """Take the force field of a frame into account."""
        self._frames += 1
        for flag in single_flags(force.flags & WARNED_OF):
            self._flagged[flag] = self._flagged.get(flag, 0) + 1

    @property
    def doubts(self) -> Iterator[str]:
        """A line for each flag that was set."""
        for flag, count in self._flagged.items():
            yield f"in {count} of {self._frames} frames {flag_names(flag)}: {ADVICE[flag]}"
