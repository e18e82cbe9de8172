"""From an image to the outlines of its checkers, and from these to quadrangles (paper, III.A).

A side is fitted to the outline between two corners, with little weight on points off the line, so
that dents, spikes and rounded corners move it little; corners are where the sides' lines cross.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.tracking.detector import NominalGrid

# The four corners of a checker by the direction from its centre: sign along i, sign along j.
# In cyclic order, so that corner k and corner (k + 2) % 4 lie opposite each other.
CORNER_SIGNS = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
Floats = NDArray[np.float64]
Wholes = NDArray[np.intp]
# An eroded outline has this share of a nominal checker's area at least, and at most.
SMALLEST_AREA, LARGEST_AREA = 0.08, 3.0
# A side of a checker differs from the nominal one by less than this share of its length, however
# the gel stretches, shears and turns; beyond it another pattern or a false outline is seen.
LARGEST_STRAIN = 0.7
# Opposite sides of one checker differ by less than this share of them.
LARGEST_TAPER = 0.7
# Share of a side that is left out at either end: corners come out rounded.
ROUNDED = 0.15
# A point is on a line within this distance, in sides, and this one in px.
TOLERANCE, LEAST_TOLERANCE = 0.08, 1.0
# Share of a side's points that lie on its line at least, on the worst side and on average.
LEAST_ON_SIDE, LEAST_ON_SIDES = 0.3, 0.6
# Where fewer points are on a side's line, it is searched again among lines through two of them.
DENTED = 0.7
# Outlines this far (in sides) from every nominal corner belong to the housing.
FARTHEST_CENTRE = 4.0
# Nearest nominal corners are looked up in cells of this share of the smallest side.
CELL = 0.5

# Width (Gaussian, in sides) of the surroundings: they hold light and dark alike.
SURROUNDINGS = 0.65
# Where they vary by less than this share of the image's contrast, or by less than so many standard
# deviations of the noise that smoothing leaves, there is no pattern.
LEAST_CONTRAST, LEAST_DEVIATIONS = 0.03, 2.0
# Surroundings are measured on pixels of this many to a side.
COARSE = 5.0
# Openings and closings go up to this share of a side.
MEND = 0.08
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
SQUARE = np.ones((3, 3), np.uint8)
NOWHERE = 1e4


class NominalSteps:
    """Steps along i and j of the nominal corner nearest to a place, by table.

    cells (h, w): index of that corner, or -1 far from all; origin (2,) and size: place of the
    table's first cell and side of a cell, px; steps (n, 2, 2): px, [i or j, x or y].
    """

    def __init__(self, nominal: NominalGrid) -> None:
        margin = FARTHEST_CENTRE * nominal.side_px
        flat = nominal.corners.reshape(-1, 2)
        self.size = CELL * nominal.smallest_side_px
        self.origin = flat.min(axis=0) - margin
        width, height = np.ceil((np.ptp(flat, axis=0) + 2 * margin) / self.size).astype(int)
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        distance, nearest = nominal.tree.query(np.stack([x, y], -1) * self.size + self.origin)
        self.cells = np.where(distance < margin, nearest, -1).astype(np.int32)
        steps = np.stack([nominal.row_step.reshape(-1, 2), nominal.col_step.reshape(-1, 2)], axis=1)
        self.steps = np.ascontiguousarray(steps)


def fit_quadrangles(
    contours: Sequence[cv2.typing.MatLike], axes: NominalSteps, shrunk: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Quadrangles of the outlines that are checkers.

    contours: outlines of blobs with all their points, as cv2.findContours gives them; shrunk:
    by how much an outline lies inside the checker's edge, px.
    Returns corners (n, 4, 2) px in the order of CORNER_SIGNS and quality (n,) from 0 to 1.
    """
    # The shortest outline that has two points a side.
    contours = [contour for contour in contours if len(contour) >= 8]
    if not contours:
        return np.empty((0, 4, 2)), np.empty(0)
    starts = np.zeros(len(contours) + 1, dtype=np.intp)
    np.cumsum([len(contour) for contour in contours], out=starts[1:])
    points = np.concatenate(contours)[:, 0].astype(np.float64)
    corners = np.empty((len(contours), 4, 2))
    quality = np.zeros(len(contours))
    _fit_all(
        points, starts, axes.cells, axes.origin, axes.size, axes.steps, shrunk, corners, quality
    )
    good = quality > 0
    return corners[good], quality[good]


