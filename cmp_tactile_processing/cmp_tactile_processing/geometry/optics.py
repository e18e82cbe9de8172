"""Geometry of the views: rays from pixels and pixels from points, both in the gel frame.

A mirror shows the gel as a virtual camera behind it would, but mirror-inverted.  Each view image
is flipped left to right when it is cut out, so that its virtual camera is an ordinary
right-handed one; ViewPlacement.flipped is the only trace of the mirror after this module.
docs/optics.md has the formulas and a drawing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.lens import Lens
from cmp_tactile_processing.geometry.refraction import (
    RayBundle,
    RayModel,
    apparent_points,
    apparent_points_with_jacobian,
    refract_rays,
)
from cmp_tactile_processing.measured import ViewPlacement
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import (
    Camera,
    Mirror,
    RefractingLayer,
    Roi,
    ViewDescription,
)

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

        The rays are those inside the gel, behind all refracting layers; without layers all origins
        are the camera centre.  NaN for NaN, for pixels outside the lens's field, and where a ray
        does not get through the layers.
        """
        shape = (*np.shape(q_view)[:-1], 3)
        directions = self.lens.directions(np.reshape(q_view, (-1, 2))) @ self.T_view_gel[:3, :3]
        origins = np.broadcast_to(self.centre, directions.shape)
        origins, directions = refract_rays(origins, directions, self.layers)
        return origins.reshape(shape), directions.reshape(shape)

    def ray_bundle(self, q_view: NDArray[np.float64]) -> RayBundle:
        """The rays of pixels (N, 2) with their derivatives, for error propagation; compiled."""
        return RayModel(self.lens, self.T_view_gel, self.layers).bundle(q_view)

    def project(self, p_gel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (..., 2) of the view for points (..., 3), gel frame, m.

        NaN for NaN and for points outside the lens's field, so behind the camera.  Pixels outside
        the view's image are pixels too.
        """
        points = np.reshape(np.asarray(p_gel, dtype=np.float64), (-1, 3))
        points = apparent_points(self.centre, points, self.layers)
        p_view = points @ self.T_view_gel[:3, :3].T + self.T_view_gel[:3, 3]
        return self.lens.project(p_view).reshape(*np.shape(p_gel)[:-1], 2)

    def project_with_jacobian(
        self, p_gel: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels (..., 2) as `project` gives them, and their derivatives (..., 2, 3), px per m.

        Analytic, through layers, pose and lens; NaN where there is no pixel.
        """
        shape = np.shape(p_gel)[:-1]
        points = np.reshape(np.asarray(p_gel, dtype=np.float64), (-1, 3))
        points, by_point = apparent_points_with_jacobian(self.centre, points, self.layers)
        R = self.T_view_gel[:3, :3]
        q, by_view = self.lens.project_with_jacobian(points @ R.T + self.T_view_gel[:3, 3])
        J = by_view @ R @ by_point if self.layers else by_view @ R
        return q.reshape(*shape, 2), J.reshape(*shape, 2, 3)


def reflection(mirror: Mirror) -> NDArray[np.float64]:
    """(4, 4) that maps points to their mirror images: p' = p - 2 (n . p - d) n."""
    T = np.eye(4)
    T[:3, :3] -= 2 * np.outer(mirror.normal, mirror.normal)
    T[:3, 3] = 2 * mirror.distance * mirror.normal
    return T


def virtual_camera_pose(mirror: Mirror, T_camera_gel: NDArray[np.float64]) -> NDArray[np.float64]:
    """T_view_gel (4, 4) of the right-handed camera that sees the un-mirrored view of a mirror."""
    return np.asarray(FLIP_X @ reflection(mirror) @ T_camera_gel)


def view_geometry(
    name: str,
    camera: Camera,
    placement: ViewPlacement,
    T_view_gel: NDArray[np.float64],
    layers: tuple[RefractingLayer, ...] = (),
) -> ViewGeometry:
    """One view from its camera and pose, without the checks of `build_views`.

    camera: principal point in px of what `placement` was cut out of.  For a view by a mirror
    placement.flipped is set and T_view_gel is that of `virtual_camera_pose`.  Cheap: for a
    calibration that varies camera and pose.
    """
    place = placement
    lens = Lens.of_view(camera, place.x, place.y, place.width, place.flipped)
    return ViewGeometry(name, placement, lens, T_view_gel, layers)


def build_views(sensor: SensorDescription) -> dict[str, ViewGeometry]:
    """The views of a sensor by name, "left" and "right" (one of them for a monocular one).

    Raises InputError where the pattern at rest does not lie in a view's part of the frame,
    where a refracting layer does not lie between a camera and the pattern, or where both views
    look from the same point.
    """
    corners = sensor.pattern.corners().reshape(-1, 3)
    views = {name: _build_view(sensor, name, corners) for name in sensor.views}
    for view in views.values():
        _check_layers(sensor, view, float(corners[:, 2].min()))
    if len(views) == 2:
        baseline = float(np.linalg.norm(views["left"].centre - views["right"].centre))
        if baseline < SMALLEST_BASELINE_M:
            msg = (
                f"{sensor.origin}: views: found camera centres {baseline:.2g} m apart, "
                f"expected at least {SMALLEST_BASELINE_M:g} m"
            )
            raise InputError(msg)
    return views


def _build_view(sensor: SensorDescription, name: str, corners: NDArray[np.float64]) -> ViewGeometry:
    """The view's geometry; corners (N, 3): what it must show."""
    view = sensor.views[name]
    readings = _readings(sensor, name, view)
    pixels = [reading.project(corners) for reading in readings]
    shown = [_share_inside(q, view.roi) for q in pixels]
    best = int(np.argmax(shown))
    if shown[best] >= LEAST_SHOWN:
        return readings[best]
    seen = pixels[best][np.isfinite(pixels[best]).all(axis=1)]
    found = "no pixel for the pattern"
    if len(seen):
        centre = np.round(readings[best].placement.to_frame(seen.mean(axis=0)))
        found = f"the pattern's centre at pixel {centre.tolist()}"
    roi = view.roi
    msg = (
        f"{sensor.origin}: views.{name}: found {found}, {shown[best]:.0%} of its corners inside "
        f"roi {[roi.x, roi.y, roi.width, roi.height]}, expected at least {LEAST_SHOWN:.0%}; check "
        "the camera, the pose and the mirror of this view"
    )
    raise InputError(msg)


def described_view(sensor: SensorDescription, name: str) -> ViewGeometry:
    """A view as it is described, without the checks of `build_views`.

    Raises InputError for a view without a camera or a pose.
    """
    view = sensor.views[name]
    T_view_gel = view.T_view_gel if view.T_view_gel is not None else sensor.optics.T_camera_gel
    camera = view.camera or sensor.camera
    if T_view_gel is None or camera is None:
        msg = f"{sensor.origin}: views.{name}: found no camera pose, expected T_view_gel"
        raise InputError(msg)
    if view.mirror is not None:
        T_view_gel = virtual_camera_pose(view.mirror, T_view_gel)
    roi, flipped = view.roi, view.mirror is not None
    placement = ViewPlacement(roi.x, roi.y, roi.width, roi.height, flipped)
    return view_geometry(name, camera, placement, T_view_gel, sensor.optics.layers)


def _readings(sensor: SensorDescription, name: str, view: ViewDescription) -> list[ViewGeometry]:
    """What the description of a view may mean, the more likely first."""
    geometry = described_view(sensor, name)
    if view.camera is None or (view.roi.x, view.roi.y) == (0, 0):
        return [geometry]
    # The principal point of a view's own camera may be counted from the corner of its part of the
    # frame instead: that reading holds where it shows more of the pattern.
    own = Lens.of_view(view.camera, 0, 0, view.roi.width, view.mirror is not None)
    return [geometry, replace(geometry, lens=own)]


def _share_inside(q: NDArray[np.float64], roi: Roi) -> float:
    x, y = q[..., 0], q[..., 1]
    inside = (x > -0.5) & (x < roi.width - 0.5) & (y > -0.5) & (y < roi.height - 0.5)
    return float(inside.mean())


def _check_layers(sensor: SensorDescription, view: ViewGeometry, high: float) -> None:
    low = float(view.centre[2])
    for number, layer in enumerate(view.layers):
        if not low < layer.z < high:
            msg = (
                f"{sensor.origin}: optics.layers[{number}].z: found {layer.z:g}, expected a plane "
                f"between the {view.name} camera at z = {low:.4g} and the pattern, from {high:.4g}"
            )
            raise InputError(msg)


def tilt_axes(mirror: Mirror) -> tuple[int, int]:
    """The two of the camera's axes that lie most in the mirror's plane."""
    first, second = sorted(np.argsort(np.abs(mirror.normal))[:2])
    return int(first), int(second)


def tilt_directions(mirror: Mirror) -> NDArray[np.float64]:
    """(2, 3) unit vectors within the mirror's plane, towards those axes."""
    n = mirror.normal
    directions = np.stack([np.eye(3)[axis] - n[axis] * n for axis in tilt_axes(mirror)])
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))
