"""Rectified images and camera models of the views, by the conventions of image_pipeline."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.optics import ViewGeometry, build_views
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_processing.split import check_image

__all__ = ["Rectification", "ViewCameraInfo"]

ROS_MODEL = {"pinhole": "plumb_bob", "equidistant": "equidistant"}


@dataclass(frozen=True)
class ViewCameraInfo:
    """The numbers of sensor_msgs/CameraInfo: size px, model name, D, K (3, 3), R (3, 3), P (3, 4).

    The right view's P[0, 3] is -fx times the baseline in m.
    """

    width: int
    height: int
    model: str
    D: NDArray[np.float64]
    K: NDArray[np.float64]
    R: NDArray[np.float64]
    P: NDArray[np.float64]


class Rectification:
    """Camera models of the published views, and their rectified images.

    The rectified pair has its rows along the baseline and its principal points set so that each
    image shows the pattern at rest in its middle.  It serves people and other nodes: tracking
    works on the unrectified views, because interpolation costs accuracy, and refracting layers are
    not part of a rectified image's model.  A monocular view is undistorted only.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self._views = build_views(sensor)
        self._info = _camera_infos(self._views, sensor.pattern.corners().reshape(-1, 3))
        self._maps: dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}

    def info(self, view: str) -> ViewCameraInfo:
        """Camera model of a view; GeometryError where the sensor has none of that name."""
        if view not in self._info:
            msg = f"found no view '{view}', expected one of {', '.join(self._info)}"
            raise GeometryError(msg)
        return self._info[view]

    def rectify(self, view: str, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Rectified image of a view, same size; black where it shows nothing."""
        info = self.info(view)
        check_image(image, info.width, info.height, f"{view} view")
        if view not in self._maps:
            self._maps[view] = self._build_maps(view)
        return np.asarray(cv2.remap(image, *self._maps[view], cv2.INTER_LINEAR), dtype=np.uint8)

    def _build_maps(self, view: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        info = self._info[view]
        v, u = np.mgrid[: info.height, : info.width]
        pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
        directions = pixels @ np.linalg.inv(info.P[:, :3]).T @ info.R
        q = self._views[view].lens.project(directions).reshape(info.height, info.width, 2)
        return q[..., 0].astype(np.float32), q[..., 1].astype(np.float32)


def _camera_infos(
    views: dict[str, ViewGeometry], points: NDArray[np.float64]
) -> dict[str, ViewCameraInfo]:
    """Camera models of all views; points (N, 3): what the rectified images are to show."""
    if len(views) < 2:
        return {
            name: _camera_info(view, np.eye(3), view.lens.matrix, 0.0)
            for name, view in views.items()
        }
    left, right = views["left"], views["right"]
    R_rect_gel = _rectified_axes(left, right)
    seen = {}
    for name, view in views.items():
        p = (points - view.centre) @ R_rect_gel.T
        seen[name] = p[:, :2] / p[:, 2:]
    focal = min(_fitting_focal_length(view, seen[name]) for name, view in views.items())
    baseline = float(np.linalg.norm(right.centre - left.centre))
    # Rows must match: both images share cy.
    cy = (left.placement.height - 1) / 2 - focal * _middle(np.concatenate(list(seen.values())))[1]
    infos = {}
    for name, view in views.items():
        cx = (view.placement.width - 1) / 2 - focal * _middle(seen[name])[0]
        matrix = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
        rotation = R_rect_gel @ view.T_view_gel[:3, :3].T
        infos[name] = _camera_info(view, rotation, matrix, baseline if name == "right" else 0.0)
    return infos


def _camera_info(
    view: ViewGeometry, rotation: NDArray[np.float64], matrix: NDArray[np.float64], baseline: float
) -> ViewCameraInfo:
    translation = np.array([[-matrix[0, 0] * baseline], [0.0], [0.0]])
    return ViewCameraInfo(
        width=view.placement.width,
        height=view.placement.height,
        model=ROS_MODEL[view.lens.model],
        D=view.lens.distortion,
        K=view.lens.matrix,
        R=rotation,
        P=np.concatenate([matrix, translation], axis=1),
    )


def _rectified_axes(left: ViewGeometry, right: ViewGeometry) -> NDArray[np.float64]:
    """(3, 3) gel frame -> rectified frame: x along the baseline, z between the optical axes."""
    x = right.centre - left.centre
    x /= np.linalg.norm(x)
    z = left.T_view_gel[2, :3] + right.T_view_gel[2, :3]
    z -= (z @ x) * x
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])


def _middle(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def _fitting_focal_length(view: ViewGeometry, xy: NDArray[np.float64]) -> float:
    """The view's own focal length, or less where the pattern would not fit with a margin."""
    extent = np.ptp(xy, axis=0) * 1.1
    size = np.array([view.placement.width, view.placement.height])
    return float(min(view.lens.matrix[0, 0], (size / extent).min()))
