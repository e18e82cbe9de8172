"""The camera_info of a camera: of its sensor description, of a file, or set by a service."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo
from std_msgs.msg import Header

from cmp_tactile_driver.bags.calibration_check import calibration_mismatch
from cmp_tactile_driver.bags.recorded_message import RecordedCalibration
from cmp_tactile_driver.nodes.camera_info_location import camera_info_path
from cmp_tactile_driver.nodes.camera_messages import camera_info_of
from cmp_tactile_processing.errors import CmpTactileError, DescriptionError
from cmp_tactile_processing.geometry.camera_info_file import read_camera_info, write_camera_info
from cmp_tactile_processing.geometry.rectification import ROS_MODEL, ViewCameraInfo
from cmp_tactile_processing.ros.messages.camera_info import camera_info_to_msg
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["CameraCalibration"]

SERVICE = "set_camera_info"


class CameraCalibration:
    """What a node publishes as camera_info, and its service `set_camera_info`.

    The sensor description is not changed: what the processing computes with rests on more than
    the lens.  A calibration of another image size is refused, another difference is told.
    """

    def __init__(self, node: Any, sensor: SensorDescription, url: str) -> None:
        """Raises CmpTactileError for a URL or file that cannot be used."""
        self._node = node
        self._sensor = sensor
        self._path = camera_info_path(url, sensor.ros_name)
        self._given: ViewCameraInfo | None = None
        self._problem = ""
        if self._path is not None:
            self._load(self._path)
        self._service = node.create_service(SetCameraInfo, SERVICE, self._on_set)

    @property
    def problem(self) -> str:
        """In what it differs from the sensor description; empty where it does not."""
        return self._problem

    def message(self, header: Header) -> CameraInfo:
        """The camera_info of a frame."""
        given = self._given
        if given is None:
            return camera_info_of(self._sensor, header)
        return camera_info_to_msg(given, header)

    def _load(self, path: Path) -> None:
        if not path.exists():
            self._problem = (
                f"camera_info_url: found no file {path}, expected one or that set_camera_info "
                "makes it; the sensor description's calibration is published"
            )
            return
        _, info = read_camera_info(path)
        self._problem = self._checked(str(path), info)
        self._given = info

    def _checked(self, origin: str, info: ViewCameraInfo) -> str:
        """In what it differs from the description; DescriptionError for another size."""
        image = self._sensor.image
        for field in ("width", "height"):
            found, expected = getattr(info, field), getattr(image, field)
            if found != expected:
                msg = (
                    f"{origin}: image_{field}: found {found}, "
                    f"expected {expected} as {self._sensor.name} has it"
                )
                raise DescriptionError(msg)
        return self._difference(origin, info)

    def _difference(self, origin: str, info: ViewCameraInfo) -> str:
        camera = self._sensor.camera
        if camera is None:
            return ""
        difference = ""
        if info.model != ROS_MODEL[camera.model]:
            expected = ROS_MODEL[camera.model]
            difference = f"{origin}: distortion_model: found {info.model}, expected {expected}"
        found = RecordedCalibration(origin, info.width, info.height, info.K, np.asarray(info.D))
        difference = difference or calibration_mismatch(found, self._sensor)
        return difference and (
            f"{difference} (the processing goes on with the sensor description; "
            "cmp_tactile calibrate makes a new one)"
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
            msg = (
                "camera_driver.camera_info_url: found nothing, expected where to keep the "
                "calibration: file://PATH or package://PACKAGE/PATH"
            )
            raise DescriptionError(msg)
        info = ViewCameraInfo(
            width=message.width,
            height=message.height,
            model=message.distortion_model,
            D=np.array(message.d, np.float64),
            K=np.array(message.k, np.float64).reshape(3, 3),
            R=np.array(message.r, np.float64).reshape(3, 3),
            P=np.array(message.p, np.float64).reshape(3, 4),
        )
        problem = self._checked(SERVICE, info)
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_camera_info(self._path, self._sensor.ros_name, info)
        except OSError as error:
            msg = f"{self._path}: cannot be written: {error.strerror}"
            raise DescriptionError(msg) from None
        self._given, self._problem = info, problem
        return f"kept in {self._path}" + (f"; {problem}" if problem else "")
