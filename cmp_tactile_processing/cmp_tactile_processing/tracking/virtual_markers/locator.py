"""Virtual markers: points along the gridlines between the corners (paper, III.C)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.image.prepared import MIN_SMOOTHING_PX, PreparedImage
from cmp_tactile_processing.measured import GridShape, Status
from cmp_tactile_processing.tracking.virtual_markers.corner_fusion import (
    LINE_ENTRIES,
    fused_corners,
    gather_lines,
)
from cmp_tactile_processing.tracking.virtual_markers.fusion import (
    LANES,
    MARKER_BIAS_PX,
    Array,
    Fits,
    FitScratch,
    Index,
    MarkerBasis,
    Single,
    blocks_of,
    fit_segments,
    set_sizes,
    share_of_models,
    true_std,
)
from cmp_tactile_processing.tracking.virtual_markers.ridge import (
    BOX,
    LEAST_SIGNAL,
    MAX_COLUMNS,
    MIN_WINDOW_PX,
    Edges,
    Pixels,
    Segments,
    look_half_way,
    measure,
    window_of,
    window_taps,
)

# A marker farther than this from every measured column along the gridline is predicted, px.
NEAR_PX = 2.0
MISSING, MEASURED, PREDICTED = (int(status) for status in Status)
METHODS = ("fused", "local_correction")
# Rounding to grey levels alone is as much noise as this, grey levels.
QUANTISATION = 0.29
# Of so many gridlines, and segments of one, one tells how long segments are.
SOME = 3
# Standard deviation of a corner that came without one, and the least of any, px.
UNKNOWN_CORNER, LEAST_CORNER = 0.05, 1e-3

# How far from the curve through the corners the gradient's peak is looked for, px.
SEARCH_PX = 2
REACH = SEARCH_PX + 2
# Closer to a corner than this many standard deviations of the edges' blur the crossing gridline
# bends the gradient's ridge.
CORNER_CLEARANCE = 3.0
# A gradient below this share of the median on all gridlines is not an edge.
WEAKEST_GRADIENT = 0.25
# Grid-line points of one zone that differ by more lie on different edges, px.
LARGEST_STEP = 2.0
# A quadratic through three pixels of a bell is this much off without any noise, px.
MODEL_ERROR = 0.006
# Standard deviation of the curve between corners as a share of the segment's length.
CURVE_ERROR = 0.0008


class VirtualMarkers(NamedTuple):
    """position (a, b, n, 2) px, status (a, b, n), std (a, b, n): across the gridline, px."""

    position: Array
    status: NDArray[np.uint8]
    std: Array

    @classmethod
    def from_segment(cls, a: int, b: int, n: int) -> VirtualMarkers:
        """Buffers for n markers on each of a x b segments."""
        status = np.empty((a, b, n), dtype=np.uint8)
        return cls(np.empty((a, b, n, 2)), status, np.empty((a, b, n)))


@kernel_part(forceinline=True)
def _is_near(columns: Single, count: int, s: int, t: float, near: float) -> bool:
    seen = column = 0
    block, lane = s // LANES, s % LANES
    while seen < count:
        if columns[block, 2, column, lane] > 0:
            seen += 1
            if abs(columns[block, 0, column, lane] - t) < near:
                return True
        column += 1
    return False


@kernel
def place_markers(
    curve: Array,
    counts: Index,
    columns: Single,
    fits: Fits,
    markers: VirtualMarkers,
) -> None:
    """Fill the markers from the cubics (a, b, 4, 2), `measure`'s columns and `Fits`."""
    n = markers.std.shape[2]
    for i in range(curve.shape[0]):
        for j in range(curve.shape[1]):
            c = curve[i, j]
            x = c[1, 0] + c[2, 0] + c[3, 0]
            y = c[1, 1] + c[2, 1] + c[3, 1]
            if not (math.isfinite(x) and math.isfinite(y)):
                markers.position[i, j] = math.nan
                markers.std[i, j] = math.nan
                markers.status[i, j] = MISSING
                continue
            s = i * curve.shape[1] + j
            axis = 1 if abs(y) > abs(x) else 0
            tilt = math.hypot(x, y) / max(abs(x), abs(y), 1e-9)
            near = NEAR_PX / max(abs(x), abs(y), 1e-9)
            for marker in range(n):
                t = (marker + 1) / (n + 1)
                for k in range(2):
                    value = ((c[3, k] * t + c[2, k]) * t + c[1, k]) * t + c[0, k]
                    markers.position[i, j, marker, k] = value
                markers.position[i, j, marker, 1 - axis] += fits.mean[marker + 1, s]
                spread = fits.spread[marker + 1, s] / tilt**2
                markers.std[i, j, marker] = true_std(spread, MARKER_BIAS_PX)
                is_measured = _is_near(columns, counts[s], s, t, near)
                markers.status[i, j, marker] = MEASURED if is_measured else PREDICTED


