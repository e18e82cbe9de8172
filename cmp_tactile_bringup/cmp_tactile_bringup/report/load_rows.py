"""Loads of a material calibration as people read them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cmp_tactile_processing.calibration.material_outcome import LoadResult

__all__ = ["LOAD_HEADINGS", "LoadRow", "load_rows"]

LOAD_HEADINGS = ("Load", "", "Reference", "Before", "After", "Std", "Off", "")
AXES = ("Fx", "Fy", "Fz")
# Components below this share of the force are only told where they were meant to be there.
LEAST_SHARE = 0.05


@dataclass(frozen=True)
class LoadRow:
    """One component of a load, N.  off: what the sensor shows too much, in per cent of the load."""

    name: str
    component: str
    reference: str
    before: str
    after: str
    std: str
    off: str
    remark: str

    @property
    def texts(self) -> tuple[str, ...]:
        """What stands below LOAD_HEADINGS."""
        return (
            self.name,
            self.component,
            self.reference,
            self.before,
            self.after,
            self.std,
            self.off,
            self.remark,
        )


def load_rows(loads: Sequence[LoadResult]) -> list[LoadRow]:
    """Rows of all loads: each known component that is a good part of its force."""
    return [row for load in loads for row in _rows(load)]


def _rows(load: LoadResult) -> list[LoadRow]:
    known = np.isfinite(load.reference)
    size = float(np.linalg.norm(load.reference[known]))
    rows: list[LoadRow] = []
    for axis, component in enumerate(AXES):
        if not known[axis] or abs(load.reference[axis]) < LEAST_SHARE * size:
            continue
        off = load.residual_after[axis] / size if size else math.nan
        rows.append(
            LoadRow(
                name="" if rows else load.name,
                component=component,
                reference=_force(load.reference[axis]),
                before=_force(load.before[axis]),
                after=_force(load.after[axis]),
                std=_force(load.after_std[axis]),
                # Towards 0 or away from it: forces into the gel are negative.
                off=f"{100 * off * math.copysign(1, load.reference[axis]):+.1f} %",
                remark="" if load.used or rows else f"left out: {load.reason}",
            )
        )
    return rows


def _force(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"