@kernel
def _fit_all(  # noqa: PLR0913, PLR0917 - a kernel fills buffers
    points: Floats,
    starts: Wholes,
    cells: NDArray[np.int32],
    origin: Floats,
    size: float,
    steps: Floats,
    shrunk: float,
    corners: Floats,
    quality: Floats,
) -> None:
    height, width = cells.shape
    longest = 0
    for n in range(len(quality)):
        longest = max(longest, starts[n + 1] - starts[n])
    xy = np.empty((longest, 2))
    lines = np.empty((4, 4))
    ends = np.empty(4, np.int64)
    for n in range(len(quality)):
        outline = points[starts[n] : starts[n + 1]]
        area, x, y = _area_and_centre(outline)
        # Holes run the other way round.
        if area <= 0:
            continue
        col, row = int((x - origin[0]) // size), int((y - origin[1]) // size)
        if col < 0 or row < 0 or col >= width or row >= height or cells[row, col] < 0:
            continue
        step = steps[cells[row, col]]
        det = step[0, 0] * step[1, 1] - step[0, 1] * step[1, 0]
        if area < SMALLEST_AREA * abs(det) or area > LARGEST_AREA * abs(det):
            continue
        tolerance = max(LEAST_TOLERANCE, TOLERANCE * math.sqrt(area))
        _extremes(outline, x, y, step, det, ends)
        # OpenCV walks an outline with the blob at its left; CORNER_SIGNS the other way if det < 0.
        forward = -1 if det < 0 else 1
        good = 1.0
        for again in range(2):
            if again:
                _nearest_points(outline, corners[n], ends)
            good = _fit_sides(outline, ends, forward, tolerance, xy, lines)
            if good <= 0 or not _cross(lines, x, y, 0.0, corners[n]):
                good = 0.0
                break
        if good > 0 and _cross(lines, x, y, shrunk, corners[n]) and _is_checker(corners[n], step):
            quality[n] = good


@kernel_part
def _area_and_centre(outline: Floats) -> tuple[float, float, float]:
    """Signed area and centroid of a polygon."""
    x0, y0 = outline[0]
    area = cx = cy = 0.0
    for k in range(1, len(outline) - 1):
        ax, ay = outline[k, 0] - x0, outline[k, 1] - y0
        bx, by = outline[k + 1, 0] - x0, outline[k + 1, 1] - y0
        cross = bx * ay - ax * by
        area += cross
        cx += cross * (ax + bx)
        cy += cross * (ay + by)
    if area == 0:
        return 0.0, x0, y0
    return area / 2, x0 + cx / (3 * area), y0 + cy / (3 * area)


@kernel_part
def _extremes(  # noqa: PLR0913, PLR0917 - a kernel fills buffers
    outline: Floats, x: float, y: float, step: Floats, det: float, ends: Wholes
) -> None:
    """Indices of the points farthest along the diagonals of the nominal checker."""
    ends[:] = 0
    most = np.full(4, -np.inf)
    for k in range(len(outline)):
        dx, dy = outline[k, 0] - x, outline[k, 1] - y
        along_i = (dx * step[1, 1] - dy * step[1, 0]) / det
        along_j = (dy * step[0, 0] - dx * step[0, 1]) / det
        for c in range(4):
            far = CORNER_SIGNS[c, 0] * along_i + CORNER_SIGNS[c, 1] * along_j
            if far > most[c]:
                most[c] = far
                ends[c] = k


@kernel_part
def _nearest_points(outline: Floats, corners: Floats, ends: Wholes) -> None:
    least = np.full(4, np.inf)
    for k in range(len(outline)):
        for c in range(4):
            gap = (outline[k, 0] - corners[c, 0]) ** 2 + (outline[k, 1] - corners[c, 1]) ** 2
            if gap < least[c]:
                least[c] = gap
                ends[c] = k


@kernel_part
def _fit_sides(  # noqa: PLR0913, PLR0917 - a kernel fills buffers
    outline: Floats, ends: Wholes, forward: int, tolerance: float, xy: Floats, lines: Floats
) -> float:
    """Lines (4: x, y, dx, dy) of the sides; returns the share of points on them, 0 for none."""
    total = len(outline)
    spent = 0
    mean = 0.0
    for k in range(4):
        count = (ends[(k + 1) % 4] - ends[k]) * forward % total + 1
        spent += count - 1
        skip = int(ROUNDED * count)
        count -= 2 * skip
        if count < 2:
            return 0.0
        p = (ends[k] + forward * skip) % total
        for q in range(count):
            xy[q, 0], xy[q, 1] = outline[p, 0], outline[p, 1]
            p += forward
            if p == total:
                p = 0
            elif p < 0:
                p = total - 1
        on = _fit_line(xy[:count], tolerance, lines[k])
        if on < LEAST_ON_SIDE:
            return 0.0
        mean += on / 4
    # Once around, and no side twice.
    if spent != total or mean < LEAST_ON_SIDES:
        return 0.0
    return mean


@kernel_part
def _fit_line(xy: Floats, tolerance: float, line: Floats) -> float:
    """Line (x, y, dx, dy) through points (n, 2); returns the share of them within a tolerance."""
    # Points count alike at first, then by their distance from the line found so far.
    _weighted_line(xy, np.inf, line)
    _weighted_line(xy, 2 * tolerance, line)
    _weighted_line(xy, tolerance, line)
    on = _share_on(xy, tolerance, line)
    if on < DENTED:
        trial = line.copy()
        third = max(len(xy) // 3, 1)
        for a in range(third):
            for b in range(len(xy) - third, len(xy)):
                dx, dy = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
                length = math.hypot(dx, dy)
                if length > 0:
                    trial[0], trial[1], trial[2], trial[3] = (
                        xy[a, 0],
                        xy[a, 1],
                        dx / length,
                        dy / length,
                    )
                    share = _share_on(xy, tolerance, trial)
                    if share > on:
                        on, line[:] = share, trial
        _weighted_line(xy, tolerance, line)
        on = _share_on(xy, tolerance, line)
    return on


@kernel_part
def _weighted_line(xy: Floats, scale: float, line: Floats) -> None:
    """Least squares, with little weight on points farther than `scale` from the line before."""
    x0, y0 = xy[0]
    w = sx = sy = sxx = sxy = syy = 0.0
    for p in range(len(xy)):
        x, y = xy[p, 0] - x0, xy[p, 1] - y0
        weight = 1.0
        if scale < np.inf:
            off = ((x + x0 - line[0]) * line[3] - (y + y0 - line[1]) * line[2]) / scale
            weight /= (1 + off * off) ** 2
        w += weight
        sx += weight * x
        sy += weight * y
        sxx += weight * x * x
        sxy += weight * x * y
        syy += weight * y * y
    sx, sy = sx / w, sy / w
    angle = 0.5 * math.atan2(2 * (sxy - w * sx * sy), (sxx - w * sx * sx) - (syy - w * sy * sy))
    line[0], line[1] = x0 + sx, y0 + sy
    line[2], line[3] = math.cos(angle), math.sin(angle)


@kernel_part
def _share_on(xy: Floats, tolerance: float, line: Floats) -> float:
    on = 0
    for p in range(len(xy)):
        off = (xy[p, 0] - line[0]) * line[3] - (xy[p, 1] - line[1]) * line[2]
        on += abs(off) <= tolerance
    return on / len(xy)


@kernel_part
def _cross(lines: Floats, x: float, y: float, outwards: float, corners: Floats) -> bool:
    """Corners (4, 2) where the lines, moved away from (x, y), cross; false where they do not."""
    for k in range(4):
        a, b = lines[(k + 3) % 4], lines[k]
        sine = a[2] * b[3] - a[3] * b[2]
        if abs(sine) < 0.3:
            return False
        # Signed distances of the centre from both lines say which way is outwards.
        na = (x - a[0]) * a[3] - (y - a[1]) * a[2]
        nb = (x - b[0]) * b[3] - (y - b[1]) * b[2]
        da = -math.copysign(outwards, na)
        db = -math.copysign(outwards, nb)
        ax, ay = a[0] + da * a[3], a[1] - da * a[2]
        bx, by = b[0] + db * b[3], b[1] - db * b[2]
        t = ((bx - ax) * b[3] - (by - ay) * b[2]) / sine
        corners[k, 0], corners[k, 1] = ax + t * a[2], ay + t * a[3]
    return True


@kernel_part
def _is_checker(corners: Floats, step: Floats) -> bool:
    """Whether the sides are about the pattern's, and opposite ones about alike."""
    for k in range(4):
        sign = 1 if k < 2 else -1
        along = 1 - k % 2
        sx = corners[(k + 1) % 4, 0] - corners[k, 0]
        sy = corners[(k + 1) % 4, 1] - corners[k, 1]
        change = (sx - sign * step[along, 0]) ** 2 + (sy - sign * step[along, 1]) ** 2
        length = step[along, 0] ** 2 + step[along, 1] ** 2
        if not change < LARGEST_STRAIN**2 * length:
            return False
        ox = corners[(k + 3) % 4, 0] - corners[(k + 2) % 4, 0]
        oy = corners[(k + 3) % 4, 1] - corners[(k + 2) % 4, 1]
        if not (sx + ox) ** 2 + (sy + oy) ** 2 < LARGEST_TAPER**2 * length:
            return False
    return True


# Pretreatment and contour extraction. Where a place is darker or lighter than its surroundings by a
# share of what they vary by, the illumination does not matter.


def least_deviation(image: PreparedImage) -> float:
    """Standard deviation, grey levels, by which the smoothed image varies where the pattern is."""
    # Smoothing by s leaves white noise 1 / (2 sqrt(pi) s) of its standard deviation.
    noise = image.noise / max(2 * math.sqrt(math.pi) * image.smoothing_px, 1.0)
    return max(LEAST_CONTRAST * image.contrast, LEAST_DEVIATIONS * noise)


class CheckerOutlines:
    """Outlines of the checkers of one image at several depths of erosion.

    image (H, W) float32, smoothed; side_px: side of a checker; offset: share of the surroundings'
    standard deviation by which a checker differs from their mean; least: see `least_deviation`.
    """

    def __init__(
        self, image: NDArray[np.float32], side_px: float, offset: float, least: float
    ) -> None:
        self._image = image
        self._mend = max(1, round(MEND * side_px))
        factor = max(1, int(side_px / COARSE))
        height, width = image.shape
        size = (max(width // factor, 1), max(height // factor, 1))
        coarse = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        sigma = SURROUNDINGS * side_px / factor
        mean = cv2.GaussianBlur(coarse, (0, 0), sigma)
        square = cv2.GaussianBlur(coarse * coarse, (0, 0), sigma)
        deviation = np.sqrt(np.maximum(square - mean * mean, 0))
        band = np.where(deviation > least, offset * deviation, NOWHERE).astype(np.float32)
        self._level = {True: mean - band, False: mean + band}
        self._mask: dict[bool, cv2.typing.MatLike] = {}

    def contours(self, dark: bool, erosion: int) -> Sequence[cv2.typing.MatLike]:
        """Outlines of the dark or of the light blobs, eroded by so many px; with all points."""
        if dark not in self._mask:
            level = cv2.resize(self._level[dark], self._image.shape[::-1])
            kind = cv2.CMP_LT if dark else cv2.CMP_GT
            self._mask[dark] = self._repaired(cv2.compare(self._image, level, kind))
        mask = cv2.erode(self._mask[dark], SQUARE, iterations=erosion)
        return cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]

    def _repaired(self, mask: cv2.typing.MatLike) -> cv2.typing.MatLike:
        """The paper's loop of openings and closings: small missing and false spots are repaired."""
        for times in range(1, self._mend + 1):
            mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, CROSS, iterations=times)
            mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, CROSS, iterations=times)
        return mask
