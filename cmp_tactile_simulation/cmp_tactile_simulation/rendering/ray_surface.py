"""Where a ray meets the deformed surface: Newton's method in material coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_simulation.rendering.surface_spline import SplineSurface, surface_point

__all__ = ["first_meeting", "first_meetings", "meet"]

NEWTON_STEPS = 25
# Error that is left, m; sharper features than this radius, m, do not occur on the surface.
TOLERANCE = 1e-9
SMALLEST_RADIUS = 2e-4
# Near a fold the tangent points far away.
LONGEST_STEP = 3e-4


@njit(cache=True, nogil=True, error_model="numpy")
def meet(
    s: SplineSurface, origin: NDArray[np.float64], d: NDArray[np.float64], x: float, y: float
) -> Any:
    """Material point (x, y) m where the ray meets the surface, searched from a guess.

    Returns whether it was found, x, y and the distance along the ray, m.
    """
    for _ in range(NEWTON_STEPS):
        px, py, pz, ax, ay, az, bx, by, bz = surface_point(s, x, y)
        rx, ry, rz = px - origin[0], py - origin[1], pz - origin[2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        facing = nx * d[0] + ny * d[1] + nz * d[2]
        if facing == 0:
            return False, x, y, 0.0
        t = (nx * rx + ny * ry + nz * rz) / facing
        # What is left lies in the tangent plane.
        ex, ey, ez = t * d[0] - rx, t * d[1] - ry, t * d[2] - rz
        area2 = nx * nx + ny * ny + nz * nz
        step_x = (
            nx * (ey * bz - ez * by) + ny * (ez * bx - ex * bz) + nz * (ex * by - ey * bx)
        ) / area2
        step_y = (
            nx * (ay * ez - az * ey) + ny * (az * ex - ax * ez) + nz * (ax * ey - ay * ex)
        ) / area2
        length2 = step_x * step_x + step_y * step_y
        if not length2 < np.inf:
            return False, x, y, 0.0
        if length2 > LONGEST_STEP * LONGEST_STEP:
            shorter = LONGEST_STEP / np.sqrt(length2)
            step_x, step_y = step_x * shorter, step_y * shorter
        x, y = x + step_x, y + step_y
        if length2 * np.sqrt(area2) < TOLERANCE * SMALLEST_RADIUS * abs(facing):
            return True, x, y, t
    return False, x, y, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def first_meeting(
    s: SplineSurface,
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    starts: NDArray[np.float64],
    alike: float,
) -> Any:
    """The nearest of the meetings found from several guesses (k, 2) m, as `meet` returns it.

    Meetings behind the origin or beyond the surface's size do not count, nor do guesses with NaN
    or within `alike` (m) of an earlier one.
    """
    found, best_x, best_y, nearest = False, 0.0, 0.0, np.inf
    for k in range(len(starts)):
        new = starts[k, 0] == starts[k, 0]
        for earlier in range(k):
            off = abs(starts[k, 0] - starts[earlier, 0]) + abs(starts[k, 1] - starts[earlier, 1])
            new = new and not off < alike
        if not new:
            continue
        good, x, y, t = meet(s, origin, direction, starts[k, 0], starts[k, 1])
        inside = abs(x) <= s.half_x and abs(y) <= s.half_y
        if good and inside and 0 < t < nearest:
            found, best_x, best_y, nearest = True, x, y, t
    return found, best_x, best_y, nearest


@njit(cache=True, nogil=True, error_model="numpy")
def first_meetings(
    s: SplineSurface,
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    starts: NDArray[np.float64],
    alike: float,
) -> NDArray[np.float64]:
    """Material points (n, 2) m where n rays first meet the surface; NaN where they do not.

    origins, directions (n, 3); starts (n, k, 2): guesses for each ray, as `first_meeting` takes
    them.
    """
    xy = np.full((len(origins), 2), np.nan)
    for k in range(len(origins)):
        found, x, y, _ = first_meeting(s, origins[k], directions[k], starts[k], alike)
        if found:
            xy[k, 0], xy[k, 1] = x, y
    return xy
