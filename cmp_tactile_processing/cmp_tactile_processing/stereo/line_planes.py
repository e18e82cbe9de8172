"""The planes in which views see gridlines, and where virtual markers lie on them, compiled.

A view sees a gridline in the plane through its ray: one combination of the two coordinates u, v
that a marker has across its curve (`virtual_marker_curves`).
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.measured import Status
from cmp_tactile_processing.stereo.triangulation import LEAST_STD_PX, PARALLEL_SINE2
from cmp_tactile_processing.stereo.virtual_marker_curves import Layout, LineCurves

Array: TypeAlias = NDArray[np.float64]
Codes: TypeAlias = NDArray[np.uint8]
# Status (N,), std (N,) px, origin, direction (N, 3) of the rays, both by pixel (N, 3, 2).
View: TypeAlias = tuple[Codes, Array, Array, Array, Array, Array]
# Farthest that a plane may be from the curve, m; std of a marker that comes without one, px.
Limits: TypeAlias = tuple[float, float]
# Position (N, 3) m, status (N,), std (N,) m.
Out: TypeAlias = tuple[Array, Codes, Array]

MISSING, MEASURED, PREDICTED = (int(status) for status in Status)
# Both views measure where a gridline runs where it makes this angle at least with the epipolar
# plane, in which both rays lie: 30 degrees.  There it is twice as uncertain as at 90 degrees.
LEAST_SINE2 = math.sin(math.radians(30)) ** 2
# Variance of the curve there, in units of that of what both views give together.
FREEDOM = 100.0
# In shares of a segment's length: how far a gridline may lie from the curve through its corners,
# and the standard deviation of that at the most.  Beyond, what a view saw is not the gridline.
FARTHEST, ROUGHEST = 0.1, 0.04
# Gridlines on either side of one that a groove across them reaches.
ALONG_GROOVE = 3
# Standard deviation with which a known surface holds the markers that lie on it, m.
SURFACE_STD = 1e-7


class LinePlanes(NamedTuple):
    """Of M virtual markers, one gridline after the other.

    left, right (5, M): plane a u + b v = c that a view sees the line in, weight of
    (a u + b v - c)^2, 0 where it sees none, and cosine of the angle of ray and line; seen (5, M):
    normal equations of both, uu, uv, vv, u, v, in the end whether they were used in place of u;
    std (M,): largest across the line, m.
    """

    left: Array
    right: Array
    seen: Array
    std: Array

    @classmethod
    def from_markers(cls, markers: int) -> LinePlanes:
        """Buffers for so many virtual markers."""
        rows = (np.zeros((5, markers)) for _ in range(3))
        return cls(next(rows), next(rows), next(rows), np.zeros(markers))


@kernel
def place_lines(
    layout: Layout,
    views: tuple[View, View, Limits, Array],
    curves: LineCurves,
    planes: LinePlanes,
    out: Out,
) -> None:
    """Fill out; moves the points of the curves.

    views: left and right, limits, and (3,) of a known surface, factors c of its normal
    (c_x x, c_y y, 1 + c_z z), NaN for none; with one the left view is the only one.
    """
    left, right, limits, surface = views
    two_views = math.isnan(surface[0])
    for line in range(layout.lines):
        _set_planes((layout, line), left, limits, curves, planes.left)
        if two_views:
            _set_planes((layout, line), right, limits, curves, planes.right)
    _widen(layout.markers, planes.left, curves)
    if two_views:
        _widen(layout.markers, planes.right, curves)
    else:
        _hold(surface, curves, planes.right)
    _add_planes(planes)
    if two_views:
        for segment in range(layout.corners - 1):
            _widen_in_depth((layout, segment), curves, planes)
        _trust_both(curves, planes)
    _set_std(curves, planes)
    _place(curves, planes)
    for line in range(layout.lines):
        _judge((layout, line), (left[0], right[0], two_views), (curves.point, planes), out)


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _set_planes(
    at: tuple[Layout, int], view: View, limits: Limits, curves: LineCurves, plane: Array
) -> None:
    """The planes in which a view sees a gridline."""
    layout, line = at
    status, std, origin, direction, origin_by, direction_by = view
    farthest, unknown = limits
    point, along, frame = curves.point, curves.along, curves.frame
    n, start = layout.markers, line * (layout.corners - 1)
    for segment in range(layout.corners - 1):
        first = (line * layout.line + segment * layout.segment) * n
        for k in range(n):
            i, m = (start + segment) * n + k, first + k
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
            sigma = max(std[m], LEAST_STD_PX) if std[m] >= 0.0 else unknown
            weight = 1.0 / ((dx * dx + dy * dy) * sigma * sigma)
            reach = min(farthest, FARTHEST * curves.length[i])
            seen = status[m] != MISSING and c * c <= (a * a + b * b) * reach * reach
            plane[0, i], plane[1, i] = (a, b) if seen else (0.0, 0.0)
            plane[2, i], plane[3, i] = (c, weight) if seen else (0.0, 0.0)
            plane[4, i] = vx * along[0, i] + vy * along[1, i] + vz * along[2, i]


@kernel_part
def _hold(surface: Array, curves: LineCurves, plane: Array) -> None:
    """The known surface in place of a second view: its tangent plane at the curve's points."""
    point, frame = curves.point, curves.frame
    for i in range(point.shape[1]):
        x, y, z = surface[0] * point[0, i], surface[1] * point[1, i], surface[2] * point[2, i]
        a = x * frame[0, i] + y * frame[1, i] + (1.0 + z) * frame[2, i]
        b = x * frame[3, i] + y * frame[4, i] + (1.0 + z) * frame[5, i]
        plane[0, i], plane[1, i], plane[2, i] = a, b, 0.0
        plane[3, i] = 1.0 / SURFACE_STD**2


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _widen(n: int, plane: Array, curves: LineCurves) -> None:
    """Widen the prior where a view's planes are farther from the curve than variances explain.

    Between corners a gridline can bend in a way that the corners do not show.  How far it does is
    seen across the planes; in the direction that they do not see it follows from the bend.
    """
    prior, bend = curves.prior, curves.bend
    for first in range(0, prior.shape[1], n):
        excess = total = 0.0
        for i in range(first, first + n):
            if plane[3, i] > 0.0:
                a, b, c = plane[0, i], plane[1, i], plane[2, i]
                known = a * a * prior[0, i] + 2 * a * b * prior[1, i] + b * b * prior[2, i]
                seen = a * a * bend[0, i] + 2 * a * b * bend[1, i] + b * b * bend[2, i]
                scale = 1.0 / (a * a + b * b)
                excess += (c * c - known - 1.0 / plane[3, i]) * scale
                total += seen * scale
        if excess > 0.0:
            for i in range(first, first + n):
                most = (ROUGHEST * curves.length[i]) ** 2 / (bend[0, i] + bend[2, i])
                factor = min(excess / total, most)
                prior[0, i] += factor * bend[0, i]
                prior[1, i] += factor * bend[1, i]
                prior[2, i] += factor * bend[2, i]


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _add_planes(planes: LinePlanes) -> None:
    """Normal equations of the two planes of each marker."""
    left, right, seen = planes.left, planes.right, planes.seen
    for i in range(seen.shape[1]):
        a, b, c, w = left[0, i], left[1, i], left[2, i], left[3, i]
        d, e, f, x = right[0, i], right[1, i], right[2, i], right[3, i]
        seen[0, i] = w * a * a + x * d * d
        seen[1, i] = w * a * b + x * d * e
        seen[2, i] = w * b * b + x * e * e
        seen[3, i] = w * a * c + x * d * f
        seen[4, i] = w * b * c + x * e * f


