"""Flat refracting layers perpendicular to the gel's z axis (Snell's law), and rays through them.

Along a ray n sin(angle to z) is the same in all layers.  A ray is given here by t, the tangent of
its angle in air: unlike the sine it keeps its digits towards grazing.  In a layer of index n >= 1
the tangent is

    tan = t / w,   w^2 = n^2 + (n^2 - 1) t^2,   d tan / dt = n^2 / w^3,

so the distance from the camera's vertical that a ray reaches, the sum of depth tan over the
layers, is an increasing, concave function of t: Newton's method from below finds its root from
below, always.

The compiled rays of pixels go through lens, pose and layers in one pass, with their derivatives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.lens import Lens
from cmp_tactile_processing.sensor.parts import RefractingLayer

NEWTON_STEPS = 50
# Newton's method squares the relative error: a step of this size leaves rounding only.
LAST_STEP = 1e-9
# Newton's steps to undo the lens; they end early, where a step is below the tolerance
# (normalised coordinates, so 1e-10 px).
LENS_STEPS, LENS_TOLERANCE = 30, 1e-13

Array: TypeAlias = NDArray[np.float64]
Vector: TypeAlias = tuple[float, float, float]


def refract_rays(
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    layers: tuple[RefractingLayer, ...],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays behind all layers, for rays (N, 3), (N, 3) in air from below them, gel frame.

    Directions stay unit.  Rows become NaN where a ray never reaches a layer, starts behind it or
    is totally reflected.
    """
    index = 1.0
    for layer in layers:
        ahead = np.where(directions[:, 2:] > 0, directions[:, 2:], np.nan)
        t = (layer.z - origins[:, 2:]) / ahead
        across = directions[:, :2] * (index / layer.index)
        along2 = 1 - (across * across).sum(axis=1, keepdims=True)
        passes = (t >= 0) & (along2 > 0)
        origins = np.where(passes, origins + t * directions, np.nan)
        refracted = np.concatenate([across, np.sqrt(np.where(passes, along2, np.nan))], axis=1)
        directions = np.where(passes, refracted, np.nan)
        index = layer.index
    return origins, directions


def apparent_points(
    centre: NDArray[np.float64], points: NDArray[np.float64], layers: tuple[RefractingLayer, ...]
) -> NDArray[np.float64]:
    """Points at which rays from the camera centre must aim, in air, to reach `points`.

    centre (3,), points (N, 3), gel frame, m; centre below all layers, all indices at least 1.
    Returns (N, 3): on the ray in air, at the depth of the point.  The ray that is found passes
    the point within the rounding of its coordinates, grazing rays too.
    """
    if not layers:
        return points
    return _seen_along(centre, points, _Path.to_points(centre, points, layers))


