"""Results of the stages as messages of ROS 2, without ROS.

Nodes make the same messages of ROS's own classes; these are made of the classes of `rosbags`, for
bags.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.geometry.rectification import ViewCameraInfo
from cmp_tactile_processing.measured.force_field import Contact, ForceField, SlipEstimate
from cmp_tactile_processing.measured.grid import Grid, GridShape
from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.ros.messages.definitions import (
    CONTACT,
    FORCE_FIELD,
    GRID,
    SURFACE,
    simulation_typestore,
)
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["CAMERA_INFO", "StageMessages"]

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
NS_PER_S = 10**9
# A symmetric (3, 3) travels as its six entries xx, xy, xz, yy, yz, zz.
UPPER_TRIANGLE = np.triu_indices(3)
SLIP_FIGURES = ("slip_ratio", "traction_ratio", "friction_coefficient", "friction_std")


class StageMessages:
    """Makes the messages of one sensor.

    Raises MessageDefinitionError where the suite's message definitions are not installed.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self._name = sensor.ros_name
        self._store = simulation_typestore()

    def cdr(self, message: Any, kind: str) -> memoryview:
        """A message as the bytes that ROS 2 sends and records."""
        return self._store.serialize_cdr(message, kind)

    def new(self, kind: str, **values: Any) -> Any:
        """A message of a type."""
        return self._store.types[kind](**values)

    def frame_id(self, frame: str) -> str:
        """A frame of the sensor, as "gel_frame", with the sensor's name before it."""
        return f"{self._name}_{frame}"

    def header(self, stamp_ns: int, frame: str) -> Any:
        """std_msgs/Header in a frame of the sensor."""
        stamp = self.time(stamp_ns)
        return self.new("std_msgs/msg/Header", stamp=stamp, frame_id=self.frame_id(frame))

    def time(self, stamp_ns: int) -> Any:
        """builtin_interfaces/Time."""
        seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
        return self.new("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)

    def vector(self, xyz: NDArray[np.float64]) -> Any:
        """geometry_msgs/Vector3."""
        x, y, z = xyz.tolist()
        return self.new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def point(self, xyz: NDArray[np.float64]) -> Any:
        """geometry_msgs/Point."""
        x, y, z = xyz.tolist()
        return self.new("geometry_msgs/msg/Point", x=x, y=y, z=z)

    def quaternion(self, rotation: NDArray[np.float64]) -> Any:
        """geometry_msgs/Quaternion of a (3, 3) rotation."""
        x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
        return self.new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def wrench(self, wrench: NDArray[np.float64]) -> Any:
        """geometry_msgs/Wrench of (6,) N and N m."""
        force, torque = self.vector(wrench[:3]), self.vector(wrench[3:])
        return self.new("geometry_msgs/msg/Wrench", force=force, torque=torque)

    def camera_info(self, info: ViewCameraInfo, header: Any) -> Any:
        """sensor_msgs/CameraInfo."""
        no_roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        return self.new(
            CAMERA_INFO,
            header=header,
            height=info.height,
            width=info.width,
            distortion_model=info.model,
            d=info.D,
            k=info.K.ravel(),
            r=info.R.ravel(),
            p=info.P.ravel(),
            binning_x=0,
            binning_y=0,
            roi=self.new("sensor_msgs/msg/RegionOfInterest", **no_roi),
        )

    def grid(self, grid: Grid, header: Any) -> Any:
        """cmp_tactile_msgs/Grid."""
        return self.new(
            GRID,
            header=header,
            **_shape(grid.shape),
            corner_px=_floats(grid.corners),
            corner_status=_bytes(grid.corner_status),
            row_line_px=_floats(grid.row_lines),
            row_line_status=_bytes(grid.row_line_status),
            col_line_px=_floats(grid.col_lines),
            col_line_status=_bytes(grid.col_line_status),
            corner_std_px=_known_floats(grid.corner_std),
            row_line_std_px=_known_floats(grid.row_line_std),
            col_line_std_px=_known_floats(grid.col_line_std),
            found_fraction=grid.found_fraction,
            residual_px=float(grid.residual_px),
            confidence=float(grid.confidence),
            followed=grid.followed,
            fault=grid.fault.value,
            reason=grid.reason,
        )

    def surface(self, surface: Surface, header: Any) -> Any:
        """cmp_tactile_msgs/Surface."""
        return self.new(
            SURFACE,
            header=header,
            **_shape(surface.shape),
            reference=_floats(surface.reference),
            position=_floats(surface.position),
            displacement=_floats(surface.displacement),
            status=_bytes(surface.status),
            fault=_bytes(surface.fault),
            covariance=_floats(surface.covariance[..., UPPER_TRIANGLE[0], UPPER_TRIANGLE[1]]),
            ray_gap=_floats(surface.ray_gap),
            row_position=_floats(surface.row_position),
            row_status=_bytes(surface.row_status),
            row_std=_floats(surface.row_std),
            col_position=_floats(surface.col_position),
            col_status=_bytes(surface.col_status),
            col_std=_floats(surface.col_std),
            reference_stamp=self.time(surface.reference_stamp_ns),
            reference_id=surface.reference_id,
        )

    def force_field(self, field: ForceField, header: Any) -> Any:
        """cmp_tactile_msgs/ForceField."""
        return self.new(
            FORCE_FIELD,
            header=header,
            rows=field.rows,
            cols=field.cols,
            position=_floats(field.position),
            force=_floats(field.force),
            force_std=_known_floats(field.force_std),
            contact=_bytes(field.contact),
            wrench=self.wrench(field.wrench),
            wrench_covariance=field.wrench_covariance.ravel(),
            reference_point=self.point(field.reference_point),
            contact_area=float(field.contact_area),
            centre_of_pressure=self.point(field.centre_of_pressure),
            contacts=[self._contact(contact) for contact in field.contacts],
            flags=int(field.flags),
            **(_slip(field.slip) | {"slip_state": int(field.slip_state)}),
            valid_fraction=float(field.valid_fraction),
            regularization=float(field.regularization),
            young=float(field.young),
            poisson=float(field.poisson),
            noise_scale=float(field.noise_scale),
            corrected=bool(field.corrected),
            relaxed=bool(field.relaxed),
        )

    def _contact(self, contact: Contact) -> Any:
        return self.new(
            CONTACT,
            nodes=np.asarray(contact.nodes, np.uint16),
            wrench=self.wrench(contact.wrench),
            wrench_covariance=contact.covariance.ravel(),
            area=float(contact.area),
            centre_of_pressure=self.point(contact.centre_of_pressure),
            outline=_floats(contact.outline),
            at_border=bool(contact.at_border),
            **_slip(contact.slip),
        )


def _slip(slip: SlipEstimate) -> dict[str, float]:
    figures = {name: float(getattr(slip, name)) for name in SLIP_FIGURES}
    return {"slip_state": int(slip.state), **figures}


def _shape(shape: GridShape) -> dict[str, int]:
    return {
        "rows": shape.rows,
        "cols": shape.cols,
        "points_per_segment": shape.points_per_segment,
    }


def _floats(values: NDArray[Any]) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, np.float32).ravel()


def _known_floats(values: NDArray[Any] | None) -> NDArray[np.float32]:
    return np.zeros(0, np.float32) if values is None else _floats(values)


def _bytes(values: NDArray[Any]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(values, np.uint8).ravel()