@kernel_part
def _is_measured(left: Array, right: Array, i: int) -> bool:
    """Whether both views see marker i, and its gridline at a good angle to the epipolar plane."""
    if not (left[3, i] > 0.0 and right[3, i] > 0.0):
        return False
    a, b, d, e = left[0, i], left[1, i], right[0, i], right[1, i]
    # The planes' normals are the rays' cross products with the line: theirs is the triple product.
    triple = a * e - b * d
    cosine = left[4, i] * right[4, i] + a * d + b * e
    return bool(triple * triple > LEAST_SINE2 * max(1.0 - cosine * cosine, PARALLEL_SINE2))


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _widen_in_depth(at: tuple[Layout, int], curves: LineCurves, planes: LinePlanes) -> None:
    """Widen the prior of one segment of all gridlines along z, which no plane shows well.

    A groove across the gridlines bows them between two corners.  A view that looks at a gridline
    straight from above sees none of it, but one that looks at an angle sees some: planes and curves
    are then as far apart as depth times that angle explains.
    """
    layout, segment = at
    n, stride = layout.markers, (layout.corners - 1) * layout.markers
    sums = np.zeros((4, layout.lines))
    for line in range(layout.lines):
        _add_bow(line * stride + segment * n, n, curves, planes, sums[:, line])
    for line in range(layout.lines):
        first, last = max(line - ALONG_GROOVE, 0), min(line + ALONG_GROOVE + 1, layout.lines)
        known = seen = squares = count = 0.0
        for other in range(first, last):
            known += sums[0, other]
            seen += sums[1, other]
            squares += sums[2, other]
            count += sums[3, other]
        if not known > 0.0:
            continue
        # By least squares, less the variance that it has by chance.
        depth = seen / known
        excess = depth * depth - max(1.0, (squares - depth * seen) / count) / known
        for k in range(n):
            i = line * stride + segment * n + k
            u, v = curves.frame[2, i], curves.frame[5, i]
            variance = min(max(excess, 0.0), (FARTHEST * curves.length[i]) ** 2) * _bow(k, n) ** 2
            curves.prior[0, i] += variance * u * u
            curves.prior[1, i] += variance * u * v
            curves.prior[2, i] += variance * v * v


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _add_bow(first: int, n: int, curves: LineCurves, planes: LinePlanes, sums: Array) -> None:
    """Add what a segment says of its depth: normal equation, squared offsets over noise, count."""
    left, right, frame, prior = planes.left, planes.right, curves.frame, curves.prior
    for k in range(n):
        i = first + k
        if _is_measured(left, right, i):
            continue
        # Two views of a gridline that neither measures see nearly the same plane.
        share = 0.5 if left[3, i] > 0.0 and right[3, i] > 0.0 else 1.0
        for plane in (left, right):
            if not plane[3, i] > 0.0:
                continue
            a, b, c = plane[0, i], plane[1, i], plane[2, i]
            by_depth = (a * frame[2, i] + b * frame[5, i]) * _bow(k, n)
            noise = 1.0 / plane[3, i]
            noise += a * a * prior[0, i] + 2 * a * b * prior[1, i] + b * b * prior[2, i]
            sums[0] += share * by_depth * by_depth / noise
            sums[1] += share * by_depth * c / noise
            sums[2] += share * c * c / noise
            sums[3] += share