class VirtualMarkerLocator:
    """Finds the virtual markers of frame after frame; its buffers are kept.

    method: "fused", the gradient's ridge fused with the curve through the corners, or
    "local_correction", the paper's alone.  Raises InputError for another one.
    """

    def __init__(self, shape: GridShape, method: str = "fused") -> None:
        if method not in METHODS:
            msg = f"virtual_markers: found {method!r}, expected one of {', '.join(METHODS)}"
            raise InputError(msg)
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
        std = np.where(np.isfinite(corner_std), corner_std, UNKNOWN_CORNER)
        np.maximum(std, LEAST_CORNER, out=std)
        rows.load(corners, std)
        cols.load(corners.swapaxes(0, 1), std.T)
        if self._count == 0:
            return rows.result(), cols.result(transposed=True)
        rows.doubt(doubtful_rows, cols.tangent)
        cols.doubt(None if doubtful_cols is None else doubtful_cols.swapaxes(0, 1), rows.tangent)
        height, width = image.smooth.shape
        pixels = Pixels(np.ascontiguousarray(image.smooth).reshape(-1), width, height)
        for lines in (rows, cols):
            lines.look_half_way(pixels)
        blurs = np.concatenate([rows.half_way[1].ravel(), cols.half_way[1].ravel()])
        blur, side = _median(blurs), min(rows.length, cols.length)
        for lines in (rows, cols):
            edges = _edges(image, blur, side, lines.half_way[0])
            if self._fused:
                lines.fuse(pixels, edges)
            else:
                lines.correct(pixels, edges, image)
        return rows.result(), cols.result(transposed=True)

    def crossings(
        self, corners: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Corners (rows, cols, 2) px, fused with the gridlines of the last `locate` through them.

        And their standard deviations (rows, cols) px.  As they were given for "local_correction".
        """
        rows, cols = self._rows, self._cols
        lines = rows.at_corners + cols.at_corners.swapaxes(0, 1)
        return fused_corners(corners, rows.corner_std, rows.corners, lines)


def _median(values: NDArray[np.float64]) -> float:
    """Median of the finite values, the upper of two, NaN for none."""
    seen = values[np.isfinite(values)]
    middle = len(seen) // 2
    return float(np.partition(seen, middle)[middle]) if len(seen) else math.nan


def _edges(image: PreparedImage, blur: float, side: float, gradient: NDArray[np.float64]) -> Edges:
    """Properties of the edges, blurred by `blur` px^2, with these gradients half way along, between
    checkers of that side, px.
    """
    noise = max(image.noise, QUANTISATION)
    window = window_of(blur, image.smoothing_px, side)
    flatter = math.sqrt((blur + BOX + MIN_WINDOW_PX**2) / (blur + BOX + window**2))
    across = math.sqrt(image.smoothing_px**2 + BOX + window**2)
    along = max(image.smoothing_px, MIN_SMOOTHING_PX)
    return Edges(
        blur=blur,
        gradient=flatter * _median(np.abs(gradient)),
        sign=1.0 if np.count_nonzero(gradient > 0) >= np.count_nonzero(gradient < 0) else -1.0,
        # White noise of the image, seen by the second and the first derivative of a Gaussian.
        noise=noise**2 * 3 / (8 * math.sqrt(math.pi) * across**5),
        gradient_noise=noise / math.sqrt(8 * math.pi * across**3 * along),
        window=window,
        taps=window_taps(window),
    )


def _zone(image: PreparedImage, edges: Edges) -> Zone:
    """What the local zones of the correction must show in an image with such edges."""
    smoothing = max(image.smoothing_px, MIN_SMOOTHING_PX)
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
        self.at_corners, self._sides = np.zeros((a, b, LINE_ENTRIES)), np.empty((a, b, 2, 4))
        self._doubt = np.zeros((a, b - 1, n), dtype=np.bool_)
        self._no_doubt = np.zeros((a, b - 1, 0), dtype=np.bool_)
        self._doubtful = self._no_doubt
        blocks = blocks_of(segments)
        self._size, self._end_std = np.ones((2, 2, blocks * LANES))
        self._counts = np.zeros(blocks * LANES, dtype=np.int64)
        self._columns = np.zeros((blocks, 5, MAX_COLUMNS, LANES), dtype=np.float32)
        self._basis = MarkerBasis.from_count(n)
        self._fits = Fits.from_shape(segments, n)
        self._work = FitScratch.new()
        self._turned, self._normals = np.empty((4, 2)), np.empty((2, 3))
        self._markers = VirtualMarkers.from_segment(a, b - 1, n)

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

    @property
    def length(self) -> float:
        """Median length of some segments, px."""
        some = self.curve[::SOME, ::SOME]
        way = some[:, :, 1] + some[:, :, 2] + some[:, :, 3]
        return _median(np.hypot(way[..., 0], way[..., 1]))

    def look_half_way(self, pixels: Pixels) -> None:
        look_half_way(pixels, self.curve, self._turned, self.half_way)

    def fuse(self, pixels: Pixels, edges: Edges) -> None:
        if math.isnan(edges.blur):
            self._counts[:] = 0
            self._columns[:, 2] = 0
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
        gather_lines(
            self.curve, self._counts, self._size, self._end_std, self._fits, self._sides,
            self.at_corners,
        )  # fmt: skip

    def correct(self, pixels: Pixels, edges: Edges, image: PreparedImage) -> None:
        segments = Segments(self.corners, self.crossing, self.curve, self._doubtful)
        correct_markers(pixels, segments, self.corner_std, _zone(image, edges), self._markers)

    def result(self, transposed: bool = False) -> VirtualMarkers:
        """Fresh arrays; transposed: gridlines run along the first axis."""
        arrays = (item.swapaxes(0, 1) if transposed else item for item in self._markers)
        return VirtualMarkers(*(item.copy() for item in arrays))


# Cubic curves through the corners of a grid, compiled: where the gridlines about run.


@kernel
def set_tangents(corners: Array, tangent: Array) -> None:
    """Tangents along axis 1 of corners (a, b, 2), px per segment; NaN where nothing is known.

    Central differences, of fourth order where two corners on both sides are known; next to missing
    corners and at the ends, those of the parabola through the next two corners, or the one
    difference that there is.
    """
    for i in range(corners.shape[0]):
        last = corners.shape[1] - 1
        for j in range(last + 1):
            for axis in range(2):
                here = corners[i, j, axis]
                before = here - corners[i, j - 1, axis] if j > 0 else math.nan
                after = corners[i, j + 1, axis] - here if j < last else math.nan
                if not math.isnan(before) and not math.isnan(after):
                    value = (before + after) / 2
                    if 1 < j < last - 1:
                        farther = (corners[i, j + 2, axis] - corners[i, j - 2, axis]) / 4
                        value += 0.0 if math.isnan(farther) else (value - farther) / 3
                elif not math.isnan(after):
                    value = after
                    if j + 2 <= last and not math.isnan(corners[i, j + 2, axis]):
                        next_after = corners[i, j + 2, axis] - corners[i, j + 1, axis]
                        value = (3 * after - next_after) / 2
                else:
                    value = before
                    if (
                        j >= 2
                        and not math.isnan(before)
                        and not math.isnan(corners[i, j - 2, axis])
                    ):
                        next_before = corners[i, j - 1, axis] - corners[i, j - 2, axis]
                        value = (3 * before - next_before) / 2
                tangent[i, j, axis] = value


@kernel
def fit_curves(corners: Array, tangent: Array, curve: Array) -> None:
    """Coefficients of the cubic of each segment along axis 1, into curve (a, b-1, 4, 2).

    Point at t from 0 to 1: ((c3 t + c2) t + c1) t + c0; NaN where an end is missing.
    """
    for i in range(corners.shape[0]):
        for j in range(corners.shape[1] - 1):
            for axis in range(2):
                start, end = corners[i, j, axis], corners[i, j + 1, axis]
                leave, arrive = tangent[i, j, axis], tangent[i, j + 1, axis]
                curve[i, j, 0, axis] = start
                curve[i, j, 1, axis] = leave
                curve[i, j, 2, axis] = 3 * (end - start) - 2 * leave - arrive
                curve[i, j, 3, axis] = 2 * (start - end) + leave + arrive


# The paper's local sub-pixel correction of virtual markers (III.C), compiled.


class Zone(NamedTuple):
    """What a local zone must show.

    clearance: of the corners, px; weakest: gradient, grey / px; noise: standard deviation of half
    the difference of the gradients two pixels apart, grey / px.
    """

    clearance: float
    weakest: float
    noise: float


@kernel_part
def _gridline_point(
    grey: NDArray[np.float32], base: int, stride: int
) -> tuple[float, float, float]:
    """Offset of the gradient's peak by a quadratic through three pixels, gradient and bend there.

    NaN where the largest gradient within the search is not a peak.
    """
    best, top = 0, -1.0
    for offset in range(-SEARCH_PX, SEARCH_PX + 1):
        here = base + offset * stride
        value = abs(grey[here + stride] - grey[here - stride]) / 2
        if value > top:
            best, top = offset, value
    here = base + best * stride
    left = abs(grey[here] - grey[here - 2 * stride]) / 2
    right = abs(grey[here + 2 * stride] - grey[here]) / 2
    bend = left - 2 * top + right
    if not (bend < 0 and top >= left and top >= right):
        return math.nan, top, math.nan
    return best + (left - right) / 2 / bend, top, bend


@kernel_part
def _corrected(
    pixels: Pixels, zone: Zone, axis: int, along: float, across: float
) -> tuple[float, float]:
    """Where the gridline passes `along`, and its standard deviation along the column; NaN: none.

    The straight line through the grid-line points of the two columns around it.
    """
    size, along_size, stride, along_stride = pixels.height, pixels.width, pixels.width, 1
    if axis == 1:
        size, along_size, stride, along_stride = pixels.width, pixels.height, 1, pixels.width
    column, row = math.floor(along), math.floor(across + 0.5)
    if column < 0 or column + 1 >= along_size or row < REACH or row + REACH >= size:
        return math.nan, math.nan
    base = column * along_stride + row * stride
    first, top, bend = _gridline_point(pixels.grey, base, stride)
    second, next_top, next_bend = _gridline_point(pixels.grey, base + along_stride, stride)
    if not (min(top, next_top) > zone.weakest and abs(second - first) < LARGEST_STEP):
        return math.nan, math.nan
    share = along - column
    std = math.hypot(zone.noise / min(-bend, -next_bend), MODEL_ERROR)
    return row + first * (1 - share) + second * share, std


@kernel_part
def _correct_segment(
    pixels: Pixels,
    segments: Segments,
    zone: Zone,
    at: tuple[int, int, float],
    markers: VirtualMarkers,
) -> None:
    """at: the segment's indices and the standard deviation of its curve, px."""
    i, j, curve_std = at
    c, corners = segments.curve[i, j], segments.corners
    x, y = c[1, 0] + c[2, 0] + c[3, 0], c[1, 1] + c[2, 1] + c[3, 1]
    axis = 1 if abs(y) > abs(x) else 0
    tilt = max(abs(x), abs(y)) / math.hypot(x, y)
    n = markers.std.shape[2]
    for marker in range(n):
        t = (marker + 1) / (n + 1)
        point = markers.position[i, j, marker]
        for k in range(2):
            point[k] = ((c[3, k] * t + c[2, k]) * t + c[1, k]) * t + c[0, k]
        markers.status[i, j, marker] = PREDICTED
        markers.std[i, j, marker] = curve_std
        gap = math.hypot(point[0] - corners[i, j, 0], point[1] - corners[i, j, 1])
        far = math.hypot(point[0] - corners[i, j + 1, 0], point[1] - corners[i, j + 1, 1])
        doubtful = segments.doubtful.shape[2] > 0 and segments.doubtful[i, j, marker]
        if doubtful or min(gap, far) < zone.clearance:
            continue
        across, std = _corrected(pixels, zone, axis, point[axis], point[1 - axis])
        if math.isfinite(across):
            point[1 - axis] = across
            markers.status[i, j, marker] = MEASURED
            markers.std[i, j, marker] = std * tilt


@kernel
def correct_markers(
    pixels: Pixels, segments: Segments, corner_std: Array, zone: Zone, markers: VirtualMarkers
) -> None:
    """Fill the markers of the segments; corner_std (a, b+1) px.

    Markers without a clear peak, or too close to a corner, keep the curve's place as predicted.
    """
    for i in range(segments.curve.shape[0]):
        for j in range(segments.curve.shape[1]):
            c = segments.curve[i, j]
            x, y = c[1, 0] + c[2, 0] + c[3, 0], c[1, 1] + c[2, 1] + c[3, 1]
            if not (math.isfinite(x) and math.isfinite(y)):
                markers.position[i, j] = math.nan
                markers.std[i, j] = math.nan
                markers.status[i, j] = MISSING
                continue
            ends = max(corner_std[i, j], corner_std[i, j + 1])
            curve_std = math.hypot(ends, CURVE_ERROR * math.hypot(x, y))
            _correct_segment(pixels, segments, zone, (i, j, curve_std), markers)
