"""Curves through the corners of the gridlines in 3-D, compiled: where virtual markers would lie.

Along its gridline a virtual marker lies at its share of the material between two corners.  Across
it, in the plane perpendicular to the curve, it has two coordinates u, v, which the curve shows too,
though less surely where the gridline bends.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.measured import Status

Array: TypeAlias = NDArray[np.float64]

# Corners that a curve goes through, and corners that it and its error are estimated from.
DEGREE_NODES, NODES = 4, 6
# A curve bridges at most so many segments: one missing corner; beyond the last one it never goes.
MOST_SEGMENTS_BRIDGED = 2
# Where there is no further corner: how large the next difference is, of the highest known.
NEXT_DIFFERENCE = 0.5

Index: TypeAlias = NDArray[np.int64]
# Position (C, 3) m and covariance (C, 3, 3) m^2 of the corners.
Corners: TypeAlias = tuple[Array, Array]

MISSING = int(Status.MISSING)
# Least standard deviation of a curve, and that of one through corners without a covariance, m.
LEAST_STD, UNKNOWN_STD = 1e-8, 1e-4
# A gridline bends along what its curve leaves out; this share of that variance is even.
EVEN_SHARE = 0.02


class Stencils(NamedTuple):
    """Weights of T segments with n virtual markers each.

    nodes (T, NODES): numbers of the corners along the gridline, -1 in front where there is no
    curve; value (T, n + 2, DEGREE_NODES): position at share k / (n + 1) of the segment, corners
    included; product (T, n + 2): of the distances to the nodes, in segments; divided
    (T, 2, NODES): mean and half the difference of the two divided differences, each over one
    further corner, that it multiplies in Newton's next term; known (T,): false where there is no
    further corner, and a share of the highest difference that there is stands for the next.
    """

    nodes: NDArray[np.int64]
    value: Array
    product: Array
    divided: Array
    known: NDArray[np.bool_]

    @classmethod
    def from_count(cls, count: int, n: int) -> Stencils:
        """Buffers for so many segments."""
        return cls(
            np.full((count, NODES), -1, np.int64),
            np.zeros((count, n + 2, DEGREE_NODES)),
            np.zeros((count, n + 2)),
            np.zeros((count, 2, NODES)),
            np.zeros(count, np.bool_),
        )


@kernel
def fill_stencils(present: NDArray[np.bool_], first: int, stencils: Stencils) -> None:
    """Stencils of all segments of one gridline, into the entries from `first` on.

    present (corners,): which corners are there.
    """
    for segment in range(len(present) - 1):
        entry = first + segment
        nodes = stencils.nodes[entry]
        count = _choose(present, segment, nodes)
        if count == 0:
            continue
        degree = min(count, DEGREE_NODES)
        markers = stencils.value.shape[1] - 1
        for k in range(markers + 1):
            u = segment + k / markers
            product = 1.0
            for a in range(DEGREE_NODES):
                weight = 0.0
                if a < degree:
                    product *= u - nodes[a]
                    weight = 1.0
                    for b in range(degree):
                        if b != a:
                            weight *= (u - nodes[b]) / (nodes[a] - nodes[b])
                stencils.value[entry, k, a] = weight
            stencils.product[entry, k] = product
        stencils.known[entry] = count > degree
        _divide(nodes, count, stencils.divided[entry])


@kernel_part
def _choose(present: NDArray[np.bool_], segment: int, nodes: NDArray[np.int64]) -> int:
    """Fill the nodes, nearest to the segment's middle first; how many there are, 0 for no curve."""
    count = 0
    before, after = -1, -1
    for reach in range(len(present)):
        for corner in (segment - reach, segment + 1 + reach):
            if count == NODES or not 0 <= corner < len(present) or not present[corner]:
                continue
            nodes[count] = corner
            count += 1
            if corner <= segment and before < 0:
                before = corner
            elif corner > segment and after < 0:
                after = corner
    if before < 0 or after < 0 or after - before > MOST_SEGMENTS_BRIDGED:
        nodes[0] = -1
        return 0
    for rest in range(count, NODES):
        nodes[rest] = nodes[0]
    return count


@kernel_part
def _divide(nodes: NDArray[np.int64], count: int, divided: Array) -> None:
    """Weights of mean and half the difference of the next two divided differences."""
    degree = min(count, DEGREE_NODES)
    divided[:] = 0.0
    for which in range(2):
        further = min(degree + which, count - 1)
        known = further >= degree
        for a in range(count):
            if a >= degree and a != further:
                continue
            weight = 0.5 if known else 0.5 * NEXT_DIFFERENCE / degree
            for b in range(count):
                if b != a and (b < degree or b == further):
                    weight /= nodes[a] - nodes[b]
            divided[0, a] += weight
            divided[1, a] += weight if which == 0 else -weight


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


