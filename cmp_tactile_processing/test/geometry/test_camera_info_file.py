"""Camera models as files of camera_calibration_parsers: read back exactly, checked key by key."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.rectification import (
    Rectification,
    read_camera_info,
    write_camera_info,
)

# As camera_calibration_parsers writes it: other order of keys, whole numbers, binning and roi.
FOREIGN = """\
image_width: 640
image_height: 480
camera_name: mono_left
camera_matrix:
  rows: 3
  cols: 3
  data: [369.344588, 0, 320.739078, 0, 367.154330, 203.592450, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.189544, -0.018229, -0.000630, 0.000054, -0.000212]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [262.927429, 0, 320.984481, 0, 0, 302.056213, 188.592437, 0, 0, 0, 1, 0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
"""


def infos(sensor):
    fisheye = replace(sensor.camera, model="equidistant", distortion=(0.1, 1e-17, 0.0, -1 / 3))
    rectification = Rectification(sensor)
    found = {view: rectification.info(view) for view in ("left", "right")}
    return {**found, "fisheye": Rectification(replace(sensor, camera=fisheye)).info("left")}


@pytest.mark.parametrize("name", ["left", "right", "fisheye"])
def test_written_model_reads_back_to_the_last_bit(tmp_path, sensor, name):
    info = infos(sensor)[name]
    path = tmp_path / "left.yaml"
    write_camera_info(path, "rig: left", info)
    camera, found = read_camera_info(path)
    assert camera == "rig: left"
    assert (found.width, found.height, found.model) == (info.width, info.height, info.model)
    for key in ("D", "K", "R", "P"):
        assert getattr(found, key).shape == getattr(info, key).shape
        assert getattr(found, key).tobytes() == getattr(info, key).tobytes()
    assert [item.name for item in tmp_path.iterdir()] == ["left.yaml"]


def test_file_of_ros_is_read(tmp_path):
    path = tmp_path / "ros.yaml"
    path.write_text(FOREIGN)
    name, info = read_camera_info(path)
    assert (name, info.width, info.height, info.model) == ("mono_left", 640, 480, "plumb_bob")
    np.testing.assert_array_equal(info.K[1], [0, 367.154330, 203.592450])
    np.testing.assert_array_equal(info.P[0], [262.927429, 0, 320.984481, 0])
    bare = "".join(
        f"{line}\n" for line in FOREIGN.splitlines() if not line.startswith(("camera_n", "dist"))
    ).replace("  rows: 1\n  cols: 5\n", "distortion_coefficients:\n  rows: 1\n  cols: 5\n")
    path.write_text(bare)
    name, info = read_camera_info(path)
    assert (name, info.model, len(info.D)) == ("unknown", "plumb_bob", 5)


def test_files_of_other_tools_are_read(tmp_path):
    """Without k3, and with the model by its earlier name; tried: the first was refused, and of the
    second the model was not read.

    Reports: ethz-asl/kalibr 569, hku-mars/FAST-Calib 29, ros-drivers/video_stream_opencv 100.
    """
    path = tmp_path / "ros.yaml"
    short = FOREIGN.replace("cols: 5", "cols: 4").replace(", -0.000212]", "]")
    path.write_text(short)
    _, info = read_camera_info(path)
    np.testing.assert_array_equal(info.D, [0.189544, -0.018229, -0.000630, 0.000054, 0])
    path.write_text(short.replace("distortion_model: plumb_bob", "camera_model: equidistant"))
    _, info = read_camera_info(path)
    assert (info.model, len(info.D)) == ("equidistant", 4)
    # Another tool's kind of projection.
    path.write_text(short.replace("distortion_model: plumb_bob", "camera_model: pinhole"))
    assert read_camera_info(path)[1].model == "plumb_bob"


@pytest.mark.parametrize(
    ("model", "found", "kept"),
    [
        ("rational_polynomial", 8, 8),
        ("rational_polynomial", 12, 12),
        ("rational_polynomial", 14, 14),
        ("plumb_bob", 8, 5),
    ],
)
def test_longer_distortions_are_read(tmp_path, model, found, kept):
    """Thin prism and tilt of OpenCV's rational model, and plumb_bob with zeros; tried: refused.

    Reports: stereolabs/zed-ros2-wrapper 128, introlab/rtabmap 1560, orbbec/OrbbecSDK_ROS2 216.
    """
    coefficients = [0.01 * (number + 1) for number in range(kept)] + [0.0] * (found - kept)
    text = FOREIGN.replace("model: plumb_bob", f"model: {model}")
    begin, end = text.index("  cols: 5"), text.index("rectification_matrix")
    path = tmp_path / "ros.yaml"
    path.write_text(f"{text[:begin]}  cols: {found}\n  data: {coefficients}\n{text[end:]}")
    _, info = read_camera_info(path)
    assert info.D.tolist() == coefficients[:kept]
    write_camera_info(path, "again", info)
    assert read_camera_info(path)[1].D.tolist() == coefficients[:kept]


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("image_width: 640\n", "", r"image_width: found nothing, expected a whole number"),
        ("image_width: 640", "image_width: 0", r"image_width: found 0, expected a whole number"),
        ("rows: 3", "rows: 4", r"camera_matrix\.rows: found 4, expected 3"),
        ("cols: 4", "cols: 3", r"projection_matrix\.cols: found 3, expected 4"),
        ("369.344588", ".nan", r"camera_matrix\.data\[0\]: found nan, expected a number"),
        ("369.344588", "0", r"camera_matrix: .*expected .*focal"),
        ("data: [1, 0, 0", "data: [1, 0.1, 0", r"rectification_matrix: .*expected a right-handed"),
        ("plumb_bob", "fov", r"distortion_model: found 'fov', expected one of plumb_bob, equidist"),
        ("plumb_bob", "equidistant", r"distortion_coefficients\.cols: found 5, expected 4"),
        (
            "cols: 5\n  data: [",
            "cols: 6\n  data: [1, ",
            r"data: found .*expected 0 after the 5 coef",
        ),
        ("binning_x: 0", "binning_x: 2", r"binning_x: found 2, expected a whole number from 0 to"),
        ("x_offset: 0", "x_offset: 8", r"roi: found \[8, 0, 0, 0\], expected the whole image"),
        (FOREIGN[FOREIGN.index(", 0.000054") :], "", r"not a YAML file"),
        (FOREIGN, "", r"top level: found None, expected a mapping"),
        ("image_width", "%YAML:1.0\nimage_width", r"not a YAML file"),
    ],
)
def test_wrong_key_is_named_with_file_found_and_expected(tmp_path, old, new, expected):
    path = tmp_path / "ros.yaml"
    assert old in FOREIGN
    path.write_text(FOREIGN.replace(old, new, 1))
    with pytest.raises(InputError, match=rf"ros\.yaml(:\d+)?: .*({expected})"):
        read_camera_info(path)
