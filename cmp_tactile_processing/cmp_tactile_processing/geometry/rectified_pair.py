"""The two parallel pinhole cameras whose images the rectified views are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.geometry.optics import ViewGeometry

__all__ = ["RectifiedCamera", "rectified_pair", "undistorted_camera"]

# Share of the image that is left free around the pattern at rest, both sides together.
MARGIN = 0.1
# The centre moves by 1e-4 of its distance in the second of these rounds.
CENTRE_ROUNDS = 3


@dataclass(frozen=True)
class RectifiedCamera:
    """A pinhole camera: T_rect_gel (4, 4): gel frame -> its optical frame; matrix (3, 3) px.

    baseline: along x from the left camera of the pair to this one, m; 0 for the left itself.
    """

    T_rect_gel: NDArray[np.float64]
    matrix: NDArray[np.float64]
    baseline: float = 0.0

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,), gel frame, m."""
        return np.asarray(-self.T_rect_gel[:3, :3].T @ self.T_rect_gel[:3, 3])

    @property
    def projection(self) -> NDArray[np.float64]:
        """(3, 4): points of the left camera's optical frame -> pixels of this one."""
        translation = np.array([[-self.matrix[0, 0] * self.baseline], [0.0], [0.0]])
        return np.concatenate([self.matrix, translation], axis=1)

    def project(self, p_gel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) of points (N, 3), gel frame, m; NaN behind the camera."""
        return self.project_directions(p_gel - self.centre)

    def project_directions(self, v_gel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (N, 2) of viewing directions (N, 3), gel frame; NaN behind the camera."""
        v = v_gel @ self.T_rect_gel[:3, :3].T
        xy = v[:, :2] / np.where(v[:, 2:] > 0, v[:, 2:], np.nan)
        return np.asarray(xy @ self.matrix[:2, :2].T + self.matrix[:2, 2])

    def directions(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Viewing directions (N, 3), gel frame, of length 1 along the axis, of pixels (N, 2)."""
        v = np.concatenate([q, np.ones((len(q), 1))], axis=1) @ np.linalg.inv(self.matrix).T
        return np.asarray(v @ self.T_rect_gel[:3, :3])


def undistorted_camera(view: ViewGeometry) -> RectifiedCamera:
    """The pinhole camera in the place of a view's own, with its matrix."""
    return RectifiedCamera(view.T_view_gel, view.lens.matrix)


def rectified_pair(
    views: Mapping[str, ViewGeometry], points: NDArray[np.float64]
) -> dict[str, RectifiedCamera]:
    """The rectified pair of two views; points (N, 3), gel frame: what both are to show.

    x is along the baseline, z between the optical axes.  Both have one matrix: image_geometry's
    model in Python, and stereo_image_proc together with its model in C++, give wrong depths where
    the principal points differ.
    Raises GeometryError where one camera is behind the other, so that no such pair sees the points.
    """
    left, right = views["left"], views["right"]
    centres = {name: _effective_centre(view, points) for name, view in views.items()}
    R_rect_gel = _axes(left, right, centres["right"] - centres["left"])
    seen = {}
    for name, centre in centres.items():
        p = (points - centre) @ R_rect_gel.T
        if not p[:, 2].min() > 0:
            msg = (
                f"views: found the {name} camera beside or behind the pattern in the rectified "
                "pair, expected cameras that look at it from both sides: check their poses"
            )
            raise GeometryError(msg)
        seen[name] = p[:, :2] / p[:, 2:]
    low = np.min([xy.min(axis=0) for xy in seen.values()], axis=0)
    high = np.max([xy.max(axis=0) for xy in seen.values()], axis=0)
    size = np.min([(v.placement.width, v.placement.height) for v in views.values()], axis=0)
    focal = float((size / ((high - low) * (1 + MARGIN))).min())
    for name, view in views.items():
        focal = min(focal, _same_scale(view, centres[name], points))
    cx, cy = (size - 1) / 2 - focal * (low + high) / 2
    matrix = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    baseline = float(np.linalg.norm(centres["right"] - centres["left"]))
    return {
        name: RectifiedCamera(
            _pose(R_rect_gel, centre), matrix, baseline if name == "right" else 0.0
        )
        for name, centre in centres.items()
    }


def _effective_centre(view: ViewGeometry, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The point (3,) that the view's rays to the points come from, behind all layers.

    Refracted rays have no common point.  This one is nearest to them all, by angle seen from the
    points, so that a pinhole there sees points near the given ones where the view does.
    """
    centre = view.centre
    if not view.layers:
        return centre
    _, v = view.rays(view.project(points))
    shown = np.isfinite(v).all(axis=1)
    v, points = v[shown], points[shown]
    across = np.eye(3) - v[:, :, None] * v[:, None, :]
    for _ in range(CENTRE_ROUNDS):
        weighted = across / ((points - centre) ** 2).sum(axis=1)[:, None, None]
        centre = np.linalg.solve(weighted.sum(axis=0), np.einsum("nij,nj->i", weighted, points))
    return np.asarray(centre)


def _axes(
    left: ViewGeometry, right: ViewGeometry, between: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(3, 3) gel frame -> rectified frame: x along the baseline, z between the optical axes."""
    x = between / np.linalg.norm(between)
    z = left.T_view_gel[2, :3] + right.T_view_gel[2, :3]
    z -= (z @ x) * x
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])


def _same_scale(
    view: ViewGeometry, centre: NDArray[np.float64], points: NDArray[np.float64]
) -> float:
    """Focal length, px, that shows the points from `centre` as large as the view does."""
    middle = points.mean(axis=0)
    farther = np.linalg.norm(middle - centre) / np.linalg.norm(middle - view.centre)
    return float(view.lens.matrix[0, 0] * farther)


def _pose(R_rect_gel: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_rect_gel, -R_rect_gel @ centre
    return T