@kernel_part
def _bow(k: int, n: int) -> float:
    """How far a bow between two corners is from their line at marker k of n, 1 in the middle."""
    t = (k + 1) / (n + 1)
    return 4 * t * (1 - t)


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _trust_both(curves: LineCurves, planes: LinePlanes) -> None:
    """Widen the prior where both views determine it by so much that it has no say any more.

    There it could add little, because the trackers' markers rest on the same corners; and it would
    pull those back that a bend puts aside which no corner shows.
    """
    prior, seen = curves.prior, planes.seen
    for i in range(prior.shape[1]):
        if _is_measured(planes.left, planes.right, i):
            uu, uv, vv = seen[0, i], seen[1, i], seen[2, i]
            scale = FREEDOM / (uu * vv - uv * uv)
            prior[0, i] += vv * scale
            prior[1, i] -= uv * scale
            prior[2, i] += uu * scale


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _place(curves: LineCurves, planes: LinePlanes) -> None:
    """Move the points of the curve to the markers' positions.

    The trackers put their markers near the curve through the corners in their image: what the
    planes and the curve know, A and L = P^-1, they know from the same corners in part.  So the one
    that knows more in a direction decides, rather than their weighted mean:
    A P A y + L y = A P b.  A marker that would lie too far from the curve stays on it.
    """
    point, frame, prior, seen = curves.point, curves.frame, curves.prior, planes.seen
    length, std = curves.length, planes.std
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
        # Planes that disagree by more than a gridline bends: one view saw something else.
        far = u * u + v * v > (FARTHEST * length[i]) ** 2
        seen[3, i] = 0.0 if far else 1.0
        u, v = (0.0, 0.0) if far else (u, v)
        std[i] = max(std[i], ROUGHEST * length[i]) if far else std[i]
        point[0, i] += u * frame[0, i] + v * frame[3, i]
        point[1, i] += u * frame[1, i] + v * frame[4, i]
        point[2, i] += u * frame[2, i] + v * frame[5, i]


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _set_std(curves: LineCurves, planes: LinePlanes) -> None:
    """Largest standard deviation across the line.

    The information of planes and curve together is about that of the better of them, not their
    sum: A + L - 2 A B, where B = (A + L)^-1 L.
    """
    prior, seen, std = curves.prior, planes.seen, planes.std
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


@kernel_part
def _judge(
    at: tuple[Layout, int],
    seen: tuple[Codes, Codes, bool],
    found: tuple[Array, LinePlanes],
    out: Out,
) -> None:
    """Hand a gridline's markers out, each with its status."""
    layout, line = at
    seen_left, seen_right, two_views = seen
    position, status, std = out
    point, planes = found
    left, right = planes.left, planes.right
    n, start = layout.markers, line * (layout.corners - 1)
    for segment in range(layout.corners - 1):
        first = (line * layout.line + segment * layout.segment) * n
        for k in range(n):
            i, m = (start + segment) * n + k, first + k
            is_seen = left[3, i] > 0.0 or (two_views and right[3, i] > 0.0)
            if not is_seen or not planes.std[i] > 0.0:
                position[m, 0] = position[m, 1] = position[m, 2] = std[m] = math.nan
                status[m] = MISSING
                continue
            position[m, 0], position[m, 1], position[m, 2] = point[0, i], point[1, i], point[2, i]
            std[m] = planes.std[i]
            is_measured = left[3, i] > 0.0 and seen_left[m] == MEASURED and planes.seen[3, i] > 0.0
            if two_views:
                is_measured &= seen_right[m] == MEASURED and _is_measured(left, right, i)
            status[m] = MEASURED if is_measured else PREDICTED
