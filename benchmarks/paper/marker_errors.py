"""Sums of marker errors: mean absolute, root mean square, largest; by axis, and by region."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface import Surface
from paper.mechanics import Mechanics

__all__ = ["all_markers", "in_contact", "largest", "mean_absolute", "root_mean_square", "virtual"]

Array = NDArray[np.float64]


def virtual(surface: Surface, truth: Surface) -> Array:
    """Position errors of the virtual markers (n, 3), m, each from its own true point.

    That counts also what the image does not show, where along its gridline a marker is.
    """
    rows = surface.row_position - truth.row_position
    cols = surface.col_position - truth.col_position
    return np.concatenate([rows.reshape(-1, 3), cols.reshape(-1, 3)])


def all_markers(surface: Surface, truth: Surface) -> Array:
    """Position errors of corners and virtual markers (n, 3), m; NaN where missing."""
    corners = (surface.position - truth.position).reshape(-1, 3)
    return np.concatenate([corners, virtual(surface, truth)])


def mean_absolute(error: NDArray[np.floating]) -> Array:
    """(4,): along x, y, z, and as distance, of errors (..., 3); NaN where nothing is known."""
    known = _known(error)
    if not len(known):
        return np.full(4, np.nan)
    return np.append(np.abs(known).mean(axis=0), np.linalg.norm(known, axis=1).mean())


def root_mean_square(error: NDArray[np.floating]) -> Array:
    """(3,): along x, y, z, of errors (..., 3); NaN where nothing is known."""
    known = _known(error)
    return np.sqrt(np.mean(known**2, axis=0)) if len(known) else np.full(3, np.nan)


def largest(error: NDArray[np.floating]) -> Array:
    """(3,): the largest size along x, y, z, of errors (..., 3); NaN where nothing is known."""
    known = _known(error)
    return np.abs(known).max(axis=0) if len(known) else np.full(3, np.nan)


def in_contact(mechanics: Mechanics, frame: int, reference: Array) -> NDArray[np.bool_]:
    """Which markers (rows, cols, 3) at rest lie nearest to a node that is in contact."""
    nodes = mechanics.node_position[:, :2]
    flat = reference[..., :2].reshape(-1, 1, 2)
    nearest = np.argmin(((flat - nodes) ** 2).sum(axis=-1), axis=1)
    return np.asarray(mechanics.contact[frame][nearest].reshape(reference.shape[:2]))


def _known(error: NDArray[np.floating]) -> Array:
    flat = np.asarray(error, dtype=np.float64).reshape(-1, 3)
    return flat[np.isfinite(flat).all(axis=1)]
