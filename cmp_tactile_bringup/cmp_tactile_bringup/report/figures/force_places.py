"""Where the nodes of a force field have moved to, as far as the markers under them tell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.report.results import DemoResults, FrameResult
from cmp_tactile_processing.measured.force_field import ForceField

__all__ = ["measured_places", "node_axes", "true_places"]


def measured_places(frame: FrameResult) -> NDArray[np.float64]:
    """x and y of the nodes of a frame's force on the deformed gel, (rows, cols, 2) mm."""
    surface = frame.surface
    return _places(frame.force, surface.reference, surface.displacement)


def true_places(results: DemoResults, index: int, force: ForceField) -> NDArray[np.float64]:
    """The same of the true force of a frame, from the true markers."""
    corners = results.recording.truth.corners_m
    return _places(force, corners[0], corners[index] - corners[0])


def node_axes(force: ForceField) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x of the columns and y of the rows of the node grid at rest, m."""
    position = force.position.reshape(force.rows, force.cols, 3)
    return position[0, :, 0], position[:, 0, 1]


def _places(
    force: ForceField, at_rest: NDArray[np.float64], displacement: NDArray[np.float64]
) -> NDArray[np.float64]:
    """From the markers (m, n, 3) at rest and their displacement, m; beyond them as at the edge."""
    x, y = node_axes(force)
    rest = np.stack(np.meshgrid(x, y), axis=-1)
    # The reference of a marker that was never seen is not known; the grid is regular.
    marker_x = np.linspace(np.nanmin(at_rest[..., 0]), np.nanmax(at_rest[..., 0]), at_rest.shape[1])
    marker_y = np.linspace(np.nanmin(at_rest[..., 1]), np.nanmax(at_rest[..., 1]), at_rest.shape[0])
    moved = np.stack(
        [_at(displacement[..., k], (marker_x, marker_y), (x, y)) for k in (0, 1)], axis=-1
    )
    return (rest + np.nan_to_num(moved)) * 1e3


def _at(
    values: NDArray[np.float64],
    known_at: tuple[NDArray[np.float64], NDArray[np.float64]],
    wanted_at: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Values of a regular grid between its points, bridged where NaN; NaN where all are."""
    rows = [_bridged(known_at[0], row, wanted_at[0]) for row in values]
    return np.stack([_bridged(known_at[1], col, wanted_at[1]) for col in np.array(rows).T], axis=1)


def _bridged(
    at: NDArray[np.float64], values: NDArray[np.float64], wanted: NDArray[np.float64]
) -> NDArray[np.float64]:
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(wanted), np.nan)
    return np.interp(wanted, at[known], values[known])
