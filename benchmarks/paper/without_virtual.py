"""A measurement without its virtual markers: what the corners alone tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cmp_tactile_processing.measured.grid import Status
from cmp_tactile_processing.measured.surface import Surface

__all__ = ["without_virtual"]


def without_virtual(surface: Surface) -> Surface:
    """The surface with its corners as they are and no virtual marker."""
    rows, cols = surface.row_status, surface.col_status
    return replace(
        surface,
        row_position=np.full((*rows.shape, 3), np.nan),
        row_status=np.full_like(rows, Status.MISSING),
        row_std=np.full_like(surface.row_std, np.nan),
        col_position=np.full((*cols.shape, 3), np.nan),
        col_status=np.full_like(cols, Status.MISSING),
        col_std=np.full_like(surface.col_std, np.nan),
    )
