"""Lens models: pixels to viewing directions and back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.sensor.parts import Camera

# A profile ends where a step of the ray moves the pixel by less than this share of what it does in
# the middle of the image: there it is about to fold back, and a pixel says nothing any more.
LEAST_SLOPE = 1e-3
# Inverses are this accurate or NaN, in normalised image coordinates or rad.
ACCURACY = 1e-10
# A residual of this size, relative to 1 + value, is an error of ACCURACY at the least slope.
LARGEST_RESIDUAL = ACCURACY * LEAST_SLOPE
SAMPLES = 257
NEWTON_STEPS = 20
# Newton's method squares the error: a step of this size leaves less than ACCURACY.
LAST_STEP = 1e-8
# Tangent of the widest angle of a distorted pinhole: 89.4 degrees.
WIDEST_TANGENT = 100.0
# The direction straight back would be a whole circle in the image.
WIDEST_ANGLE = np.radians(179.0)


@dataclass(frozen=True)
class RadialProfile:
    """f(s) = s (1 + k1 s^2 + k2 s^4 + ...), increasing on 0 <= s <= limit.

    s is the tangent of the angle to the optical axis, or the angle itself, as the lens model has
    it.  table: (2, N) samples of s and f.
    """

    coefficients: tuple[float, ...]
    limit: float
    table: NDArray[np.float64]

    @classmethod
    def from_coefficients(
        cls, coefficients: tuple[float, ...], largest: float, tilt: float = 0.0
    ) -> RadialProfile:
        """The profile up to `largest` or to where it stops to increase.

        tilt: size of the distortion that is not radial; the profile then ends where
        f'(s) or f(s) / s falls to tilt s.
        """
        odd = np.zeros(2 * len(coefficients) + 1)
        odd[0], odd[2::2] = 1.0, coefficients
        falling = [odd * np.arange(1, len(odd) + 1)]
        if tilt > 0:
            falling.append(odd)
        limit = min([largest, *(_first_root(item, tilt) for item in falling)])
        # Uniform in angle for a tangent that grows without bound, close to uniform for the rest.
        s = np.tan(np.linspace(0, np.arctan(limit), SAMPLES))
        s[-1] = limit
        f = s * _even(coefficients, s * s)
        return cls(coefficients, limit, np.stack([s, f]))

    def scale(self, s2: NDArray[np.float64]) -> NDArray[np.float64]:
        """f(s) / s, from s^2."""
        return _even(self.coefficients, s2)

    def slope(self, s2: NDArray[np.float64]) -> NDArray[np.float64]:
        """f'(s), from s^2."""
        odd = tuple((2 * i + 3) * k for i, k in enumerate(self.coefficients))
        return _even(odd, s2)

    def inverse(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        """s >= 0 with f(s) = value to ACCURACY; NaN where there is none up to the limit."""
        s_table, f_table = self.table
        index = np.clip(np.searchsorted(f_table, value, "right") - 1, 0, SAMPLES - 2)
        low, high = s_table[index], s_table[index + 1]
        s = low + (value - f_table[index]) / (f_table[index + 1] - f_table[index]) * (high - low)
        for _ in range(NEWTON_STEPS):
            s2 = s * s
            step = (s * self.scale(s2) - value) / self.slope(s2)
            s = np.clip(s - step, low, high)
            if not (np.abs(step) > LAST_STEP).any():
                break
        residual = np.abs(s * self.scale(s * s) - value)
        return np.where(residual <= LARGEST_RESIDUAL * (1 + value), s, np.nan)


def _even(coefficients: tuple[float, ...], s2: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 + k1 s^2 + k2 s^4 + ..., by Horner's rule."""
    total = np.zeros_like(s2)
    for k in reversed(coefficients):
        total = (total + k) * s2
    return total + 1.0


def _first_root(polynomial: NDArray[np.float64], tilt: float) -> float:
    """Smallest s > 0 at which 1 + ... - tilt s falls to LEAST_SLOPE; inf where it never does."""
    shifted = polynomial.copy()
    shifted[0] -= LEAST_SLOPE
    shifted[1] -= tilt
    if not shifted[1:].any():
        return np.inf
    roots = np.roots(shifted[::-1])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots.real))) & (roots.real > 0)]
    return float(real.min()) if len(real) else np.inf