def apparent_points_with_jacobian(
    centre: NDArray[np.float64], points: NDArray[np.float64], layers: tuple[RefractingLayer, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What `apparent_points` gives, and its derivatives (N, 3, 3) by the points.

    By the implicit function theorem: where reach(t, z) = distance, dt = (d distance -
    tan dz) / (d reach / dt), with the tangent in the layer of the point.
    """
    J = np.tile(np.eye(3), (len(points), 1, 1))
    J[np.isnan(points).any(axis=1)] = np.nan
    if not layers:
        return points, J
    path = _Path.to_points(centre, points, layers)
    t, height, distance = path.t[:, None], path.height[:, None], path.distance[:, None]
    slope, tangent = path.derivatives()
    unit = np.divide(path.offset, distance, out=np.zeros_like(path.offset), where=distance > 0)
    # t / distance -> 1 / (d reach / dt) on the axis, in all directions.
    around = np.divide(t, distance, out=1 / slope, where=distance > 0)
    outward = unit[:, :, None] * unit[:, None, :]
    across = (1 / slope - around)[:, :, None] * outward + around[:, :, None] * np.eye(2)
    bent = path.height > 0
    J[bent, :2, :2] = (height[:, :, None] * across)[bent]
    J[bent, :2, 2] = (unit * (t - height * tangent / slope))[bent]
    return _seen_along(centre, points, path), J


@dataclass(frozen=True)
class _Path:
    """Ways from the camera to N points.

    offset (N, 2), distance (N,), height (N,): the points from the camera, m.  indices (L + 1,), air
    first; depth (N, L + 1): how much of each lies below the point, m.  t (N,): tangent in air, NaN
    for points that are not above the camera.
    """

    offset: NDArray[np.float64]
    distance: NDArray[np.float64]
    height: NDArray[np.float64]
    indices: NDArray[np.float64]
    depth: NDArray[np.float64]
    t: NDArray[np.float64]

    @classmethod
    def to_points(
        cls,
        centre: NDArray[np.float64],
        points: NDArray[np.float64],
        layers: tuple[RefractingLayer, ...],
    ) -> _Path:
        offset = points[:, :2] - centre[:2]
        distance = np.hypot(offset[:, 0], offset[:, 1])
        indices = np.array([1.0, *(layer.index for layer in layers)])
        edges = np.array([centre[2], *(layer.z for layer in layers), np.inf])
        depth = np.diff(np.minimum(edges, points[:, 2:]), axis=1)
        t = _air_tangent(indices, depth, distance)
        return cls(offset, distance, points[:, 2] - centre[2], indices, depth, t)

    def derivatives(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Of the reach, (N, 1) each: by t, and by the height of the point."""
        w2 = self.indices**2 + (self.indices**2 - 1) * (self.t * self.t)[:, None]
        by_t = (self.depth * self.indices**2 / w2**1.5).sum(axis=1, keepdims=True)
        last = np.maximum((self.depth > 0).sum(axis=1, keepdims=True) - 1, 0)
        return by_t, self.t[:, None] / np.sqrt(np.take_along_axis(w2, last, axis=1))


def _seen_along(
    centre: NDArray[np.float64], points: NDArray[np.float64], path: _Path
) -> NDArray[np.float64]:
    """Points at the height of `points` on the rays in air."""
    scale = np.divide(
        path.t * path.height, path.distance, out=np.ones_like(path.t), where=path.distance > 0
    )
    # Straight through the air to what lies beside or below the camera.
    scale[path.height <= 0] = 1.0
    return np.concatenate([centre[:2] + path.offset * scale[:, None], points[:, 2:]], axis=1)


def _air_tangent(
    indices: NDArray[np.float64], depth: NDArray[np.float64], distance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Tangent (N,) in air of the rays that reach these distances through these depths."""
    total = depth.sum(axis=1)
    target = np.where(total > 0, distance, np.nan)
    excess = indices**2 - 1
    # Two bounds from below: the layers as thin as they look straight on, and as wide as a grazing
    # ray crosses them.
    t = target / (depth @ (1 / indices))
    widest = depth[:, 1:] @ (1 / np.sqrt(np.maximum(excess[1:], 1e-30)))
    t = np.maximum(t, (target - widest) / depth[:, 0])
    for _ in range(NEWTON_STEPS):
        w2 = indices**2 + excess * (t * t)[:, None]
        part = depth / np.sqrt(w2)
        step = (target - t * part.sum(axis=1)) / (part / w2 @ indices**2)
        t = t + step
        if not (np.abs(step) > LAST_STEP * t).any():
            break
    return t


@dataclass(frozen=True)
class RayBundle:
    """Rays inside the gel of N pixels, gel frame; NaN where a pixel has none.

    origin (N, 3) m, on the last refracting layer or the camera centre; direction (N, 3), unit;
    origin_by_pixel (N, 3, 2) m/px, direction_by_pixel (N, 3, 2) 1/px: derivatives by the pixel.
    At distance t from its origin a ray shifts by (origin_by_pixel + t direction_by_pixel) dq.
    """

    origin: NDArray[np.float64]
    direction: NDArray[np.float64]
    origin_by_pixel: NDArray[np.float64]
    direction_by_pixel: NDArray[np.float64]

    @classmethod
    def empty(cls, count: int) -> RayBundle:
        """Room for so many rays."""
        return cls(*(np.empty((count, *shape)) for shape in ((3,), (3,), (3, 2), (3, 2))))


class RayModel:
    """What the rays of one view depend on, as the compiled loop takes it.

    T_view_gel (4, 4); layers in order from the camera on.
    """

    def __init__(
        self, lens: Lens, T_view_gel: NDArray[np.float64], layers: tuple[RefractingLayer, ...]
    ) -> None:
        K, D = lens.matrix, lens.distortion
        self._equidistant = lens.model == "equidistant"
        limit = lens.widest_angle if self._equidistant else np.tan(lens.widest_angle)
        limit *= 1 + LENS_TOLERANCE
        coefficients = [*D, *[0.0] * (5 - len(D))]
        # Largest distorted radius of the radial part alone.
        k = [D[0], D[1], D[4]] if not self._equidistant else []
        widest = limit * (1 + sum(c * limit ** (2 * i + 2) for i, c in enumerate(k)))
        self._lens = np.array(
            [K[0, 0], K[1, 1], K[0, 2], K[1, 2], limit, *coefficients, widest], dtype=np.float64
        )
        self._straight = not (self._equidistant or D.any() or layers)
        self._R_gel_view = np.ascontiguousarray(T_view_gel[:3, :3].T)
        self._centre = -self._R_gel_view @ T_view_gel[:3, 3]
        index = np.array([1.0, *(layer.index for layer in layers)])
        self._planes = np.array([layer.z for layer in layers], dtype=np.float64)
        self._ratios = index[:-1] / index[1:]

    def bundle(self, q: NDArray[np.float64], out: RayBundle | None = None) -> RayBundle:
        """Rays of pixels (N, 2) of the view; out: of N rays, to be filled and returned.

        Raises InputError for another number of rays: compiled loops check no bounds.
        """
        q = np.ascontiguousarray(q, dtype=np.float64).reshape(-1, 2)
        out = RayBundle.empty(len(q)) if out is None else out
        if len(out.origin) != len(q):
            msg = f"rays: found an output for {len(out.origin)}, expected {len(q)}"
            raise InputError(msg)
        pose = (self._R_gel_view, self._centre)
        arrays = (out.origin, out.direction, out.origin_by_pixel, out.direction_by_pixel)
        if self._straight:
            _trace_straight(q, self._lens, pose, arrays)
        else:
            layers = (self._planes, self._ratios)
            _trace(q, (self._equidistant, self._lens), pose, layers, arrays)
        return out


@kernel
def _trace(
    q: Array,
    lens: tuple[bool, Array],
    pose: tuple[Array, Array],
    layers: tuple[Array, Array],
    out: tuple[Array, Array, Array, Array],
) -> None:
    """Fill out (origin, direction, and both by pixel) for pixels q (N, 2)."""
    equidistant, coefficients = lens
    R, centre = pose
    planes, ratios = layers
    origin, direction, origin_by, direction_by = out
    straight = not (coefficients[5:10] != 0.0).any()
    for n in range(len(q)):
        if equidistant:
            v, v_x, v_y = _equidistant_direction(coefficients, q[n, 0], q[n, 1])
        else:
            v, v_x, v_y = _pinhole_direction(coefficients, straight, q[n, 0], q[n, 1])
        v, v_x, v_y = _turned(R, v), _turned(R, v_x), _turned(R, v_y)
        o, o_x, o_y = (centre[0], centre[1], centre[2]), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for layer in range(len(planes)):
            o, o_x, o_y = _carried((o, o_x, o_y), (v, v_x, v_y), planes[layer])
            v, v_x, v_y = _refracted(v, v_x, v_y, ratios[layer])
        for a in range(3):
            origin[n, a], direction[n, a] = o[a], v[a]
            origin_by[n, a, 0], origin_by[n, a, 1] = o_x[a], o_y[a]
            direction_by[n, a, 0], direction_by[n, a, 1] = v_x[a], v_y[a]


@kernel(fastmath={"contract", "arcp", "nsz"})
def _trace_straight(
    q: Array, lens: Array, pose: tuple[Array, Array], out: tuple[Array, Array, Array, Array]
) -> None:
    """As `_trace` without distortion and layers: a loop that the processor takes in vectors."""
    R, centre = pose
    origin, direction, origin_by, direction_by = out
    f_x, f_y, cx, cy = 1.0 / lens[0], 1.0 / lens[1], lens[2], lens[3]
    for n in range(len(q)):
        x, y = (q[n, 0] - cx) * f_x, (q[n, 1] - cy) * f_y
        s = 1.0 / math.sqrt(1.0 + x * x + y * y)
        by_x, by_y, along_x, along_y = s * f_x, s * f_y, x * s, y * s
        for a in range(3):
            v = (R[a, 0] * x + R[a, 1] * y + R[a, 2]) * s
            origin[n, a], direction[n, a] = centre[a], v
            origin_by[n, a, 0] = origin_by[n, a, 1] = 0.0
            direction_by[n, a, 0] = (R[a, 0] - v * along_x) * by_x
            direction_by[n, a, 1] = (R[a, 1] - v * along_y) * by_y


@kernel_part
def _turned(R: Array, v: Vector) -> Vector:
    return (
        R[0, 0] * v[0] + R[0, 1] * v[1] + R[0, 2] * v[2],
        R[1, 0] * v[0] + R[1, 1] * v[1] + R[1, 2] * v[2],
        R[2, 0] * v[0] + R[2, 1] * v[1] + R[2, 2] * v[2],
    )


@kernel_part
def _carried(
    origin: tuple[Vector, Vector, Vector],
    direction: tuple[Vector, Vector, Vector],
    plane: float,
) -> tuple[Vector, Vector, Vector]:
    """Origin on the plane, and its derivatives; NaN for a ray that does not go towards +z."""
    (o, o_x, o_y), (v, v_x, v_y) = origin, direction
    t = (plane - o[2]) / v[2] if v[2] > 0.0 else np.nan
    t_x = -(o_x[2] + t * v_x[2]) / v[2]
    t_y = -(o_y[2] + t * v_y[2]) / v[2]
    return _ahead(o, v, t), _shifted(o_x, v, v_x, t, t_x), _shifted(o_y, v, v_y, t, t_y)


@kernel_part
def _ahead(o: Vector, v: Vector, t: float) -> Vector:
    return o[0] + t * v[0], o[1] + t * v[1], o[2] + t * v[2]


@kernel_part
def _shifted(o_by: Vector, v: Vector, v_by: Vector, t: float, t_by: float) -> Vector:
    return (
        o_by[0] + t * v_by[0] + t_by * v[0],
        o_by[1] + t * v_by[1] + t_by * v[1],
        o_by[2] + t * v_by[2] + t_by * v[2],
    )


@kernel_part
def _refracted(v: Vector, v_x: Vector, v_y: Vector, ratio: float) -> tuple[Vector, Vector, Vector]:
    """Snell's law: the part across the plane shrinks by the ratio; NaN for total reflection."""
    x, y = v[0] * ratio, v[1] * ratio
    z2 = 1.0 - x * x - y * y
    z = math.sqrt(z2) if z2 > 0.0 and v[2] > 0.0 else np.nan
    xx, yx, xy, yy = v_x[0] * ratio, v_x[1] * ratio, v_y[0] * ratio, v_y[1] * ratio
    return (
        (x + 0.0 * z, y + 0.0 * z, z),
        (xx, yx, -(x * xx + y * yx) / z),
        (xy, yy, -(x * xy + y * yy) / z),
    )


@kernel_part
def _pinhole_direction(
    lens: Array, straight: bool, qx: float, qy: float
) -> tuple[Vector, Vector, Vector]:
    """Unit direction of a pixel and its derivatives by x and y; plumb_bob distortion."""
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    x, y = (qx - cx) / fx, (qy - cy) / fy
    a, b, d = 1.0, 0.0, 1.0
    if not straight:
        x, y, a, b, d = _undistorted(lens, x, y)
    det = a * d - b * b
    s = 1.0 / math.sqrt(1.0 + x * x + y * y)
    v = (x * s, y * s, s)
    scale = s / det
    return (
        v,
        _across(v, d * scale / fx, -b * scale / fx),
        _across(v, -b * scale / fy, a * scale / fy),
    )


@kernel_part
def _across(v: Vector, x: float, y: float) -> Vector:
    """The part of (x, y, 0) that is perpendicular to the unit vector v."""
    along = v[0] * x + v[1] * y
    return x - along * v[0], y - along * v[1], -along * v[2]


@kernel_part
def _undistorted(lens: Array, xd: float, yd: float) -> tuple[float, float, float, float, float]:
    """Normalised x, y of a distorted point; the distortion's derivative [[a, b], [b, d]] there.

    NaN outside the lens's field.  Inside it there is one solution: what Newton's method finds
    there from the distorted point itself is right.  Else it starts again below the inverse of the
    radial part by what the tangential part can move: from above, where the distortion is almost
    flat, it leaps.
    """
    found = _newton(lens, xd, yd, (xd, yd))
    if math.isfinite(found[0]):
        return found
    k, limit, widest = (lens[5], lens[6], lens[9], 0.0), lens[4], lens[10]
    tilt = 3.0 * math.sqrt(lens[7] ** 2 + lens[8] ** 2)
    distorted = math.sqrt(xd * xd + yd * yd)
    within = min(distorted, widest)
    radius, _ = _profile_inverse(k, limit, within)
    radius, _ = _profile_inverse(k, limit, max(within - tilt * radius * radius, 0.0))
    scale = radius / distorted if distorted > 0.0 else 1.0
    return _newton(lens, xd, yd, (xd * scale, yd * scale))


@kernel_part
def _newton(
    lens: Array, xd: float, yd: float, start: tuple[float, float]
) -> tuple[float, float, float, float, float]:
    """As `_undistorted`, from a start; NaN where it does not settle inside the field."""
    limit, k1, k2, p1, p2, k3 = lens[4], lens[5], lens[6], lens[7], lens[8], lens[9]
    x, y = start
    a, b, d = 1.0, 0.0, 1.0
    for _ in range(LENS_STEPS):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
        ex = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - xd
        ey = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - yd
        a = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        b = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        d = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        det = a * d - b * b
        dx, dy = (d * ex - b * ey) / det, (a * ey - b * ex) / det
        x, y = x - dx, y - dy
        r2 = x * x + y * y
        if abs(dx) + abs(dy) < LENS_TOLERANCE * (1.0 + r2):
            if r2 > limit * limit:
                break
            return x, y, a, b, d
        if r2 > limit * limit:
            shrink = limit / math.sqrt(r2)
            x, y = x * shrink, y * shrink
    return np.nan, np.nan, a, b, d


@kernel_part
def _profile_inverse(
    k: tuple[float, float, float, float], limit: float, value: float
) -> tuple[float, float]:
    """s with s (1 + k1 s^2 + k2 s^4 + ...) = value, and the slope there; NaN beyond the limit.

    Newton's method within a bracket that halves where a step would leave it.
    """
    low, high, s, slope = 0.0, limit, min(value, limit), 1.0
    for _ in range(4 * LENS_STEPS):
        s2 = s * s
        slope = 1.0 + s2 * (3.0 * k[0] + s2 * (5.0 * k[1] + s2 * (7.0 * k[2] + s2 * 9.0 * k[3])))
        error = s * (1.0 + s2 * (k[0] + s2 * (k[1] + s2 * (k[2] + s2 * k[3])))) - value
        low, high = (low, s) if error > 0.0 else (s, high)
        after = s - error / slope
        if abs(after - s) < LENS_TOLERANCE * (1.0 + s):
            return (after, slope) if after <= limit else (np.nan, slope)
        s = after if low <= after <= high else (low + high) / 2.0
    return np.nan, slope


@kernel_part
def _equidistant_direction(lens: Array, qx: float, qy: float) -> tuple[Vector, Vector, Vector]:
    """Unit direction of a pixel and its derivatives by x and y; equidistant lens."""
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    x, y = (qx - cx) / fx, (qy - cy) / fy
    radius = math.sqrt(x * x + y * y)
    theta, slope = _profile_inverse((lens[5], lens[6], lens[7], lens[8]), lens[4], radius)
    sine, cosine = math.sin(theta), math.cos(theta)
    ux, uy, spread = 1.0, 0.0, 1.0 / slope
    if radius > 0.0:
        ux, uy, spread = x / radius, y / radius, sine / radius
    out_x, turn_x = ux / (fx * slope), -uy * spread / fx
    out_y, turn_y = uy / (fy * slope), ux * spread / fy
    return (
        (sine * ux, sine * uy, cosine),
        (cosine * ux * out_x - uy * turn_x, cosine * uy * out_x + ux * turn_x, -sine * out_x),
        (cosine * ux * out_y - uy * turn_y, cosine * uy * out_y + ux * turn_y, -sine * out_y),
    )
