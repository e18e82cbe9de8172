"""Virtual markers by local sub-pixel correction (paper, III.C)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.grid import Status
from cmp_tactile_processing.gridline_curves import curve_points

__all__ = ["VirtualMarkers", "locate_virtual_markers"]

# How far from the curve through the corners the gradient's peak is looked for, px.
SEARCH_PX = 2
# Closer to a corner than this many standard deviations of the edges' blur the crossing gridline
# bends the gradient's ridge.
CORNER_CLEARANCE = 3.0
# A gradient below this share of the median on all gridlines is no edge.
WEAKEST_GRADIENT = 0.25


@dataclass(frozen=True)
class VirtualMarkers:
    """position (a, b-1, n, 2) px, status (a, b-1, n)."""

    position: NDArray[np.float64]
    status: NDArray[np.uint8]


def locate_virtual_markers(
    smooth: NDArray[np.float32], corners: NDArray[np.float64], count: int
) -> VirtualMarkers:
    """Virtual markers between neighbours along axis 1 of corners (a, b, 2) px.

    smooth: smoothed view image, (H, W) grey.  Starts from the cubic through the corners.  In the
    local zone of each marker - two neighbouring pixel columns, or rows for a steep gridline - the
    gradient's peak is found by a quadratic through three pixels; the marker lies on the straight
    line through the two peaks.  Markers without a clear peak, or too close to a corner, keep the
    curve's position as predicted.
    """
    start = curve_points(corners, count)
    flat = start.reshape(-1, 2)
    chord = np.repeat((corners[:, 1:] - corners[:, :-1]).reshape(-1, 2), count, axis=0)
    lines = _Lines(smooth, flat, np.abs(chord[:, 1]) > np.abs(chord[:, 0]))
    finite = np.isfinite(flat).all(axis=1)
    position, measured = flat.copy(), np.zeros(len(flat), dtype=bool)
    # Half way between two corners the edge is at its clearest: it tells blur and strength.
    half_way = finite & (np.arange(len(flat)) % max(count, 1) == count // 2)
    _, strength, blur = lines.corrected(np.flatnonzero(half_way))
    if np.isfinite(blur).any():
        clearance = CORNER_CLEARANCE * float(np.nanmedian(blur))
        weakest = WEAKEST_GRADIENT * float(np.nanmedian(strength))
        chosen = np.flatnonzero(finite & _clear_of_corners(start, corners, clearance).ravel())
        corrected, strength, _ = lines.corrected(chosen)
        good = (strength > weakest) & np.isfinite(corrected).all(axis=1)
        position[chosen[good]], measured[chosen[good]] = corrected[good], True
    status = np.where(measured, Status.MEASURED, np.where(finite, Status.PREDICTED, Status.MISSING))
    return VirtualMarkers(
        position.reshape(start.shape), status.astype(np.uint8).reshape(start.shape[:-1])
    )


@dataclass(frozen=True)
class _Lines:
    """Starting points (n, 2) px on gridlines of a smoothed image; steep (n,): scanned along x."""

    smooth: NDArray[np.float32]
    points: NDArray[np.float64]
    steep: NDArray[np.bool_]

    def corrected(
        self, chosen: NDArray[np.intp]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Corrected points, gradient and blur there, of the chosen starting points."""
        position = self.points[chosen]
        strength = np.full(len(chosen), np.nan)
        blur = np.full(len(chosen), np.nan)
        for scan_x in (False, True):
            part = np.flatnonzero(self.steep[chosen] == scan_x)
            image = self.smooth.T if scan_x else self.smooth
            axes = [1, 0] if scan_x else [0, 1]
            ridge = _ridge(image, position[part][:, axes])
            position[part, axes[1]], strength[part], blur[part] = ridge
        return position, strength, blur


def _ridge(
    image: NDArray[np.float32], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The gradient's ridge near points (n, 2) = (along, across); image is [across, along].

    Returns the corrected second coordinate, the gradient there and the standard deviation of the
    edge's blur, px; NaN where there is no peak.
    """
    along = np.floor(points[:, 0]).astype(np.intp)
    across = np.rint(points[:, 1]).astype(np.intp)
    reach = SEARCH_PX + 2
    inside = (along >= 0) & (along + 1 < image.shape[1])
    inside &= (across >= reach) & (across + reach < image.shape[0])
    along, across = np.where(inside, along, 0), np.where(inside, across, reach)
    span = np.arange(-reach, reach + 1)
    zone = image[(across[:, None] + span)[:, None, :], (along[:, None] + [0, 1])[:, :, None]]
    gradient = np.abs(zone[:, :, 2:] - zone[:, :, :-2]) / 2
    peak = gradient[:, :, 1:-1].argmax(axis=2) + 1
    left, top, right = (
        np.take_along_axis(gradient, (peak + d)[:, :, None], axis=2)[:, :, 0].astype(np.float64)
        for d in (-1, 0, 1)
    )
    bend = left - 2 * top + right
    with np.errstate(invalid="ignore", divide="ignore"):
        peaked = (bend < 0) & (top >= left) & (top >= right)
        offset = np.where(peaked, (left - right) / 2 / bend, np.nan)
        # A Gaussian profile has top / bend = -sigma^2.
        blur = np.sqrt(np.where(peaked, -top / bend, np.nan)).mean(axis=1)
    line = across[:, None] + peak + 1 - reach + offset
    share = points[:, 0] - along
    result = line[:, 0] * (1 - share) + line[:, 1] * share
    # Two peaks that lie on different edges give no line.
    result[~inside | ~(np.abs(line[:, 1] - line[:, 0]) < 2.0)] = np.nan
    return result, top.min(axis=1), np.where(inside, blur, np.nan)


def _clear_of_corners(
    start: NDArray[np.float64], corners: NDArray[np.float64], clearance_px: float
) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        gaps = [
            np.linalg.norm(start - end[:, :, None], axis=-1) >= clearance_px
            for end in (corners[:, :-1], corners[:, 1:])
        ]
    return np.asarray(gaps[0] & gaps[1])
