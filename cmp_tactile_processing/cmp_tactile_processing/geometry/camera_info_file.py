"""Camera models as YAML files in the format of ROS's camera_calibration_parsers.

camera_info_manager, and with it the camera drivers of ROS, loads these files.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.files import write_whole
from cmp_tactile_processing.geometry.rectification import ViewCameraInfo
from cmp_tactile_processing.sensor.yaml_section import YamlSection, parse_yaml, read_yaml
from cmp_tactile_processing.sensor.yaml_text import yaml_numbers, yaml_text

MAX_IMAGE_SIDE = 16384
# Coefficients of the distortion models of sensor_msgs.
DISTORTION_LENGTH = {"plumb_bob": 5, "equidistant": 4, "rational_polynomial": 8}
# Files of other tools hold rotations of 6 digits or more.
ROTATION_TOLERANCE = 1e-5


def write_camera_info(path: str | Path, name: str, info: ViewCameraInfo) -> None:
    """Write the camera model of the camera of that name; the file is there whole or not at all.

    Raises DescriptionError, and leaves what was there, for a model that `read_camera_info` would
    refuse and where the file cannot be written.
    """
    text = camera_info_text(name, info)
    _camera_info_of(parse_yaml(Path(path), text))
    write_whole(Path(path), text)


def camera_info_text(name: str, info: ViewCameraInfo) -> str:
    """The file as text; `read_camera_info` gives the same model of it, to the last bit."""
    return "".join(f"{line}\n" for line in _lines(name, info))


def read_camera_info(path: str | Path) -> tuple[str, ViewCameraInfo]:
    """Name and model of the camera of a file.

    As camera_calibration_parsers does: a file without `camera_name` is of the camera "unknown",
    one without `distortion_model` is plumb_bob, and keys that belong to other tools are let be.
    Raises DescriptionError naming file, key, what was found and what is expected.
    """
    return _camera_info_of(read_yaml(Path(path)))


def _lines(name: str, info: ViewCameraInfo) -> Iterator[str]:
    yield f"image_width: {info.width}"
    yield f"image_height: {info.height}"
    yield f"camera_name: {yaml_text(name)}"
    yield from _matrix("camera_matrix", info.K)
    yield f"distortion_model: {info.model}"
    yield from _matrix("distortion_coefficients", np.reshape(info.D, (1, -1)))
    yield from _matrix("rectification_matrix", info.R)
    yield from _matrix("projection_matrix", info.P)


def _matrix(key: str, matrix: NDArray[np.float64]) -> Iterator[str]:
    yield f"{key}:"
    yield f"  rows: {matrix.shape[0]}"
    yield f"  cols: {matrix.shape[1]}"
    yield f"  data: {yaml_numbers(matrix.ravel())}"


def _camera_info_of(top: YamlSection) -> tuple[str, ViewCameraInfo]:
    name = top.text("camera_name") if "camera_name" in top else "unknown"
    has_model = "distortion_model" in top
    model = top.choice("distortion_model", tuple(DISTORTION_LENGTH)) if has_model else "plumb_bob"
    info = ViewCameraInfo(
        width=top.integer("image_width", 1, MAX_IMAGE_SIDE),
        height=top.integer("image_height", 1, MAX_IMAGE_SIDE),
        model=model,
        D=_read_matrix(top, "distortion_coefficients", 1, DISTORTION_LENGTH[model]).ravel(),
        K=_read_matrix(top, "camera_matrix", 3, 3),
        R=_read_matrix(top, "rectification_matrix", 3, 3),
        P=_read_matrix(top, "projection_matrix", 3, 4),
    )
    for key, matrix in (("camera_matrix", info.K), ("projection_matrix", info.P[:, :3])):
        if min(matrix[0, 0], matrix[1, 1]) <= 0 or matrix[2].tolist() != [0.0, 0.0, 1.0]:
            expected = "focal lengths above 0 and the last row 0 0 1: a calibrated camera"
            raise top.error(key, matrix.tolist(), expected)
    # Nothing in a rotation is above 1; numpy would warn of what overflows.
    R = np.clip(info.R, -2.0, 2.0)
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        expected = f"a right-handed rotation; here R R^T is off by {off:.2g}"
        raise top.error("rectification_matrix", info.R.tolist(), expected)
    _refuse_parts_of_images(top, info)
    return name, info


def _read_matrix(top: YamlSection, key: str, rows: int, cols: int) -> NDArray[np.float64]:
    section = top.section(key)
    section.integer("rows", rows, rows)
    section.integer("cols", cols, cols)
    return np.array(section.numbers("data", rows * cols)).reshape(rows, cols)


def _refuse_parts_of_images(top: YamlSection, info: ViewCameraInfo) -> None:
    for key in ("binning_x", "binning_y"):
        if key in top:
            top.integer(key, 0, 1)
    if "roi" not in top:
        return
    roi = top.section("roi")
    found = [roi.integer(key, 0, MAX_IMAGE_SIDE) for key in ("x_offset", "y_offset")]
    found += [roi.integer(key, 0, MAX_IMAGE_SIDE) for key in ("width", "height")]
    if found not in ([0, 0, 0, 0], [0, 0, info.width, info.height]):
        raise top.error("roi", found, f"the whole image of {info.width} x {info.height} px")
