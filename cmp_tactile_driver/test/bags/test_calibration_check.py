"""A recording whose camera infos are not those of the sensor description is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_driver.bags.reader import BagReader, RecordedCalibration, calibration_mismatch
from cmp_tactile_processing.sensor.library import load_sensor

SENSOR = load_sensor("sample_rig")
K = np.array([[733.386, 0, 511.5], [0, 733.386, 383.5], [0, 0, 1]])
OWN = RecordedCalibration("/rig/camera_info", 1024, 768, K, np.zeros(5))


@pytest.mark.parametrize(
    "found",
    [
        None,
        OWN,
        replace(OWN, D=np.zeros(0)),
        replace(OWN, D=np.zeros(8)),
        replace(OWN, K=np.zeros((3, 3)), D=np.ones(5)),
    ],
    ids=["no camera info", "rounded", "D left out", "D of another length", "not calibrated"],
)
def test_what_does_not_contradict_the_description_is_taken(found):
    assert calibration_mismatch(found, SENSOR) == ""


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"width": 640}, "/rig/camera_info: width: found 640, expected 1024: is sample_rig the"),
        ({"height": 480}, "/rig/camera_info: height: found 480, expected 768"),
        (
            {"K": K * [[0.9, 1, 1], [1, 1, 1], [1, 1, 1]]},
            "K: found [660.047, 0, 511.5, 0, 733.386, 383.5, 0, 0, 1], expected [733.386, 0,",
        ),
        ({"D": np.array([0.0, 0.0, 0.2])}, "D: found [0, 0, 0.2], expected [0, 0, 0, 0, 0]"),
    ],
)
def test_a_difference_names_topic_field_found_and_expected(change, expected):
    assert expected in calibration_mismatch(replace(OWN, **change), SENSOR)


def test_a_sensor_with_a_camera_per_view_is_compared_by_size():
    several = replace(SENSOR, camera=None)
    assert calibration_mismatch(replace(OWN, K=2 * K), several) == ""
    assert "width" in calibration_mismatch(replace(OWN, width=1), several)


def test_the_calibration_is_read_from_the_bag(frame_bag, frames, tmp_path, bags):
    found = BagReader(frame_bag).calibration()
    assert found is not None
    assert (found.topic, found.height) == ("/rig/camera_info", frames[0].shape[0])
    np.testing.assert_array_equal(found.K, np.arange(9.0).reshape(3, 3))
    np.testing.assert_array_equal(found.D, [0.1, 0.2, 0.3, 0.4, 0.5])
    bag = bags.write(tmp_path / "bare", {"/image_raw": [bags.image(frames[0], 0)]})
    assert BagReader(bag).calibration() is None
