"""Loads of a material calibration as people read them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.material.loads import LoadResult

__all__ = ["AXES", "LOAD_HEADINGS", "LoadRow", "load_rows", "told_components"]

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


def told_components(load: LoadResult) -> NDArray[np.bool_]:
    """Which components (3,) are known, and a good part of the force."""
    known = np.isfinite(load.reference)
    return np.asarray(known & (np.abs(load.reference) >= LEAST_SHARE * _size(load)))


def _size(load: LoadResult) -> float:
    return float(np.linalg.norm(load.reference[np.isfinite(load.reference)]))


def load_rows(loads: Sequence[LoadResult]) -> list[LoadRow]:
    """Rows of all loads: each known component that is a good part of its force."""
    return [row for load in loads for row in _rows(load)]


def _rows(load: LoadResult) -> list[LoadRow]:
    size = _size(load)
    rows: list[LoadRow] = []
    for axis in np.flatnonzero(told_components(load)):
        off = load.residual_after[axis] / size if size else math.nan
        rows.append(
            LoadRow(
                name="" if rows else load.name,
                component=AXES[axis],
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
