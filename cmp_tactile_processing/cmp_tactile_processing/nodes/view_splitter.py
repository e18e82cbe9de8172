"""Node: cuts the camera frame into the views, un-mirrored."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from tf2_ros import StaticTransformBroadcaster

from cmp_tactile_processing.cache.threads import ViewThreads
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.geometry.split import check_image, split_frame
from cmp_tactile_processing.image.encodings import BitDepth
from cmp_tactile_processing.ros.base_nodes import IMAGE_DEPTH, StageNode
from cmp_tactile_processing.ros.messages import conversions, making
from cmp_tactile_processing.ros.messages.making import encoding_of
from cmp_tactile_processing.ros.parameters import ImageInputParameters, declare_parameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.ros.wiring import publish_side_by_side
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import Parameters, parameter

# No gripper is larger, and mm or degrees in place of m or rad are seldom less.
FARTHEST_M = 10.0
MOST_RAD = 2 * math.pi
ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Mounting(Parameters):
    """The gel frame's pose in the frame of a robot: the numbers of a URDF joint's origin."""

    parent_frame: str = parameter(
        "", "tf frame that the sensor is mounted on, parent of the gel frame; empty for none"
    )
    mount_position: tuple[float, float, float] = parameter(
        ORIGIN, "gel frame's origin in parent_frame", unit="m", within=(-FARTHEST_M, FARTHEST_M)
    )
    mount_orientation: tuple[float, float, float] = parameter(
        ORIGIN,
        "roll, pitch and yaw of the gel frame about parent_frame's fixed axes",
        unit="rad",
        within=(-MOST_RAD, MOST_RAD),
    )

    @classmethod
    def declare(cls, node: Node, sensor: SensorDescription) -> Mounting:
        """From the parameters of the node.  Raises InputError where they cannot be meant."""
        mounting = declare_parameters(node, cls())
        parent, own = mounting.parent_frame, making.sensor_frames(sensor)
        if parent.startswith("/") or parent in own or parent != "".join(parent.split()):
            msg = (
                f"{node.get_fully_qualified_name()}: parameter parent_frame: found {parent!r}, "
                "expected a name without blanks, not beginning with /, and none of "
                f"{', '.join(own)}"
            )
            raise InputError(msg)
        return mounting

    def transforms(self, sensor: SensorDescription) -> list[Any]:
        """The one from parent_frame to the gel frame, with stamp 0; none without a parent."""
        if not self.parent_frame:
            return []
        header = conversions.ROS_MESSAGES.header(0, self.parent_frame)
        rotation = Rotation.from_euler("xyz", self.mount_orientation)
        origin = np.array(self.mount_position)
        return [
            conversions.ROS_MESSAGES.transform(header, making.gel_frame(sensor), origin, rotation)
        ]


@dataclass(frozen=True)
class ViewSplitterParameters(ImageInputParameters):
    """On what the frames come."""

    input_transport: str = parameter(
        "raw",
        "transport of the frames: raw (image_raw) or compressed (image_raw/compressed)",
        choices=("raw", "compressed"),
    )
    frame_queue: str = parameter(
        "every",
        "frames to process if they come faster than wrenches: every (all, in a queue) or newest "
        "(older ones are passed over)",
        choices=("every", "newest"),
    )


class ViewSplitter(StageNode):
    """Cuts `image_raw` into `left/` and `right/`, un-mirrors them, publishes camera_info and tf.

    With `input_transport` compressed it reads `image_raw/compressed` (PNG or JPEG) instead.
    Colour frames, such as bgr8 or rgba8, keep their colours.  YUV and Bayer frames become grey,
    unless `tracking.red`, `green` and `blue` of the sensor description differ from luminance.
    16-bit pixels are scaled to 8 bits by the number of bits in use.
    With `frame_queue` newest, for a controller, only the newest frame waits while another one is
    processed: the latency does not grow when frames come too quickly.

    `<view>/image_raw` is in the view's own optical frame.  `<view>/image_rect` and
    `<view>/camera_info` are as image_pipeline expects them: they have the stamp of the camera frame
    and, for both views, the left optical frame.  `<view>/image_rect` is computed only while
    somebody subscribes.  `<view>/camera_info` is latched, and comes with each frame while somebody
    subscribes.

    The static transforms from the gel frame to all optical frames are sent once, latched.
    `parent_frame` adds the transform from that frame to the gel frame.
    """

    default_name = "view_splitter"

    def _set_up(self) -> None:
        self._rectification = Rectification(self.sensor)
        self._views = [_ViewOutput(self, view, self._rectification) for view in self._geometry()]
        self._threads = ViewThreads(len(self._views))
        self._send_transforms(Mounting.declare(self, self.sensor))
        options = declare_parameters(self, ViewSplitterParameters())
        is_compressed = options.input_transport == "compressed"
        topic = "image_raw/compressed" if is_compressed else "image_raw"
        self._depth = BitDepth(self.resolve_topic_name(topic), self.get_logger().info)
        self.add_input(
            CompressedImage if is_compressed else Image,
            topic,
            self._split,
            self._read,
            reliable=options.reliable_input,
            newest=options.frame_queue == "newest",
        )

    def _send_transforms(self, mounting: Mounting) -> None:
        self._broadcaster = StaticTransformBroadcaster(self)
        now = self.get_clock().now().to_msg()
        transforms = making.static_transforms(
            conversions.ROS_MESSAGES, self.sensor, self._rectification
        )
        transforms += mounting.transforms(self.sensor)
        for transform in transforms:
            transform.header.stamp = now
        # All in one message: a latched publisher keeps its last one alone.
        self._broadcaster.sendTransform(transforms)

    def _geometry(self) -> list[ViewGeometry]:
        return list(build_views(self.sensor).values())

    def _read(self, msg: Image | CompressedImage) -> NDArray[np.uint8]:
        return conversions.image_from_topic(msg, self.sensor.tracking.grey_weights, self._depth)

    def _split(self, frame: NDArray[np.uint8], header: Header) -> None:
        check_image(frame, *self.sensor.frame_size, "image")
        images = [split_frame(frame, view.placement) for view in self._views]
        publish_side_by_side(
            [view.image for view in self._views],
            images,
            [view.header(header) for view in self._views],
            self._threads,
        )
        self.frame_out(header)
        for view, image in zip(self._views, images, strict=True):
            view.publish_more(image, header)


class _ViewOutput:
    """The three topics of one view."""

    def __init__(self, node: StageNode, view: ViewGeometry, rectification: Rectification) -> None:
        self.placement = view.placement
        self._name = view.name
        self._frame = making.view_frame(node.sensor, view.name)
        self._rectified_frame = making.rectified_frame(node.sensor, view.name)
        self._rectification = rectification
        self.image = node.add_result(
            Image, f"{view.name}/image_raw", conversions.frame_to_msg, IMAGE_DEPTH
        )
        self._rect = node.add_publisher(Image, f"{view.name}/image_rect", IMAGE_DEPTH)
        self._info_publisher = node.add_publisher(
            CameraInfo, f"{view.name}/camera_info", IMAGE_DEPTH, latched=True
        )
        header = Header(frame_id=self._rectified_frame)
        self._info = conversions.camera_info_to_msg(rectification.info(view.name), header)
        self._info_publisher.publish(self._info)

    def header(self, camera_header: Header) -> Header:
        """Of the view's image."""
        return conversions.header_at(camera_header.stamp, self._frame)

    def publish_more(self, image: NDArray[np.uint8], camera_header: Header) -> None:
        """Calibration and rectified image, where somebody subscribes."""
        header = conversions.header_at(camera_header.stamp, self._rectified_frame)
        # With each image, for image_transport and image_pipeline match the two by their stamps.
        if self._info_publisher.get_subscription_count():
            self._info_publisher.publish(conversions.with_header(self._info, header))
        if self._rect.get_subscription_count():
            rectified = self._rectification.rectify(self._name, image)
            self._rect.publish(conversions.image_to_msg(rectified, encoding_of(image), header))


def main() -> int:
    """Entry point of `ros2 run cmp_tactile_processing view_splitter`."""
    return run_node(ViewSplitter)


if __name__ == "__main__":
    sys.exit(main())