class LineCurves(NamedTuple):
    """Of all gridlines of one direction, one after the other: S segments, M virtual markers.

    ends (3, n + 2): points of one segment's curve, corners included; at_nodes (6, NODES): what is
    known of the corners that it goes through; point (3, M): of all curves;
    along (3, M): direction of the curve, its length 1; length (M,): of a segment that goes on like
    that, m; left_out (6, S): two vectors that show what
    the curve leaves out; frame (6, M): unit vectors of u and v; spread (6, M): the covariance of
    the curve that comes from its corners, xx, xy, xz, yy, yz, zz, m^2; prior (3, M): all of its
    covariance, uu, uv, vv; bend (3, M): what of it would grow if the gridline bent more.
    """

    ends: Array
    at_nodes: Array
    point: Array
    along: Array
    length: Array
    left_out: Array
    frame: Array
    spread: Array
    prior: Array
    bend: Array

    @classmethod
    def from_layout(cls, layout: Layout) -> LineCurves:
        """Buffers for the gridlines of a direction."""
        segments = layout.lines * (layout.corners - 1)
        each = segments * layout.markers
        return cls(
            ends=np.zeros((3, layout.markers + 2)),
            at_nodes=np.zeros((6, NODES)),
            point=np.zeros((3, each)),
            along=np.zeros((3, each)),
            length=np.zeros(each),
            left_out=np.zeros((6, segments)),
            frame=np.zeros((6, each)),
            spread=np.zeros((6, each)),
            prior=np.zeros((3, each)),
            bend=np.zeros((3, each)),
        )


@kernel
def choose_stencils(
    layout: Layout, position: Array, status: NDArray[np.uint8], entries: Index, stencils: Stencils
) -> None:
    """Fill the entries (lines, segments) among the stencils, and those of incomplete gridlines.

    position (C, 3), status (C,): of the corners.  The entries of complete gridlines come first,
    then those of each gridline that lacks corners.
    """
    segments = layout.corners - 1
    present = np.empty(layout.corners, np.bool_)
    for line in range(layout.lines):
        for corner in range(layout.corners):
            c = line * layout.corner_line + corner * layout.corner
            present[corner] = status[c] != MISSING and math.isfinite(position[c, 0])
        first = 0 if present.all() else (1 + line) * segments
        for segment in range(segments):
            entries[line, segment] = first + segment
        if first:
            fill_stencils(present, first, stencils)


