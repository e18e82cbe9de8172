"""Virtual markers: points along the gridlines between the corners (paper, III.C)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.measured.grid import GridShape
from cmp_tactile_processing.tracking.virtual_markers.correction import (
    CORNER_CLEARANCE,
    WEAKEST_GRADIENT,
    Zone,
    correct_markers,
)
from cmp_tactile_processing.tracking.virtual_markers.curves import fit_curves, set_tangents
from cmp_tactile_processing.tracking.virtual_markers.fusion import (
    Fits,
    FitScratch,
    MarkerBasis,
    fit_segments,
    share_of_models,
)
from cmp_tactile_processing.tracking.virtual_markers.placing import (
    Markers,
    place_markers,
    set_sizes,
)
from cmp_tactile_processing.tracking.virtual_markers.ridge import (
    BOX,
    COLUMNS,
    LEAST_SIGNAL,
    WINDOW,
    Edges,
    Pixels,
    Segments,
    look_half_way,
    measure,
)

__all__ = ["VirtualMarkerLocator", "VirtualMarkers"]

METHODS = ("fused", "local_correction")
# Rounding to grey levels alone is as much noise as this, grey levels.
QUANTISATION = 0.29
# An image is taken to be smoothed by this much at least, px.
LEAST_SMOOTHING_PX = 0.5


@dataclass(frozen=True)
class VirtualMarkers:
    """position (a, b, n, 2) px, status (a, b, n), std (a, b, n): across the gridline, px."""

    position: NDArray[np.float64]
    status: NDArray[np.uint8]
    std: NDArray[np.float64]


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
        self._count = n = shape.points_per_segment
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
        if self._count == 0:
            return rows.result(), cols.result(transposed=True)
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
    """Median of the finite values, the upper of two, NaN for none."""
    seen = values[np.isfinite(values)]
    middle = len(seen) // 2
    return float(np.partition(seen, middle)[middle]) if len(seen) else math.nan


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


def _zone(image: PreparedImage, edges: Edges) -> Zone:
    """What the local zones of the correction must show in an image with such edges."""
    smoothing = max(image.smoothing_px, LEAST_SMOOTHING_PX)
    # Correlation of smoothed noise two and four pixels apart.
    near, far = math.exp(-((1 / smoothing) ** 2)), math.exp(-((2 / smoothing) ** 2))
    smoothed = max(image.noise, QUANTISATION) / (2 * math.sqrt(math.pi) * smoothing)
    gradient_noise = smoothed * math.sqrt(2 - 2 * near) / 2
    return Zone(
        clearance=CORNER_CLEARANCE * math.sqrt(edges.blur + BOX),
        weakest=max(WEAKEST_GRADIENT * edges.gradient, LEAST_SIGNAL * gradient_noise),
        noise=smoothed * math.sqrt(6 - 8 * near + 2 * far) / 4,
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
        self._columns = np.zeros((5, COLUMNS, segments))
        self._basis = MarkerBasis.from_count(n)
        self._fits = Fits.from_shape(segments, n)
        self._work = FitScratch.new()
        self._turned, self._normals = np.empty((4, 2)), np.empty((2, 3))
        self._markers = Markers.from_segment(a, b - 1, n)

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
            self._columns[2] = 0
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
        segments = Segments(self.corners, self.crossing, self.curve, self._doubtful)
        correct_markers(pixels, segments, self.corner_std, _zone(image, edges), self._markers)

    def result(self, transposed: bool = False) -> VirtualMarkers:
        """Fresh arrays; transposed: gridlines run along the first axis."""
        arrays = (item.swapaxes(0, 1) if transposed else item for item in self._markers)
        position, status, std = (item.copy() for item in arrays)
        return VirtualMarkers(position, status, std)
