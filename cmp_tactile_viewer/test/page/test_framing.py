"""What the camera of the page frames: gels, and the handle of a simulated indenter."""

import numpy as np
import pytest

from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_viewer.page.scene import (
    HANDLE_MM,
    INDENTER_MM,
    PRESETS,
    UP,
    camera_position,
    framed_points,
    middle_of,
)
from cmp_tactile_viewer.snapshot import ShownSensor

FOV_RAD = np.radians(50.0)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("aspect", [0.5, 1.0, 1.8])
def test_a_handle_is_whole_in_the_window(preset, aspect):
    points = framed_points([ShownSensor("thumb", load_sensor("sample_rig"))], {"thumb"})
    camera = camera_position(points, preset, FOV_RAD, aspect)
    towards = camera - middle_of(points)
    towards /= np.linalg.norm(towards)
    right = np.cross(UP, towards)
    right /= np.linalg.norm(right)
    arrows = HANDLE_MM * np.eye(3) + (0.0, 0.0, INDENTER_MM)
    seen = arrows - camera
    half = np.tan(FOV_RAD / 2) * -(seen @ towards)
    assert (half > 0).all()
    assert (np.abs(seen @ right) < aspect * half).all()
    assert (np.abs(seen @ np.cross(towards, right)) < half).all()
