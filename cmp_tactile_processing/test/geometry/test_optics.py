"""Rigs whose views cannot be built are refused, with the reason.

That pixels and rays are right: test_view_kinds, test_projection.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.sensor.parts import Camera, RefractingLayer


def test_a_rig_that_does_not_show_its_pattern_is_refused(sensor):
    pose = sensor.optics.T_camera_gel.copy()
    pose[0, 3] += 0.03
    rig = replace(sensor, optics=replace(sensor.optics, T_camera_gel=pose))
    with pytest.raises(InputError, match=r"views\.left: found the pattern's centre at pixel"):
        build_views(rig)


def test_a_pattern_outside_the_lenss_field_is_refused(sensor):
    """Through the polynomial alone its corners would fold back into the image."""
    rig = replace(sensor, camera=replace(sensor.camera, distortion=(-40.0, 0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match=r"views\.left: found no pixel for the pattern, 0% of"):
        build_views(rig)


@pytest.mark.parametrize("z", [-0.3, 0.003, -0.0005])
def test_a_layer_outside_the_way_of_the_rays_is_refused(sensor, z):
    layers = (RefractingLayer(z, 1.4),)
    rig = replace(sensor, optics=replace(sensor.optics, layers=layers))
    with pytest.raises(InputError, match=r"optics\.layers\[0\]\.z: found .*between the left"):
        build_views(rig)


@pytest.mark.parametrize("offset", [0, 512], ids=["from the roi's corner", "from the frame's"])
def test_two_cameras_may_count_their_principal_point_from_roi_or_frame(sensor, offset):
    """Side-by-side images of two cameras, the right one's principal point in either count."""
    mirrored = build_views(sensor)
    views = {}
    for name, view in sensor.views.items():
        cx = 255.5 + (offset if name == "right" else 0)
        camera = Camera("pinhole", 500.0, 500.0, cx, 383.5, (0.0,) * 5)
        # Turn the camera so that it looks at the pattern's middle.
        T = mirrored[name].T_view_gel.copy()
        axis = T[:3, 3] / np.linalg.norm(T[:3, 3])
        turn = _rotation_between(axis, np.array([0.0, 0.0, 1.0]))
        T[:3] = turn @ T[:3]
        views[name] = replace(view, mirror=None, camera=camera, T_view_gel=T)
    optics = replace(sensor.optics, type="two_view", T_camera_gel=None)
    rig = replace(sensor, views=views, optics=optics, camera=None)
    q = build_views(rig)["right"].project(np.zeros(3))
    np.testing.assert_allclose(q, [255.5, 383.5], atol=1e-9)
    assert not build_views(rig)["right"].placement.flipped


def _rotation_between(a, b):
    v, c = np.cross(a, b), a @ b
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + K + K @ K / (1 + c)


def test_two_views_from_one_point_are_refused(sensor):
    rig = replace(sensor, views=dict.fromkeys(("left", "right"), sensor.views["left"]))
    with pytest.raises(InputError, match=r"views: found camera centres 0 m apart"):
        build_views(rig)