@kernel
def set_curves(
    layout: Layout, corners: Corners, entries: Index, stencils: Stencils, curves: LineCurves
) -> None:
    """Fill the curves; NaN where there is none.

    entries (lines, segments): entry of each segment among the stencils.
    """
    for line in range(layout.lines):
        _set_points((layout, line), corners, entries[line], stencils, curves)
        _set_spread((layout, line), corners[1], entries[line], stencils, curves)
    _set_frames(layout.markers, curves)
    _turn_spread(curves)
    for line in range(layout.lines):
        _set_bend((layout, line), entries[line], stencils.product, curves)


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _set_points(
    at: tuple[Layout, int],
    corners: Corners,
    entries: Index,
    stencils: Stencils,
    curves: LineCurves,
) -> None:
    """Points and directions of a gridline's curves, and what they leave out."""
    layout, line = at
    position, covariance = corners
    nodes, values, products, divided, known = stencils
    ends, at_nodes, left_out = curves.ends, curves.at_nodes, curves.left_out
    n, first = layout.markers, line * (layout.corners - 1)
    for segment in range(layout.corners - 1):
        entry = entries[segment]
        square = noise = 0.0
        for axis in range(3):
            mean = rest = 0.0
            for a in range(NODES):
                c = line * layout.corner_line + nodes[entry, a] * layout.corner
                p = position[c, axis] if nodes[entry, a] >= 0 else math.nan
                at_nodes[axis, a] = p
                mean += divided[entry, 0, a] * p
                rest += divided[entry, 1, a] * p
                noise += divided[entry, 0, a] ** 2 * covariance[c, axis, axis]
            square += mean * mean
            left_out[axis, first + segment], left_out[3 + axis, first + segment] = mean, rest
        # Newton's next term counts as far as the corners' noise does not explain it.
        share = 1.0 - noise / square if known[entry] and noise < square else 0.0
        for axis in range(3):
            next_term = share * left_out[axis, first + segment]
            left_out[axis, first + segment] -= next_term
            for k in range(n + 2):
                value = next_term * products[entry, k]
                for a in range(DEGREE_NODES):
                    value += values[entry, k, a] * at_nodes[axis, a]
                ends[axis, k] = value
            for k in range(n):
                i = (first + segment) * n + k
                curves.point[axis, i] = ends[axis, k + 1]
                curves.along[axis, i] = ends[axis, k + 2] - ends[axis, k]


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _set_spread(
    at: tuple[Layout, int],
    covariance: Array,
    entries: Index,
    stencils: Stencils,
    curves: LineCurves,
) -> None:
    """Covariance of the curve that comes from its corners."""
    layout, line = at
    spread, at_nodes = curves.spread, curves.at_nodes
    n, first = layout.markers, line * (layout.corners - 1)
    for segment in range(layout.corners - 1):
        entry = entries[segment]
        for node in range(DEGREE_NODES):
            c = line * layout.corner_line + stencils.nodes[entry, node] * layout.corner
            row = 0
            for a in range(3):
                for b in range(a, 3):
                    value = covariance[c, a, b]
                    if math.isnan(value):
                        value = UNKNOWN_STD**2 if a == b else 0.0
                    at_nodes[row, node] = value
                    row += 1
        for k in range(n):
            i = (first + segment) * n + k
            p, q = stencils.value[entry, k + 1, 0] ** 2, stencils.value[entry, k + 1, 1] ** 2
            r, s = stencils.value[entry, k + 1, 2] ** 2, stencils.value[entry, k + 1, 3] ** 2
            for row in range(6):
                spread[row, i] = (p * at_nodes[row, 0] + q * at_nodes[row, 1]) + (
                    r * at_nodes[row, 2] + s * at_nodes[row, 3]
                )
            spread[0, i] += LEAST_STD**2
            spread[3, i] += LEAST_STD**2
            spread[5, i] += LEAST_STD**2


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _set_frames(n: int, curves: LineCurves) -> None:
    """Two unit vectors perpendicular to the curve and to each other (Duff et al., 2017)."""
    along, frame, length = curves.along, curves.frame, curves.length
    for i in range(along.shape[1]):
        x, y, z = along[0, i], along[1, i], along[2, i]
        size = math.sqrt(x * x + y * y + z * z)
        # The points beside a marker are two steps apart, those of a segment's ends n + 1.
        length[i] = size * (0.5 * (n + 1))
        scale = 1.0 / size
        x, y, z = x * scale, y * scale, z * scale
        along[0, i], along[1, i], along[2, i] = x, y, z
        sign = 1.0 if z >= 0.0 else -1.0
        a = -1.0 / (sign + z)
        b = x * y * a
        frame[0, i], frame[1, i], frame[2, i] = 1.0 + sign * x * x * a, sign * b, -sign * x
        frame[3, i], frame[4, i], frame[5, i] = b, sign + y * y * a, -y


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _turn_spread(curves: LineCurves) -> None:
    """Prior from the covariance of the corners' curve alone."""
    frame, spread, prior = curves.frame, curves.spread, curves.prior
    for i in range(frame.shape[1]):
        ex, ey, ez = frame[0, i], frame[1, i], frame[2, i]
        fx, fy, fz = frame[3, i], frame[4, i], frame[5, i]
        xx, xy, xz = spread[0, i], spread[1, i], spread[2, i]
        yy, yz, zz = spread[3, i], spread[4, i], spread[5, i]
        x, y, z = xx * ex + xy * ey + xz * ez, xy * ex + yy * ey + yz * ez, zz * ez
        z += xz * ex + yz * ey
        prior[0, i] = x * ex + y * ey + z * ez
        prior[1, i] = x * fx + y * fy + z * fz
        x, y, z = xx * fx + xy * fy + xz * fz, xy * fx + yy * fy + yz * fz, zz * fz
        z += xz * fx + yz * fy
        prior[2, i] = x * fx + y * fy + z * fz


@kernel_part(fastmath={"contract", "arcp", "nsz"})
def _set_bend(
    at: tuple[Layout, int],
    entries: Index,
    products: Array,
    curves: LineCurves,
) -> None:
    """Add the covariance of what the curve leaves out to the prior."""
    layout, line = at
    frame, left_out, bend, prior = curves.frame, curves.left_out, curves.bend, curves.prior
    n, first = layout.markers, line * (layout.corners - 1)
    for segment in range(layout.corners - 1):
        entry = entries[segment]
        x, y, z = (
            left_out[0, first + segment],
            left_out[1, first + segment],
            left_out[2, first + segment],
        )
        p, q, r = (
            left_out[3, first + segment],
            left_out[4, first + segment],
            left_out[5, first + segment],
        )
        for k in range(n):
            i = (first + segment) * n + k
            w = products[entry, k + 1] ** 2
            u = x * frame[0, i] + y * frame[1, i] + z * frame[2, i]
            v = x * frame[3, i] + y * frame[4, i] + z * frame[5, i]
            s = p * frame[0, i] + q * frame[1, i] + r * frame[2, i]
            t = p * frame[3, i] + q * frame[4, i] + r * frame[5, i]
            uu, uv, vv = w * (u * u + s * s), w * (u * v + s * t), w * (v * v + t * t)
            prior[0, i] += uu
            prior[1, i] += uv
            prior[2, i] += vv
            even = EVEN_SHARE * (uu + vv) + LEAST_STD**2
            bend[0, i], bend[1, i], bend[2, i] = uu + even, uv, vv + even
