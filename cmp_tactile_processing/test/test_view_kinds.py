"""Mirrors, two plain cameras, one view: the model against light's way found by other means.

By Fermat's principle light takes the way of stationary time.  Here that way is solved for its
crossing points with the layers, from the real camera: from its image in the mirror, and the ray is
then followed to the mirror and seen there by the real camera through OpenCV's lens, in pixels of
the whole frame.  Nothing of that uses virtual camera frames, flips or tangents.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import root

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.sensor.parts import Camera, RefractingLayer, Roi, ViewDescription

# The solver's crossing points are good to 1e-14 m, 30 mm away at 730 px focal length.
ATOL_PX = 1e-7
ATOL_RAY_M = 1e-14

LENSES = {
    "no distortion": ("pinhole", (0.0,) * 5),
    "plumb_bob": ("pinhole", (-0.2, 0.05, 1e-3, -2e-3, 0.01)),
    "equidistant": ("equidistant", (-0.02, 5e-3, 1e-3, -2e-3)),
}
STACKS = {
    "air": (),
    "gel": (RefractingLayer(-0.0057, 1.41),),
    "plate and gel": (RefractingLayer(-0.0087, 1.49), RefractingLayer(-0.0057, 1.41)),
}
KINDS = ("mirror_stereo", "two_view", "monocular", "monocular with a mirror")


def _rig(sensor, kind, lens, stack):
    model, distortion = LENSES[lens]
    camera = replace(sensor.camera, model=model, distortion=distortion, cx=505.0, cy=380.0)
    optics = replace(sensor.optics, layers=STACKS[stack])
    if kind == "mirror_stereo":
        return replace(sensor, camera=camera, optics=optics)
    if kind == "monocular with a mirror":
        views = {"right": sensor.views["right"]}
        return replace(sensor, camera=camera, views=views, optics=replace(optics, type="monocular"))
    if kind == "monocular":
        views = {"left": ViewDescription(Roi(100, 50, 824, 668))}
        pose = _looking_from(np.array([0.001, -0.002, -0.03]), turn=0.3)
        optics = replace(optics, type="monocular", T_camera_gel=pose)
        return replace(sensor, camera=camera, views=views, optics=optics)
    views = {}
    for side, name in ((-1, "left"), (1, "right")):
        own = Camera(model, 500.0, 505.0, 250.0, 390.0, distortion)
        pose = _looking_from(np.array([side * 0.008, 0.001, -0.03]), turn=0.1 * side)
        views[name] = ViewDescription(sensor.views[name].roi, camera=own, T_view_gel=pose)
    optics = replace(optics, type="two_view", T_camera_gel=None)
    return replace(sensor, camera=None, views=views, optics=optics)


def _looking_from(centre, turn):
    """T (4, 4): a camera at `centre` that looks at the apex, turned about its axis."""
    z = -centre / np.linalg.norm(centre)
    x = np.cross([-np.sin(turn), np.cos(turn), 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = [x, np.cross(z, x), z]
    T[:3, 3] = -T[:3, :3] @ centre
    return T


def _first_crossing(centre, point, layers):
    """Where the quickest way from centre to point enters the first layer, or the point."""
    if not layers:
        return point
    z = np.array([layer.z for layer in layers])
    indices = np.array([1.0, *(layer.index for layer in layers)])

    def slope_of_time(xy):
        crossings = np.column_stack([xy.reshape(-1, 2) * 1e-2, z])
        steps = np.diff(np.vstack([centre, crossings, point]), axis=0)
        units = steps / np.linalg.norm(steps, axis=1, keepdims=True)
        return np.diff(-indices[:, None] * units[:, :2], axis=0).ravel()

    share = (z - centre[2]) / (point[2] - centre[2])
    start = centre[:2] + share[:, None] * (point - centre)[:2]
    found = root(slope_of_time, start.ravel() * 1e2, tol=1e-15)
    assert np.abs(found.fun).max() < 1e-13
    return np.append(found.x[:2] * 1e-2, z[0])


def _frame_pixel(rig, name, point):
    """Pixel of a point in the whole frame, or in the view's part for a camera of its own."""
    view = rig.views[name]
    T = view.T_view_gel if view.T_view_gel is not None else rig.optics.T_camera_gel
    camera = view.camera or rig.camera
    centre = eye = -T[:3, :3].T @ T[:3, 3]
    if view.mirror is not None:
        normal = T[:3, :3].T @ view.mirror.normal
        distance = view.mirror.distance + normal @ centre
        eye = centre - 2 * (normal @ centre - distance) * normal
    aim = _first_crossing(eye, point, rig.optics.layers)
    if view.mirror is not None:
        along = (distance - normal @ eye) / (normal @ (aim - eye))
        # The mirror comes before the layers.
        assert 0 < along < 1
        aim = eye + along * (aim - eye)
    p = (T[:3, :3] @ aim + T[:3, 3]).reshape(1, 1, 3)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    project = cv2.fisheye.projectPoints if camera.model == "equidistant" else cv2.projectPoints
    return project(p, np.zeros(3), np.zeros(3), K, np.array(camera.distortion))[0].ravel()


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("kind", KINDS)
def test_light_takes_the_quickest_way_and_the_rays_of_pixels_go_back(sensor, kind, lens, stack):
    rig = _rig(sensor, kind, lens, stack)
    points = rig.pattern.corners()
    chosen = points[::6, ::6].reshape(-1, 3) + [0.0, 2e-4, -3e-4]
    for name, view in build_views(rig).items():
        q = view.project(chosen)
        if kind != "two_view":
            q = view.placement.to_frame(q)
        expected = np.array([_frame_pixel(rig, name, point) for point in chosen])
        np.testing.assert_allclose(q, expected, atol=ATOL_PX, rtol=0)
        assert view.placement.flipped == ("mirror" in kind)
        origins, directions = view.rays(view.project(points))
        miss = np.linalg.norm(np.cross(points - origins, directions), axis=-1)
        assert miss.max() < ATOL_RAY_M
        assert ((points - origins) * directions).sum(axis=-1).min() > 0
