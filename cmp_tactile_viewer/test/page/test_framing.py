"""What the camera of the page frames: gels, and the handle of a simulated indenter."""

import numpy as np
import pytest

from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_viewer.page.scene import (
    HANDLE_MM,
    INDENTER_MM,
    PRESETS,
    ROOM_MM,
    UP,
    Framing,
    camera_position,
    middle_of,
)
from cmp_tactile_viewer.snapshot import Pose, ShownSensor

FOV_RAD = np.radians(50.0)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("aspect", [0.5, 1.0, 1.8])
def test_a_handle_is_whole_in_the_window(preset, aspect):
    points = Framing([ShownSensor("thumb", load_sensor("sample_rig"))], {"thumb"}).points
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


def test_the_camera_goes_farther_away_only_where_a_gel_leaves_its_room():
    """Then it still frames all places where the gel was."""
    framing = Framing([ShownSensor("thumb", load_sensor("sample_rig"))])
    far = Pose((0.5, 0.0, 0.3))
    assert framing.follow("thumb", far)
    # Where it was before tf was known does not count.
    assert framing.points[:, 0].min() > 400.0
    for height, leaves in ((0.3, False), (0.31, False), (0.34, True), (0.3, False), (0.35, False)):
        assert framing.follow("thumb", Pose((0.5, 0.0, height))) == leaves
    lowest, highest = framing.points[:, 2].min(), framing.points[:, 2].max()
    assert lowest < 300.0 - ROOM_MM
    assert highest > 340.0 + ROOM_MM