@dataclass(frozen=True)
class Lens:
    """Intrinsics of one published view: matrix (3, 3) in px, model and its coefficients.

    model: pinhole with distortion (k1, k2, p1, p2, k3), or equidistant with (k1, k2, k3, k4).

    A distortion polynomial is meant for the field that was calibrated; farther out it may turn
    back, and points outside the field would fall into the image.  So a lens has a field: the
    directions up to `widest_angle`, where distinct directions have distinct pixels.
    """

    model: str
    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]

    @classmethod
    def of_view(cls, camera: Camera, x: int, y: int, width: int, flipped: bool) -> Lens:
        """Lens of the view cut out at (x, y), mirrored left to right when `flipped`."""
        cx = camera.cx - x
        distortion = np.array(camera.distortion)
        if flipped:
            cx = width - 1 - cx
            if camera.model == "pinhole":
                # Under x -> -x the tangential term p2 changes its sign, all others stay.
                distortion[3] = -distortion[3]
        matrix = np.array([[camera.fx, 0.0, cx], [0.0, camera.fy, camera.cy - y], [0.0, 0.0, 1.0]])
        return cls(camera.model, matrix, distortion)

    @property
    def widest_angle(self) -> float:
        """Largest angle to the optical axis that has a pixel, rad."""
        if self.model == "equidistant":
            return self._profile.limit
        return float(np.arctan(self._profile.limit) if self.distortion.any() else np.pi / 2)

    def directions(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit viewing directions (N, 3), optical frame, of pixels (..., 2).

        Accurate to 1e-10; NaN for NaN and for pixels outside the lens's field.
        """
        xy = np.reshape(np.asarray(q, dtype=np.float64), (-1, 2))
        xy = (xy - self.matrix[:2, 2]) @ self._inverse_scale.T
        if self.model == "equidistant":
            radius = np.hypot(xy[:, 0], xy[:, 1])
            theta = self._profile.inverse(radius)
            # sin(theta) / radius -> 1 on the axis.
            ratio = np.divide(np.sin(theta), radius, out=np.ones_like(radius), where=radius > 0)
            return np.column_stack([xy * ratio[:, None], np.cos(theta)])
        if self.distortion.any():
            xy = self._undistort(xy)
        v = np.column_stack([xy, np.ones(len(xy))])
        return np.asarray(v / np.sqrt((v * v).sum(axis=1, keepdims=True)))

    def project(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) of directions or points (N, 3), optical frame.

        NaN for NaN and outside the lens's field, so behind the camera; an equidistant lens may
        see farther than 90 degrees from its axis.
        """
        xy = self._project_equidistant(v) if self.model == "equidistant" else self._project(v)
        return np.asarray(xy @ self.matrix[:2, :2].T + self.matrix[:2, 2])

    def project_with_jacobian(
        self, v: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels (N, 2) as `project` gives them, and their derivatives (N, 2, 3) by v."""
        equidistant = self.model == "equidistant"
        J = self._equidistant_jacobian(v) if equidistant else self._pinhole_jacobian(v)
        q = self.project(v)
        J[np.isnan(q[:, 0])] = np.nan
        return q, np.asarray(self.matrix[:2, :2] @ J)

    @cached_property
    def _profile(self) -> RadialProfile:
        if self.model == "equidistant":
            return RadialProfile.from_coefficients(tuple(self.distortion.tolist()), WIDEST_ANGLE)
        k1, k2, p1, p2, k3 = self.distortion.tolist()
        # The distorted point is the gradient of r^2/2 + k1 r^4/4 + k2 r^6/6 + k3 r^8/8
        # + (p2 x + p1 y) r^2.  The last term's second derivatives are at most 6 |p| r: while
        # f' and f/r are larger the sum is strictly convex, and its gradient can be inverted.
        return RadialProfile.from_coefficients(
            (k1, k2, k3), WIDEST_TANGENT, 6 * float(np.hypot(p1, p2))
        )

    @cached_property
    def _inverse_scale(self) -> NDArray[np.float64]:
        return np.asarray(np.linalg.inv(self.matrix[:2, :2]))

    def _project(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        z = v[:, 2:]
        xy = v[:, :2] / np.where(z > 0, z, np.nan)
        return self._distort(xy) if self.distortion.any() else xy

    def _distort(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """NaN beyond the limit of the profile."""
        r2 = (xy * xy).sum(axis=1)
        _, _, p1, p2, _ = self.distortion
        radial = np.where(r2 <= self._profile.limit**2, self._profile.scale(r2), np.nan)
        tilt = 2 * (p2 * xy[:, 0] + p1 * xy[:, 1])
        return np.asarray((radial + tilt)[:, None] * xy + r2[:, None] * (p2, p1))

    def _distortion_jacobian(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2, 2), symmetric."""
        r2 = (xy * xy).sum(axis=1)
        _, _, p1, p2, _ = self.distortion
        x, y = xy[:, 0], xy[:, 1]
        radial = self._profile.scale(r2)
        # Twice the derivative of `radial` by r^2.
        k1, k2, k3 = self._profile.coefficients
        bend = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
        tilt = 2 * (p2 * x + p1 * y)
        J = np.empty((len(xy), 2, 2))
        J[:, 0, 0] = radial + bend * x * x + tilt + 4 * p2 * x
        J[:, 1, 1] = radial + bend * y * y + tilt + 4 * p1 * y
        J[:, 0, 1] = J[:, 1, 0] = bend * x * y + 2 * (p1 * x + p2 * y)
        return J

    def _undistort(self, distorted: NDArray[np.float64]) -> NDArray[np.float64]:
        """Newton's method from below the inverse of the radial part."""
        radius = np.hypot(distorted[:, 0], distorted[:, 1])
        tilt = 3 * float(np.hypot(*self.distortion[2:4]))
        if tilt == 0:
            return _at_radius(distorted, radius, self._profile.inverse(radius))
        # The tangential part moves a point by at most tilt r^2.  From below, because the profile
        # is steeper there: from a place where it is almost flat Newton's method leaps away.
        within = np.minimum(radius, self._profile.table[1, -1])
        within = np.maximum(within - tilt * self._profile.inverse(within) ** 2, 0)
        xy = _at_radius(distorted, radius, self._profile.inverse(within))
        for _ in range(NEWTON_STEPS):
            step = _solve_symmetric(self._distortion_jacobian(xy), self._distort(xy) - distorted)
            xy = self._into_field(xy - step)
            if not (np.abs(step) > LAST_STEP).any():
                break
        residual = np.abs(self._distort(xy) - distorted).max(axis=1)
        xy[~(residual <= LARGEST_RESIDUAL * (1 + radius))] = np.nan
        return xy

    def _into_field(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        # A hair inside, where rounding cannot put it beyond the limit.
        limit = self._profile.limit * (1 - 1e-15)
        radius = np.hypot(xy[:, 0], xy[:, 1])
        shrink = np.divide(limit, radius, out=np.ones_like(radius), where=radius > limit)
        return np.asarray(xy * shrink[:, None])

    def _pinhole_jacobian(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2, 3): normalised image coordinates by v."""
        depth = np.where(v[:, 2] > 0, v[:, 2], np.nan)
        xy = v[:, :2] / depth[:, None]
        J = np.zeros((len(v), 2, 3))
        J[:, 0, 0] = J[:, 1, 1] = 1 / depth
        J[:, :, 2] = -xy / depth[:, None]
        return self._distortion_jacobian(xy) @ J if self.distortion.any() else J

    def _project_equidistant(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        _, _, ratio = self._equidistant(v)
        return np.asarray(v[:, :2] * ratio[:, None])

    def _equidistant(
        self, v: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Distance from the axis, angle to it, and image radius over that distance, (N,) each."""
        distance = np.hypot(v[:, 0], v[:, 1])
        theta = np.arctan2(distance, v[:, 2])
        theta[theta > self._profile.limit] = np.nan
        # arctan2(0, 0): the camera's own centre has no pixel.
        theta[(distance == 0) & ~(v[:, 2] > 0)] = np.nan
        radius = theta * self._profile.scale(theta * theta)
        on_axis = np.divide(1.0, v[:, 2], out=np.full_like(theta, np.nan), where=v[:, 2] > 0)
        return theta, distance, np.divide(radius, distance, out=on_axis, where=distance > 0)

    def _equidistant_jacobian(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2, 3): normalised image coordinates by v."""
        theta, distance, ratio = self._equidistant(v)
        range2 = (v * v).sum(axis=1)
        range2[range2 == 0] = np.nan
        slope = self._profile.slope(theta * theta) / range2
        unit = np.divide(
            v[:, :2], distance[:, None], out=np.zeros((len(v), 2)), where=distance[:, None] > 0
        )
        J = np.empty((len(v), 2, 3))
        along = slope * v[:, 2] - ratio
        J[:, :, :2] = along[:, None, None] * unit[:, :, None] * unit[:, None, :]
        J[:, 0, 0] += ratio
        J[:, 1, 1] += ratio
        J[:, :, 2] = -(slope * distance)[:, None] * unit
        return J


def _at_radius(
    xy: NDArray[np.float64], radius: NDArray[np.float64], r: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points in the directions of xy (N, 2), of the radius (N,) given, at radius r (N,)."""
    ratio = np.divide(r, radius, out=np.ones_like(r), where=radius > 0)
    return np.asarray(xy * ratio[:, None])


def _solve_symmetric(A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solution (N, 2) of A x = b, A (N, 2, 2) symmetric and positive definite."""
    a, c, d = A[:, 0, 0], A[:, 0, 1], A[:, 1, 1]
    determinant = a * d - c * c
    x = (d * b[:, 0] - c * b[:, 1]) / determinant
    y = (a * b[:, 1] - c * b[:, 0]) / determinant
    return np.stack([x, y], axis=1)


def fit_stock_lens(
    start: Lens,
    R_rect_raw: NDArray[np.float64],
    v_rect: NDArray[np.float64],
    q_raw: NDArray[np.float64],
) -> tuple[Lens, NDArray[np.float64]]:
    """Lens and rotation (3, 3) that take directions to pixels as a view with layers does.

    start, R_rect_raw: where to begin; the lens model stays.  v_rect (N, 3): directions of
    rectified pixels; q_raw (N, 2): the pixels of the view that they come from.  Least squares in
    px.
    """

    # Few need it, and it takes a fifth of a second to import.
    from scipy.optimize import least_squares

    def unpacked(x: NDArray[np.float64]) -> tuple[Lens, NDArray[np.float64]]:
        fx, fy, cx, cy = start.matrix[[0, 1, 0, 1], [0, 1, 2, 2]] * (1 + x[:4])
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        turn = Rotation.from_rotvec(x[4:7]).as_matrix()
        return Lens(start.model, matrix, start.distortion + x[7:]), turn @ R_rect_raw

    def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
        lens, rotation = unpacked(x)
        off = lens.project(v_rect @ rotation) - q_raw
        # Outside the field of a lens that is tried: farther off than any that is in it.
        return np.where(np.isfinite(off), off, np.ptp(q_raw)).ravel()

    count = 7 + len(start.distortion)
    return unpacked(least_squares(residuals, np.zeros(count), method="lm", max_nfev=2000).x)
