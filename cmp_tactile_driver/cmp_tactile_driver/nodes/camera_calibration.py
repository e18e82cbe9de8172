"""The camera_info of a camera: of its sensor description, of a file, or set by a service."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo
from std_msgs.msg import Header

from cmp_tactile_driver.bags.reader import calibration_mismatch
from cmp_tactile_processing.errors import CmpTactileError, InputError
from cmp_tactile_processing.geometry.rectification import (
    ViewCameraInfo,
    read_camera_info,
    write_camera_info,
)
from cmp_tactile_processing.ros.messages.conversions import camera_info_to_msg, with_header
from cmp_tactile_processing.ros.messages.making import whole_frame_info
from cmp_tactile_processing.ros.messages.reading import camera_info_from_msg
from cmp_tactile_processing.sensor.description import SensorDescription

EXPECTED = "file://PATH or package://PACKAGE/PATH"

SERVICE = "set_camera_info"


def image_qos() -> QoSProfile:
    """For frames and their camera_info.  A new one each time: rclpy writes overrides into it."""
    return QoSProfile(depth=10)


def camera_info_of(sensor: SensorDescription, header: Header) -> CameraInfo:
    """The calibration of the whole frame, unrectified."""
    return camera_info_to_msg(whole_frame_info(sensor), header)


def camera_info_path(url: str, camera_name: str) -> Path | None:
    """The path; None for an empty URL.  ${NAME} is the camera's, ${ROS_HOME} as ROS has it.

    Raises InputError for another kind of URL and for a package that is not there.
    """
    if not url:
        return None
    home = os.environ.get("ROS_HOME") or os.path.expandvars("$HOME/.ros")
    text = url.replace("${NAME}", camera_name).replace("${ROS_HOME}", home)
    scheme, separator, rest = text.partition("://")
    rest = unquote(rest)
    if separator and scheme == "file" and rest.startswith("/"):
        return Path(rest)
    package, _, path = rest.partition("/")
    if separator and scheme == "package" and package and path:
        try:
            return Path(get_package_share_directory(package)) / path
        except (PackageNotFoundError, ValueError):
            msg = (
                f"camera_driver.camera_info_url: found no package {package!r} for {url!r}, "
                "expected an installed one"
            )
            raise InputError(msg) from None
    msg = f"camera_driver.camera_info_url: found {url!r}, expected {EXPECTED}"
    raise InputError(msg)


class CameraCalibration:
    """What a node publishes as camera_info, and its service `set_camera_info`.

    The sensor description is not changed: what the processing computes with rests on more than
    the lens.  A calibration of another image size is refused, another difference is reported.

    problem: in what it differs from the sensor description; empty where it does not.
    """

    def __init__(self, node: Any, sensor: SensorDescription, url: str) -> None:
        """Raises CmpTactileError for a URL or file that cannot be used."""
        self._node = node
        self._sensor = sensor
        self._path = camera_info_path(url, sensor.ros_name)
        self._info = camera_info_of(sensor, Header())
        self.problem = ""
        if self._path is not None:
            self._load(self._path)
        self._service = node.create_service(SetCameraInfo, SERVICE, self._on_set)

    def message(self, header: Header) -> CameraInfo:
        """The camera_info of a frame."""
        return with_header(self._info, header)

    def _load(self, path: Path) -> None:
        if not path.exists():
            self.problem = (
                f"camera_info_url: found no file {path}, expected an existing file, or a call of "
                "set_camera_info, which makes it; until then the calibration of the sensor "
                "description is published"
            )
            return
        _, info = read_camera_info(path)
        self.problem = self._checked(str(path), info)
        self._info = camera_info_to_msg(info, Header())

    def _checked(self, origin: str, info: ViewCameraInfo) -> str:
        """In what it differs from the description; InputError for another size."""
        image = self._sensor.image
        for field in ("width", "height"):
            found, expected = getattr(info, field), getattr(image, field)
            if found != expected:
                msg = (
                    f"{origin}: image_{field}: found {found}, expected {expected} as in the "
                    f"description of {self._sensor.name}"
                )
                raise InputError(msg)
        return self._difference(origin, info)

    def _difference(self, origin: str, info: ViewCameraInfo) -> str:
        difference = calibration_mismatch(origin, info, self._sensor)
        return difference and (
            f"{difference} (the processing uses the sensor description; cmp_tactile calibrate "
            "makes a new one)"
        )

    def _on_set(
        self, request: SetCameraInfo.Request, response: SetCameraInfo.Response
    ) -> SetCameraInfo.Response:
        try:
            response.status_message = self._set(request.camera_info)
            response.success = True
        except CmpTactileError as error:
            response.status_message = str(error)
            self._node.get_logger().error(f"{SERVICE}: {error}")
        return response

    def _set(self, message: CameraInfo) -> str:
        if self._path is None:
            what = "a place to store the calibration"
            msg = f"camera_driver.camera_info_url: found nothing, expected {what}: {EXPECTED}"
            raise InputError(msg)
        info = camera_info_from_msg(message)
        problem = self._checked(SERVICE, info)
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_camera_info(self._path, self._sensor.ros_name, info)
        except OSError as error:
            msg = f"{self._path}: cannot be written: {error.strerror}"
            raise InputError(msg) from None
        self._info, self.problem = camera_info_to_msg(info, Header()), problem
        return f"stored in {self._path}" + (f"; {problem}" if problem else "")
