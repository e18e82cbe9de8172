"""Publish `surface` for force and slip, from markers that another node publishes as a point cloud.

The cloud is an organised sensor_msgs/PointCloud2: each row of points is a row of markers. It has x,
y and, if depth is measured, z, in m. x grows with the column, y with the row, z points out of the
gel. A missing marker is NaN. The first cloud shows the gel at rest.

    python3 docs/examples/other_sensor.py my_sensor.yaml /my_tracker/points
    ros2 run cmp_tactile_processing force_reconstructor --ros-args -r __ns:=/my_sensor
        -p sensor_description:=my_sensor.yaml
"""

from __future__ import annotations

import sys

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2, PointField

from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.measured import Surface
from cmp_tactile_processing.ros.messages.conversions import header_at, surface_to_msg
from cmp_tactile_processing.ros.messages.making import gel_frame
from cmp_tactile_processing.sensor.description import load_sensor

NUMBERS = {PointField.FLOAT32: "f4", PointField.FLOAT64: "f8"}


def points_of(cloud: PointCloud2) -> NDArray[np.float64]:
    """Points (height, width, 3) m; NaN for coordinates that the cloud does not have."""
    end = ">" if cloud.is_bigendian else "<"
    fields = {field.name: field for field in cloud.fields if field.name in ("x", "y", "z")}
    layout = np.dtype(
        {
            "names": list(fields),
            "formats": [end + NUMBERS[field.datatype] for field in fields.values()],
            "offsets": [field.offset for field in fields.values()],
            "itemsize": cloud.point_step,  # points and rows may have padding
        }
    )
    rows = np.frombuffer(cloud.data, np.uint8).reshape(cloud.height, cloud.row_step)
    rows = np.ascontiguousarray(rows[:, : cloud.width * cloud.point_step])
    points = np.full((cloud.height, cloud.width, 3), np.nan)
    for axis, name in enumerate("xyz"):
        if name in fields:
            points[..., axis] = rows.view(layout)[name]
    return points


class OtherSensor(Node):
    """Publishes `surface` in the namespace of the sensor."""

    def __init__(self, sensor: str, topic: str) -> None:
        description = load_sensor(sensor)
        super().__init__("other_sensor", namespace=description.ros_name)
        self._shape, self._frame = description.pattern.shape, gel_frame(description)
        self._rest: NDArray[np.float64] | None = None
        self._publisher = self.create_publisher(SurfaceMsg, "surface", 10)
        self.create_subscription(PointCloud2, topic, self._on_cloud, 10)

    def _on_cloud(self, cloud: PointCloud2) -> None:
        points = points_of(cloud)
        if points.shape[:2] != self._shape.corners:
            self.get_logger().warning(
                f"found {points.shape[:2]} points, expected {self._shape.corners}",
                throttle_duration_sec=5.0,
            )
            return
        if self._rest is None:
            self._rest = points
        surface = Surface.from_positions(self._shape, self._rest, points)
        self._publisher.publish(surface_to_msg(surface, header_at(cloud.header.stamp, self._frame)))


def main(sensor: str, topic: str) -> None:
    """Convert until Ctrl-C."""
    rclpy.init()
    node = OtherSensor(sensor, topic)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])
