"""Node: cuts the camera frame into the views, un-mirrored."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from tf2_ros import StaticTransformBroadcaster

from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.geometry.split import check_image, split_frame
from cmp_tactile_processing.image.compressed import decode_compressed
from cmp_tactile_processing.ros.base_nodes import IMAGE_DEPTH, StageNode
from cmp_tactile_processing.ros.frames import (
    Mounting,
    rectified_frame,
    static_transforms,
    view_frame,
)
from cmp_tactile_processing.ros.messages.camera_info import camera_info_to_msg
from cmp_tactile_processing.ros.messages.conversions import header_at
from cmp_tactile_processing.ros.messages.images import image_from_msg, image_to_msg
from cmp_tactile_processing.ros.parameters import ImageInputParameters, declare_parameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.sensor.parameters import parameter

__all__ = ["ViewSplitter"]


@dataclass(frozen=True)
class ViewSplitterParameters(ImageInputParameters):
    """On what the frames come."""

    input_transport: str = parameter(
        "raw",
        "what the frames come on: raw (image_raw) or compressed (image_raw/compressed)",
        choices=("raw", "compressed"),
    )


class ViewSplitter(StageNode):
    """Cuts `image_raw` into `left/` and `right/`, un-mirrors them, and says where they look from.

    With `input_transport` compressed it takes `image_raw/compressed` (PNG or JPEG) in its place, as
    a bag may have it that `ros2 bag play` plays.  Frames in colour, bgr8 or rgb8, stay so; those in
    YUYV become grey unless `tracking.red`, `green` and `blue` of the sensor description ask for
    other than their luminance.
    `<view>/image_rect` is rectified only while somebody subscribes.  It and `<view>/camera_info`
    are as image_pipeline has them: with the stamp of the camera frame, and in the left optical
    frame for both views.  `<view>/image_raw` is in the view's own optical frame.  The static
    transforms from the gel frame to all optical frames are sent once, latched, and with
    `parent_frame` that from the frame the sensor is mounted on to the gel frame.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("view_splitter", **node_kwargs)

    def _set_up(self) -> None:
        self._rectification = Rectification(self.sensor)
        self._views = [_ViewOutput(self, view, self._rectification) for view in self._geometry()]
        self._send_transforms(Mounting.declare(self, self.sensor))
        options = declare_parameters(self, ViewSplitterParameters())
        reliable = options.reliable_input
        if options.input_transport == "raw":
            self.add_input(Image, "image_raw", self._on_image, reliable=reliable)
        else:
            topic = "image_raw/compressed"
            self.add_input(CompressedImage, topic, self._on_compressed, reliable=reliable)

    def _send_transforms(self, mounting: Mounting) -> None:
        if mounting.is_elsewhere and not mounting.parent_frame:
            self.get_logger().warning(
                "mount_position and mount_orientation have no effect without parent_frame"
            )
        self._broadcaster = StaticTransformBroadcaster(self)
        now = self.get_clock().now().to_msg()
        transforms = static_transforms(self.sensor, self._rectification)
        transforms += mounting.transforms(self.sensor)
        for transform in transforms:
            transform.header.stamp = now
        # All in one message: a latched publisher keeps its last one alone.
        self._broadcaster.sendTransform(transforms)

    def _geometry(self) -> list[ViewGeometry]:
        return list(build_views(self.sensor).values())

    def _on_image(self, msg: Image) -> None:
        self._split(image_from_msg(msg, self.sensor.tracking.grey_weights), msg.header)

    def _on_compressed(self, msg: CompressedImage) -> None:
        self._split(decode_compressed(msg.format, np.frombuffer(msg.data, np.uint8)), msg.header)

    def _split(self, frame: NDArray[np.uint8], header: Header) -> None:
        check_image(frame, self.sensor.image.width, self.sensor.image.height, "image")
        images = [split_frame(frame, view.placement) for view in self._views]
        # Both trackers begin before anything is made that only few wait for.
        for view, image in zip(self._views, images, strict=True):
            view.publish(image, header)
        self.frame_out(header)
        for view, image in zip(self._views, images, strict=True):
            view.publish_more(image, header)


class _ViewOutput:
    """The three topics of one view."""

    def __init__(self, node: StageNode, view: ViewGeometry, rectification: Rectification) -> None:
        self.placement = view.placement
        self._name = view.name
        self._frame = view_frame(node.sensor, view.name)
        self._rectified_frame = rectified_frame(node.sensor, view.name)
        self._rectification = rectification
        self._info = rectification.info(view.name)
        self._raw = node.add_publisher(Image, f"{view.name}/image_raw", IMAGE_DEPTH)
        self._rect = node.add_publisher(Image, f"{view.name}/image_rect", IMAGE_DEPTH)
        self._camera_info: Publisher[CameraInfo] = node.add_publisher(
            CameraInfo, f"{view.name}/camera_info", IMAGE_DEPTH, latched=True
        )

    def publish(self, image: Any, camera_header: Header) -> None:
        header = header_at(camera_header.stamp, self._frame)
        self._raw.publish(image_to_msg(image, _encoding(image), header))

    def publish_more(self, image: Any, camera_header: Header) -> None:
        """Calibration, and the rectified image where somebody subscribes to it."""
        header = header_at(camera_header.stamp, self._rectified_frame)
        self._camera_info.publish(camera_info_to_msg(self._info, header))
        if self._rect.get_subscription_count():
            rectified = self._rectification.rectify(self._name, image)
            self._rect.publish(image_to_msg(rectified, _encoding(image), header))


def _encoding(image: Any) -> str:
    return "mono8" if image.ndim == 2 else "bgr8"


def main() -> int:
    """Entry point of `ros2 run cmp_tactile_processing view_splitter`."""
    return run_node(ViewSplitter)


if __name__ == "__main__":
    sys.exit(main())
