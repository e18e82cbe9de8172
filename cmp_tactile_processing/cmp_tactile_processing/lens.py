"""Lens models: pixels to viewing directions and back."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor_description import Camera

__all__ = ["Lens"]

# Undistortion iterates until it moves less than this, in normalised coordinates.
UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-13)


@dataclass(frozen=True)
class Lens:
    """Intrinsics of one published view: matrix (3, 3) in px, model and its coefficients."""

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

    def directions(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit viewing directions (N, 3), optical frame, of pixels (N, 2); NaN stays NaN."""
        q = np.ascontiguousarray(q, dtype=np.float64).reshape(-1, 1, 2)
        if not self.distortion.any() and self.model == "pinhole":
            xy = (q[:, 0] - self.matrix[:2, 2]) / self.matrix[[0, 1], [0, 1]]
        elif self.model == "pinhole":
            points = cv2.undistortPointsIter(
                q, self.matrix, self.distortion, np.eye(3), np.eye(3), UNDISTORT_CRITERIA
            )
            xy = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        else:
            return self._equidistant_directions(q[:, 0])
        v = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))

    def project(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) of directions or points (N, 3), optical frame; NaN behind the camera."""
        v = np.where(v[:, 2:] > 0, v, np.nan)
        xy = v[:, :2] / v[:, 2:]
        return np.asarray(self._distort(xy) @ self.matrix[:2, :2].T + self.matrix[:2, 2])

    def _distort(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        r2 = (xy**2).sum(axis=1, keepdims=True)
        if self.model == "equidistant":
            r = np.sqrt(r2)
            theta = np.arctan(r)
            radius = self._equidistant_radius(theta)
            return np.asarray(xy * np.divide(radius, r, out=np.ones_like(r), where=r > 0))
        k1, k2, p1, p2, k3 = self.distortion
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        x, y = xy[:, :1], xy[:, 1:]
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.asarray(xy * radial + np.concatenate([dx, dy], axis=1))

    def _equidistant_radius(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        k1, k2, k3, k4 = self.distortion
        t2 = theta * theta
        return np.asarray(theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))))

    def _equidistant_directions(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        xy = (q - self.matrix[:2, 2]) / self.matrix[[0, 1], [0, 1]]
        radius = np.linalg.norm(xy, axis=1)
        theta = radius.copy()
        k1, k2, k3, k4 = self.distortion
        for _ in range(20):
            t2 = theta * theta
            slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
            theta -= (self._equidistant_radius(theta) - radius) / slope
        unit = np.divide(xy, radius[:, None], out=np.zeros_like(xy), where=radius[:, None] > 0)
        return np.concatenate([unit * np.sin(theta)[:, None], np.cos(theta)[:, None]], axis=1)
