"""Places virtual markers in 3-D, compiled: where the planes of the views cut across a gridline.

Across a gridline, in the plane perpendicular to it, a virtual marker has two coordinates u, v.
Each view tells one combination of them, the curve through the corners both, though less surely
where the gridline bends.  Along the gridline the marker lies at its share of the material, which
the curve alone tells.  One gridline is done at a time; the last axis of every buffer counts its
virtual markers.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.grid import Status
from cmp_tactile_processing.virtual_marker_3d_stencils import DEGREE_NODES, NODES, Stencils

__all__ = ["Corners", "Layout", "Limits", "LineScratch", "Out", "View", "place_lines"]

Array: TypeAlias = NDArray[np.float64]
Codes: TypeAlias = NDArray[np.uint8]
# Position (C, 3) m and covariance (C, 3, 3) m^2 of the corners.
Corners: TypeAlias = tuple[Array, Array]
# Status (N,), std (N,) px, origin, direction (N, 3) of the rays, both by pixel (N, 3, 2).
View: TypeAlias = tuple[Codes, Array, Array, Array, Array, Array]
# Farthest that a plane may be from the curve, m; std of a marker that comes without one, px.
Limits: TypeAlias = tuple[float, float]
# Position (N, 3) m, status (N,), std (N,) m.
Out: TypeAlias = tuple[Array, Codes, Array]

MISSING, MEASURED, PREDICTED = (int(status) for status in Status)
# Least standard deviation of a curve, and that of one through corners without a covariance, m.
LEAST_STD, UNKNOWN_STD = 1e-8, 1e-4
# Both views measure where a gridline runs where the planes that they see it in cut each other at
# this angle at least: 8 degrees.
LEAST_SINE2 = math.sin(math.radians(8)) ** 2
# Standard deviation with which a known surface holds the markers that lie on it, m.
SURFACE_STD = 1e-7


class Layout(NamedTuple):
    """Where in flat arrays the gridlines of one direction lie: strides of lines and of corners.

    markers: virtual markers of a segment.
    """

    lines: int
    corners: int
    line: int
    segment: int
    corner_line: int
    corner: int
    markers: int


class LineScratch(NamedTuple):
    """Of one gridline with M virtual markers, in segments with n each.

    ends (3, n + 2): points of one segment's curve, corners included; point (3, M): those of all;
    along (3, M): direction of the curve, its length 1; left_out (6, segments): two vectors that
    tell what the curve leaves out; frame (6, M): unit vectors of u and v; spread (6, M): the
    curve's covariance xx, xy, xz, yy, yz, zz, m^2; prior (3, M): uu, uv, vv of it; left, right
    (5, M): plane a u + b v = c that a view sees the line in, weight of (a u + b v - c)^2, 0 where
    it sees none, and a^2 + b^2; seen (5, M): normal equations of the planes, uu, uv, vv, u, v;
    std (M,) m; shape (n,): how the square of a deviation from the curve is spread over a segment.
    """

    ends: Array
    point: Array
    along: Array
    left_out: Array
    frame: Array
    spread: Array
    prior: Array
    left: Array
    right: Array
    seen: Array
    std: Array
    shape: Array

    @classmethod
    def of(cls, segments: int, n: int) -> LineScratch:
        """Buffers for so many segments with so many virtual markers each."""
        t = (np.arange(n) + 1.0) / (n + 1)
        each = segments * n
        return cls(
            ends=np.zeros((3, n + 2)),
            point=np.zeros((3, each)),
            along=np.zeros((3, each)),
            left_out=np.zeros((6, segments)),
            frame=np.zeros((6, each)),
            spread=np.zeros((6, each)),
            prior=np.zeros((3, each)),
            left=np.zeros((5, each)),
            right=np.zeros((5, each)),
            seen=np.zeros((5, each)),
            std=np.zeros(each),
            shape=16 * (t * (1 - t)) ** 2,
        )


@njit(cache=True, nogil=True, error_model="numpy")
def place_lines(
    layout: Layout,
    curves: tuple[Corners, NDArray[np.int64], Stencils],
    views: tuple[View, View, Limits, Array],
    scratch: LineScratch,
    out: Out,
) -> None:
    """Fill out.

    curves: corners, entry (lines, segments) of each segment among the stencils.  views: left and
    right, limits, and (3,) of a known surface, factors c of its normal (c_x x, c_y y, 1 + c_z z),
    NaN for none; with one the left view is the only one.
    """
    corners, entries, stencils = curves
    left, right, limits, surface = views
    two_views = math.isnan(surface[0])
    for line in range(layout.lines):
        _set_curves((layout, line), corners, entries, stencils, scratch)
        _set_spread((layout, line), corners[1], entries, stencils, scratch)
        _set_frames(scratch)
        _set_planes((layout, line), left, limits, scratch, scratch.left)
        _widen(layout.markers, scratch.left, scratch)
        if two_views:
            _set_planes((layout, line), right, limits, scratch, scratch.right)
            _widen(layout.markers, scratch.right, scratch)
        else:
            _hold(surface, scratch)
        _add_planes(scratch)
        _place(scratch)
        _set_std(scratch)
        _judge((layout, line), (left[0], right[0], two_views), scratch, out)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _set_curves(
    at: tuple[Layout, int],
    corners: Corners,
    entries: NDArray[np.int64],
    stencils: Stencils,
    scratch: LineScratch,
) -> None:
    """Points and directions of a gridline's curves, and what they leave out."""
    layout, line = at
    position, covariance = corners
    nodes, values, products, divided, known = stencils
    ends, point, along, left_out = scratch.ends, scratch.point, scratch.along, scratch.left_out
    n = layout.markers
    for segment in range(layout.corners - 1):
        entry = entries[line, segment]
        square = noise = 0.0
        for axis in range(3):
            mean = rest = 0.0
            for k in range(n + 2):
                ends[axis, k] = 0.0
            for a in range(NODES):
                c = line * layout.corner_line + nodes[entry, a] * layout.corner
                p = position[c, axis] if nodes[entry, a] >= 0 else math.nan
                mean += divided[entry, 0, a] * p
                rest += divided[entry, 1, a] * p
                noise += divided[entry, 0, a] ** 2 * covariance[c, axis, axis]
                if a < DEGREE_NODES:
                    for k in range(n + 2):
                        ends[axis, k] += values[entry, k, a] * p
            square += mean * mean
            left_out[axis, segment], left_out[3 + axis, segment] = mean, rest
        # Newton's next term counts as far as the corners' noise does not explain it.
        share = 1.0 - noise / square if known[entry] and noise < square else 0.0
        for axis in range(3):
            mean = left_out[axis, segment]
            left_out[axis, segment] = (1.0 - share) * mean
            for k in range(n + 2):
                ends[axis, k] += share * products[entry, k] * mean
            for k in range(n):
                point[axis, segment * n + k] = ends[axis, k + 1]
                along[axis, segment * n + k] = ends[axis, k + 2] - ends[axis, k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _set_spread(
    at: tuple[Layout, int],
    covariance: Array,
    entries: NDArray[np.int64],
    stencils: Stencils,
    scratch: LineScratch,
) -> None:
    """Covariance of the curve: from its corners, and from what it leaves out."""
    layout, line = at
    spread, left_out = scratch.spread, scratch.left_out
    n = layout.markers
    for segment in range(layout.corners - 1):
        entry = entries[line, segment]
        row = 0
        for a in range(3):
            for b in range(a, 3):
                floor = LEAST_STD**2 if a == b else 0.0
                missed = left_out[a, segment] * left_out[b, segment]
                missed += left_out[3 + a, segment] * left_out[3 + b, segment]
                for k in range(n):
                    i = segment * n + k
                    spread[row, i] = floor + missed * stencils.product[entry, k + 1] ** 2
                for node in range(DEGREE_NODES):
                    corner = line * layout.corner_line + stencils.nodes[entry, node] * layout.corner
                    value = covariance[corner, a, b]
                    if math.isnan(value):
                        value = UNKNOWN_STD**2 if a == b else 0.0
                    for k in range(n):
                        w = stencils.value[entry, k + 1, node]
                        spread[row, segment * n + k] += w * w * value
                row += 1


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _set_frames(scratch: LineScratch) -> None:
    """Two unit vectors perpendicular to the curve and to each other (Duff et al., 2017).

    And the covariance of the curve along them.
    """
    along, frame, spread, prior = scratch.along, scratch.frame, scratch.spread, scratch.prior
    for i in range(along.shape[1]):
        x, y, z = along[0, i], along[1, i], along[2, i]
        scale = 1.0 / math.sqrt(x * x + y * y + z * z)
        x, y, z = x * scale, y * scale, z * scale
        along[0, i], along[1, i], along[2, i] = x, y, z
        sign = math.copysign(1.0, z)
        a = -1.0 / (sign + z)
        b = x * y * a
        ex, ey, ez = 1.0 + sign * x * x * a, sign * b, -sign * x
        fx, fy, fz = b, sign + y * y * a, -y
        frame[0, i], frame[1, i], frame[2, i] = ex, ey, ez
        frame[3, i], frame[4, i], frame[5, i] = fx, fy, fz
        xx, xy, xz = spread[0, i], spread[1, i], spread[2, i]
        yy, yz, zz = spread[3, i], spread[4, i], spread[5, i]
        x, y, z = xx * ex + xy * ey + xz * ez, xy * ex + yy * ey + yz * ez, zz * ez
        z += xz * ex + yz * ey
        prior[0, i] = x * ex + y * ey + z * ez
        prior[1, i] = x * fx + y * fy + z * fz
        x, y, z = xx * fx + xy * fy + xz * fz, xy * fx + yy * fy + yz * fz, zz * fz
        z += xz * fx + yz * fy
        prior[2, i] = x * fx + y * fy + z * fz


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _set_planes(
    at: tuple[Layout, int], view: View, limits: Limits, scratch: LineScratch, plane: Array
) -> None:
    """The planes in which a view sees a gridline."""
    layout, line = at
    status, std, origin, direction, origin_by, direction_by = view
    farthest, unknown = limits
    point, along, frame = scratch.point, scratch.along, scratch.frame
    n = layout.markers
    for segment in range(layout.corners - 1):
        first = (line * layout.line + segment * layout.segment) * n
        for k in range(n):
            i, m = segment * n + k, first + k
            vx, vy, vz = direction[m, 0], direction[m, 1], direction[m, 2]
            rx, ry = origin[m, 0] - point[0, i], origin[m, 1] - point[1, i]
            rz = origin[m, 2] - point[2, i]
            t = -(rx * vx + ry * vy + rz * vz)
            # The plane's normal is perpendicular to the ray and to the line.
            x = vy * along[2, i] - vz * along[1, i]
            y = vz * along[0, i] - vx * along[2, i]
            z = vx * along[1, i] - vy * along[0, i]
            dx = x * (origin_by[m, 0, 0] + t * direction_by[m, 0, 0])
            dx += y * (origin_by[m, 1, 0] + t * direction_by[m, 1, 0])
            dx += z * (origin_by[m, 2, 0] + t * direction_by[m, 2, 0])
            dy = x * (origin_by[m, 0, 1] + t * direction_by[m, 0, 1])
            dy += y * (origin_by[m, 1, 1] + t * direction_by[m, 1, 1])
            dy += z * (origin_by[m, 2, 1] + t * direction_by[m, 2, 1])
            a = x * frame[0, i] + y * frame[1, i] + z * frame[2, i]
            b = x * frame[3, i] + y * frame[4, i] + z * frame[5, i]
            c = x * rx + y * ry + z * rz
            size = a * a + b * b
            sigma = std[m] if std[m] > 0.0 else unknown
            weight = 1.0 / ((dx * dx + dy * dy) * sigma * sigma)
            seen = status[m] != MISSING and c * c <= size * farthest * farthest
            plane[0, i], plane[1, i] = (a, b) if seen else (0.0, 0.0)
            plane[2, i], plane[3, i] = (c, weight) if seen else (0.0, 0.0)
            plane[4, i] = size


@njit(cache=True, nogil=True, error_model="numpy")
def _hold(surface: Array, scratch: LineScratch) -> None:
    """The known surface in place of a second view: its tangent plane at the curve's points."""
    point, frame, plane = scratch.point, scratch.frame, scratch.right
    for i in range(point.shape[1]):
        x, y, z = surface[0] * point[0, i], surface[1] * point[1, i], surface[2] * point[2, i]
        a = x * frame[0, i] + y * frame[1, i] + (1.0 + z) * frame[2, i]
        b = x * frame[3, i] + y * frame[4, i] + (1.0 + z) * frame[5, i]
        plane[0, i], plane[1, i], plane[2, i] = a, b, 0.0
        plane[3, i], plane[4, i] = 1.0 / SURFACE_STD**2, a * a + b * b


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _widen(n: int, plane: Array, scratch: LineScratch) -> None:
    """Widen the prior where a view's planes are farther from the curve than variances explain.

    Between corners a gridline can bend in a way that the corners do not show.  By how much it does
    is seen across the planes, and taken for the same in the direction that they do not see.
    """
    prior, shape = scratch.prior, scratch.shape
    total = 0.0
    for k in range(n):
        total += shape[k]
    for first in range(0, prior.shape[1], n):
        excess = 0.0
        for i in range(first, first + n):
            if plane[3, i] > 0.0:
                a, b, c = plane[0, i], plane[1, i], plane[2, i]
                known = a * a * prior[0, i] + 2 * a * b * prior[1, i] + b * b * prior[2, i]
                excess += (c * c - known - 1.0 / plane[3, i]) / plane[4, i]
        if excess > 0.0:
            for k in range(n):
                prior[0, first + k] += excess / total * shape[k]
                prior[2, first + k] += excess / total * shape[k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _add_planes(scratch: LineScratch) -> None:
    """Normal equations of the two planes of each marker."""
    left, right, seen = scratch.left, scratch.right, scratch.seen
    for i in range(seen.shape[1]):
        a, b, c, w = left[0, i], left[1, i], left[2, i], left[3, i]
        d, e, f, x = right[0, i], right[1, i], right[2, i], right[3, i]
        seen[0, i] = w * a * a + x * d * d
        seen[1, i] = w * a * b + x * d * e
        seen[2, i] = w * b * b + x * e * e
        seen[3, i] = w * a * c + x * d * f
        seen[4, i] = w * b * c + x * e * f


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _place(scratch: LineScratch) -> None:
    """Move the points of the curve to the markers' positions.

    The trackers put their markers near the curve through the corners in their image: what the
    planes and the curve know, A and L = P^-1, they know from the same corners in part.  So the one
    that knows more in a direction decides, rather than their weighted mean:
    A P A y + L y = A P b.
    """
    point, frame, prior, seen = scratch.point, scratch.frame, scratch.prior, scratch.seen
    for i in range(point.shape[1]):
        uu, uv, vv, u, v = seen[0, i], seen[1, i], seen[2, i], seen[3, i], seen[4, i]
        Puu, Puv, Pvv = prior[0, i], prior[1, i], prior[2, i]
        # Q = A P.
        Quu, Quv = uu * Puu + uv * Puv, uu * Puv + uv * Pvv
        Qvu, Qvv = uv * Puu + vv * Puv, uv * Puv + vv * Pvv
        scale = 1.0 / (Puu * Pvv - Puv * Puv)
        Suu, Svv = Quu * uu + Quv * uv + Pvv * scale, Qvu * uv + Qvv * vv + Puu * scale
        Suv = Quu * uv + Quv * vv - Puv * scale
        u, v = Quu * u + Quv * v, Qvu * u + Qvv * v
        scale = 1.0 / (Suu * Svv - Suv * Suv)
        u, v = (Svv * u - Suv * v) * scale, (Suu * v - Suv * u) * scale
        point[0, i] += u * frame[0, i] + v * frame[3, i]
        point[1, i] += u * frame[1, i] + v * frame[4, i]
        point[2, i] += u * frame[2, i] + v * frame[5, i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _set_std(scratch: LineScratch) -> None:
    """Largest standard deviation across the line.

    The information of planes and curve together is about that of the better of them, not their
    sum: A + L - 2 A B, where B = (A + L)^-1 L.
    """
    prior, seen, std = scratch.prior, scratch.seen, scratch.std
    for i in range(len(std)):
        uu, uv, vv = seen[0, i], seen[1, i], seen[2, i]
        scale = 1.0 / (prior[0, i] * prior[2, i] - prior[1, i] * prior[1, i])
        Luu, Luv, Lvv = prior[2, i] * scale, -prior[1, i] * scale, prior[0, i] * scale
        Suu, Suv, Svv = uu + Luu, uv + Luv, vv + Lvv
        scale = 1.0 / (Suu * Svv - Suv * Suv)
        Buu, Buv = (Svv * Luu - Suv * Luv) * scale, (Svv * Luv - Suv * Lvv) * scale
        Bvu, Bvv = (Suu * Luv - Suv * Luu) * scale, (Suu * Lvv - Suv * Luv) * scale
        Suu -= 2 * (uu * Buu + uv * Bvu)
        Svv -= 2 * (uv * Buv + vv * Bvv)
        Suv -= uu * Buv + uv * Bvv + uv * Buu + vv * Bvu
        half = (Suu - Svv) / 2
        # One over the smaller eigenvalue, written so that nothing cancels.
        larger = (Suu + Svv) / 2 + math.sqrt(half * half + Suv * Suv)
        std[i] = math.sqrt(larger / (Suu * Svv - Suv * Suv))


@njit(cache=True, nogil=True, error_model="numpy")
def _judge(
    at: tuple[Layout, int], seen: tuple[Codes, Codes, bool], scratch: LineScratch, out: Out
) -> None:
    """Hand a gridline's markers out, each with its status."""
    layout, line = at
    seen_left, seen_right, two_views = seen
    position, status, std = out
    point, left, right = scratch.point, scratch.left, scratch.right
    n = layout.markers
    for segment in range(layout.corners - 1):
        first = (line * layout.line + segment * layout.segment) * n
        for k in range(n):
            i, m = segment * n + k, first + k
            is_seen = left[3, i] > 0.0 or (two_views and right[3, i] > 0.0)
            if not is_seen or not scratch.std[i] > 0.0:
                position[m, 0] = position[m, 1] = position[m, 2] = std[m] = math.nan
                status[m] = MISSING
                continue
            position[m, 0], position[m, 1], position[m, 2] = point[0, i], point[1, i], point[2, i]
            std[m] = scratch.std[i]
            is_measured = left[3, i] > 0.0 and seen_left[m] == MEASURED
            if two_views:
                sine = left[0, i] * right[1, i] - left[1, i] * right[0, i]
                is_measured &= right[3, i] > 0.0 and seen_right[m] == MEASURED
                is_measured &= sine * sine >= LEAST_SINE2 * left[4, i] * right[4, i]
            status[m] = MEASURED if is_measured else PREDICTED
