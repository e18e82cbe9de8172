"""Geometry of the views: rays from pixels and pixels from points, both in the gel frame.

A mirror shows the gel as a virtual camera behind it would, but mirror-inverted.  Each view image
is flipped left to right when it is cut out, so that its virtual camera is an ordinary
right-handed one; ViewPlacement.flipped is the only trace of the mirror after this module.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.grid import ViewPlacement
from cmp_tactile_processing.lens import Lens
from cmp_tactile_processing.ray_kernels import RayBundle, RayModel
from cmp_tactile_processing.refraction import apparent_points, refract_rays
from cmp_tactile_processing.sensor_description import (
    Camera,
    Mirror,
    RefractingLayer,
    SensorDescription,
    ViewDescription,
)

__all__ = ["ViewGeometry", "build_views", "reflection"]

# A view must show this share of the pattern at rest: a cut-off border is a normal rig.
LEAST_SHOWN = 0.5
SMALLEST_BASELINE_M = 1e-5
FLIP_X = np.diag([-1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class ViewGeometry:
    """One view as published.  T_view_gel (4, 4): gel frame -> its right-handed optical frame."""

    name: str
    placement: ViewPlacement
    lens: Lens
    T_view_gel: NDArray[np.float64]
    layers: tuple[RefractingLayer, ...] = ()

    @property
    def centre(self) -> NDArray[np.float64]:
        """Camera centre (3,), gel frame, m."""
        return np.asarray(-self.T_view_gel[:3, :3].T @ self.T_view_gel[:3, 3])

    def rays(self, q_view: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Origins and unit directions, (..., 3) each, gel frame, of pixels (..., 2) of the view.

        The rays are those inside the gel, behind all refracting layers.  NaN stays NaN.
        """
        shape = (*np.shape(q_view)[:-1], 3)
        directions = self.lens.directions(q_view) @ self.T_view_gel[:3, :3]
        origins = np.broadcast_to(self.centre, directions.shape)
        origins, directions = refract_rays(origins, directions, self.layers)
        return origins.reshape(shape), directions.reshape(shape)

    def ray_bundle(self, q_view: NDArray[np.float64]) -> RayBundle:
        """The rays of pixels (N, 2) with their derivatives, for error propagation; compiled."""
        return RayModel(self.lens, self.T_view_gel, self.layers).bundle(q_view)

    def project(self, p_gel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (..., 2) of the view for points (..., 3), gel frame, m."""
        points = np.reshape(np.asarray(p_gel, dtype=np.float64), (-1, 3))
        points = apparent_points(self.centre, points, self.layers)
        p_view = points @ self.T_view_gel[:3, :3].T + self.T_view_gel[:3, 3]
        return self.lens.project(p_view).reshape(*np.shape(p_gel)[:-1], 2)


def reflection(mirror: Mirror) -> NDArray[np.float64]:
    """(4, 4) that maps points to their mirror images: p' = p - 2 (n . p - d) n."""
    T = np.eye(4)
    T[:3, :3] -= 2 * np.outer(mirror.normal, mirror.normal)
    T[:3, 3] = 2 * mirror.distance * mirror.normal
    return T


def build_views(sensor: SensorDescription) -> dict[str, ViewGeometry]:
    """The views of a sensor by name, "left" and "right" (one of them for a monocular one).

    Raises DescriptionError where the pattern at rest does not lie in a view's part of the frame,
    where a refracting layer does not lie between a camera and the pattern, or where both views
    look from the same point.
    """
    views = {name: _build_view(sensor, name, view) for name, view in sensor.views.items()}
    for view in views.values():
        _check_layers(sensor, view)
    if len(views) == 2:
        baseline = float(np.linalg.norm(views["left"].centre - views["right"].centre))
        if baseline < SMALLEST_BASELINE_M:
            msg = (
                f"{sensor.name}: views: found camera centres {baseline:.2g} m apart, "
                f"expected at least {SMALLEST_BASELINE_M:g} m"
            )
            raise DescriptionError(msg)
    return views


def _build_view(sensor: SensorDescription, name: str, view: ViewDescription) -> ViewGeometry:
    T_view_gel = view.T_view_gel if view.T_view_gel is not None else sensor.optics.T_camera_gel
    camera = view.camera or sensor.camera
    if T_view_gel is None or camera is None:
        msg = f"{sensor.name}: views.{name}: found no camera pose, expected T_view_gel"
        raise DescriptionError(msg)
    flipped = view.mirror is not None
    if view.mirror is not None:
        T_view_gel = FLIP_X @ reflection(view.mirror) @ T_view_gel
    roi = view.roi
    placement = ViewPlacement(roi.x, roi.y, roi.width, roi.height, flipped)
    corners = sensor.pattern.corners()
    origins = [placement]
    if view.camera is not None:
        # The principal point of a view's own camera may be counted from the corner of its part of
        # the frame instead: that reading holds where it shows more of the pattern.
        origins.append(ViewPlacement(0, 0, roi.width, roi.height, flipped))
    readings = [
        ViewGeometry(name, placement, _intrinsics(camera, origin), T_view_gel, sensor.optics.layers)
        for origin in origins
    ]
    shown = [_share_inside(item.project(corners), roi.width, roi.height) for item in readings]
    geometry = readings[int(np.argmax(shown))]
    if max(shown) >= LEAST_SHOWN:
        return geometry
    centre = np.round(placement.to_frame(geometry.project(corners.reshape(-1, 3)).mean(axis=0)))
    msg = (
        f"{sensor.name}: views.{name}: found the pattern's centre at pixel {centre.tolist()}, "
        f"expected it inside roi {[roi.x, roi.y, roi.width, roi.height]}; check the camera, "
        f"the pose and the mirror of this view"
    )
    raise DescriptionError(msg)


def _intrinsics(camera: Camera, placement: ViewPlacement) -> Lens:
    return Lens.of_view(camera, placement.x, placement.y, placement.width, placement.flipped)


def _share_inside(q: NDArray[np.float64], width: int, height: int) -> float:
    x, y = q[..., 0], q[..., 1]
    inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
    return float(inside.mean())


def _check_layers(sensor: SensorDescription, view: ViewGeometry) -> None:
    low, high = float(view.centre[2]), float(sensor.pattern.corners()[..., 2].min())
    for number, layer in enumerate(view.layers):
        if not low < layer.z < high:
            msg = (
                f"{sensor.name}: optics.layers[{number}].z: found {layer.z:g}, expected a plane "
                f"between the {view.name} camera at z = {low:.4g} and the pattern, from {high:.4g}"
            )
            raise DescriptionError(msg)
