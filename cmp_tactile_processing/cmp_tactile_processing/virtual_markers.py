"""Virtual markers: points along the gridlines between the corners (paper, III.C)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.grid import GridShape, Status
from cmp_tactile_processing.gridline_curves import curve_points
from cmp_tactile_processing.prepared_image import PreparedImage
from cmp_tactile_processing.virtual_marker_correction import (
    CORNER_CLEARANCE as CLEARANCE,
)
from cmp_tactile_processing.virtual_marker_correction import WEAKEST_GRADIENT as WEAKEST
from cmp_tactile_processing.virtual_marker_correction import correct_markers
from cmp_tactile_processing.virtual_marker_curves import fit_curves, set_tangents
from cmp_tactile_processing.virtual_marker_fusion import (
    FitScratch,
    Fits,
    MarkerBasis,
    fit_segments,
    share_of_models,
)
from cmp_tactile_processing.virtual_marker_placing import Markers, place_markers, set_sizes
from cmp_tactile_processing.virtual_marker_ridge import (
    BOX,
    COLUMNS,
    WINDOW,
    Edges,
    Pixels,
    Segments,
    look_half_way,
    measure,
)

__all__ = ["VirtualMarkerLocator", "VirtualMarkers", "locate_virtual_markers"]

METHODS = ("fused", "local_correction")
# Rounding to grey levels alone is as much noise as this, grey levels.
QUANTISATION = 0.29
# An image is taken to be smoothed by this much at least, px.
LEAST_SMOOTHING_PX = 0.5

# How far from the curve through the corners the gradient's peak is looked for, px.
SEARCH_PX = 2
# Closer to a corner than this many standard deviations of the edges' blur the crossing gridline
# bends the gradient's ridge.
CORNER_CLEARANCE = 3.0
# A gradient below this share of the median on all gridlines is no edge.
WEAKEST_GRADIENT = 0.25


@dataclass(frozen=True)
class VirtualMarkers:
    """position (a, b, n, 2) px, status (a, b, n), std (a, b, n): across the gridline, px."""

    position: NDArray[np.float64]
    status: NDArray[np.uint8]
    std: NDArray[np.float64] | None = None


class VirtualMarkerLocator:
    """Finds the virtual markers of frame after frame; its buffers are kept.

    method: "fused", the gradient's ridge fused with the curve through the corners, or
    "local_correction", the paper's alone.  Raises ParameterError for another one.
    """

    def __init__(self, shape: GridShape, method: str = "fused") -> None:
        if method not in METHODS:
            msg = f"virtual_markers: found {method!r}, expected one of {', '.join(METHODS)}"
            raise ParameterError(msg)
        self._fused = method == "fused"
        n = shape.points_per_segment
        self._rows = _Gridlines(shape.rows, shape.cols, n)
        self._cols = _Gridlines(shape.cols, shape.rows, n)

    def locate(
        self,
        image: PreparedImage,
        corners: NDArray[np.float64],
        corner_std: NDArray[np.float64],
        doubtful_rows: NDArray[np.bool_] | None = None,
        doubtful_cols: NDArray[np.bool_] | None = None,
    ) -> tuple[VirtualMarkers, VirtualMarkers]:
        """Virtual markers along the rows (rows, cols-1, n) and the columns (rows-1, cols, n).

        corners (rows, cols, 2) px, NaN where missing: no marker lies next to these; corner_std
        (rows, cols) px; doubtful_*: markers that must not be measured, in the results' shape.
        """
        rows, cols = self._rows, self._cols
        rows.load(corners, corner_std)
        cols.load(corners.swapaxes(0, 1), corner_std.T)
        rows.doubt(doubtful_rows, cols.tangent)
        cols.doubt(None if doubtful_cols is None else doubtful_cols.swapaxes(0, 1), rows.tangent)
        height, width = image.smooth.shape
        pixels = Pixels(np.ascontiguousarray(image.smooth).reshape(-1), width, height)
        for lines in (rows, cols):
            lines.look_half_way(pixels)
        blurs = np.concatenate([rows.half_way[1].ravel(), cols.half_way[1].ravel()])
        blur = _median(blurs)
        for lines in (rows, cols):
            edges = _edges(image, blur, lines.half_way[0])
            if self._fused:
                lines.fuse(pixels, edges)
            else:
                lines.correct(pixels, edges, image)
        return rows.result(), cols.result(transposed=True)


def _median(values: NDArray[np.float64]) -> float:
    """Median of the finite values, NaN for none."""
    seen = values[np.isfinite(values)]
    return float(np.median(seen)) if len(seen) else math.nan


def _edges(image: PreparedImage, blur: float, gradient: NDArray[np.float64]) -> Edges:
    """Properties of the edges, blurred by `blur` px^2, with these gradients half way along."""
    noise = max(image.noise, QUANTISATION)
    across = math.sqrt(image.smoothing_px**2 + BOX + WINDOW**2)
    along = max(image.smoothing_px, LEAST_SMOOTHING_PX)
    return Edges(
        blur=blur,
        gradient=_median(np.abs(gradient)),
        sign=1.0 if np.count_nonzero(gradient > 0) >= np.count_nonzero(gradient < 0) else -1.0,
        # White noise of the image, seen by the second and the first derivative of a Gaussian.
        noise=noise**2 * 3 / (8 * math.sqrt(math.pi) * across**5),
        gradient_noise=noise / math.sqrt(8 * math.pi * across**3 * along),
    )


class _Gridlines:
    """Buffers of all gridlines of one direction: a lines of b corners, n markers between two."""

    def __init__(self, a: int, b: int, n: int) -> None:
        segments = a * (b - 1)
        self.corners = np.empty((a, b, 2))
        self.corner_std = np.empty((a, b))
        self.tangent = np.empty((a, b, 2))
        self.crossing = np.empty((a, b, 2))
        self.curve = np.empty((a, b - 1, 4, 2))
        self.half_way = np.empty((2, a, b - 1))
        self._doubt = np.zeros((a, b - 1, n), dtype=np.bool_)
        self._no_doubt = np.zeros((a, b - 1, 0), dtype=np.bool_)
        self._doubtful = self._no_doubt
        self._size, self._end_std = np.empty((2, segments)), np.empty((2, segments))
        self._counts = np.empty(segments, dtype=np.int64)
        self._columns = np.empty((5, COLUMNS, segments))
        self._basis = MarkerBasis.of(n)
        self._fits = Fits.of(segments, n)
        self._work = FitScratch.new()
        self._turned, self._normals = np.empty((4, 2)), np.empty((2, 3))
        self._markers = Markers.of(a, b - 1, n)

    def load(self, corners: NDArray[np.float64], corner_std: NDArray[np.float64]) -> None:
        self.corners[:] = corners
        self.corner_std[:] = corner_std
        set_tangents(self.corners, self.tangent)
        fit_curves(self.corners, self.tangent, self.curve)

    def doubt(self, doubtful: NDArray[np.bool_] | None, crossing: NDArray[np.float64]) -> None:
        """Take over the doubtful markers and the tangents of the gridlines that cross these."""
        self._doubtful = self._no_doubt
        if doubtful is not None:
            self._doubt[:] = doubtful
            self._doubtful = self._doubt
        self.crossing[:] = crossing.swapaxes(0, 1)

    def look_half_way(self, pixels: Pixels) -> None:
        look_half_way(pixels, self.curve, self._turned, self.half_way)

    def fuse(self, pixels: Pixels, edges: Edges) -> None:
        if math.isnan(edges.blur):
            self._counts[:] = 0
            self._columns[:] = 0
        else:
            segments = Segments(self.corners, self.crossing, self.curve, self._doubtful)
            scratch = (self._turned, self._normals)
            measure(pixels, edges, segments, scratch, self._counts, self._columns)
        set_sizes(self.curve, self.corner_std, self._size, self._end_std)
        fit_segments(
            self._size, self._end_std, self._counts, self._columns, self._basis, self._fits,
            self._work,
        )  # fmt: skip
        share_of_models(self._counts, self._fits)
        place_markers(self.curve, self._counts, self._columns, self._fits, self._markers)

    def correct(self, pixels: Pixels, edges: Edges, image: PreparedImage) -> None:
        seen = edges.blur > 0
        clearance = CLEARANCE * math.sqrt(edges.blur + BOX) if seen else math.inf
        smoothing = max(image.smoothing_px, LEAST_SMOOTHING_PX)
        # Difference of the gradients two pixels apart, each over two pixels.
        noise = max(image.noise, QUANTISATION) * 0.31 / smoothing**3
        settings = (clearance, WEAKEST * edges.gradient, noise)
        correct_markers(
            *pixels, self.corners, self.curve, self.corner_std, self._doubtful, settings,
            *self._markers,
        )  # fmt: skip

    def result(self, transposed: bool = False) -> VirtualMarkers:
        """Fresh arrays; transposed: gridlines run along the first axis."""
        arrays = (item.swapaxes(0, 1) if transposed else item for item in self._markers)
        position, status, std = (item.copy() for item in arrays)
        return VirtualMarkers(position, status, std)


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
