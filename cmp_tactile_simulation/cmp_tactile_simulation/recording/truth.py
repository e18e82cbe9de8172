"""A simulated recording, written and read: a ROS 2 bag (MCAP) of frames with their truth."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_driver.bags.files import StoredMessage
from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_driver.bags.writer import BagWriter
from cmp_tactile_processing.errors import OutputError
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.measured import ForceField, Grid, Surface
from cmp_tactile_processing.ros.messages import making, reading
from cmp_tactile_processing.ros.messages.definitions import (
    bag_messages,
    simulation_definition,
    simulation_typestore,
)
from cmp_tactile_processing.ros.messages.making import camera_frame, gel_frame, view_frame
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.simulator import SimulatedFrame

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
TRUE_TOPICS = ("truth/surface", "truth/force_field")
SLIP_FIGURES = ("slip_ratio", "traction_ratio", "friction_coefficient")
# Camera noise leaves PNG's dictionary nothing to find: entropy coding alone is both the smallest
# (21.9 MB against 23.8 MB for 60 frames) and seven times as fast.  OpenCV uses the strategy only
# where a compression level is given too.
PNG_OPTIONS = (
    cv2.IMWRITE_PNG_COMPRESSION,
    6,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
)


class FrameTopics(NamedTuple):
    """Topics of a recording by their names below the sensor's namespace, with message types."""

    prefix: str
    types: dict[str, str]


def recorded_topics(sensor: SensorDescription) -> FrameTopics:
    """The topics of a sensor's simulated recording, in the order of their messages."""
    types = {
        "camera_info": making.CAMERA_INFO,
        "image_raw/compressed": COMPRESSED_IMAGE,
        "truth/surface": making.SURFACE,
        "truth/force_field": making.FORCE_FIELD,
        **{f"truth/{view}/grid": making.GRID for view in sensor.views},
        "truth/indenter_pose": POSE_STAMPED,
    }
    return FrameTopics(f"/{sensor.ros_name}/", types)


class FrameWriter:
    """Writes the frames of a sensor into a bag that is open; all messages of one bear its stamp.

    Raises CmpTactileError where the suite's message definitions are not installed.
    """

    def __init__(self, writer: BagWriter, sensor: SensorDescription) -> None:
        self._writer, self._sensor = writer, sensor
        self._make = bag_messages()
        self._info = making.whole_frame_info(sensor)
        self._prefix, self._types = recorded_topics(sensor)
        for name, kind in self._types.items():
            add_simulated_topic(writer, self._prefix + name, kind)

    def append(self, frame: SimulatedFrame) -> None:
        """Write the next frame."""
        messages = self._messages(frame)
        for name, kind in self._types.items():
            write_simulated(self._writer, self._prefix + name, kind, frame.stamp_ns, messages[name])

    def _messages(self, frame: SimulatedFrame) -> dict[str, Any]:
        """The messages of a frame by topic, below the namespace."""
        make = self._make
        camera = make.header(frame.stamp_ns, camera_frame(self._sensor))
        gel = make.header(frame.stamp_ns, gel_frame(self._sensor))
        image = np.asarray(cv2.imencode(".png", frame.image, PNG_OPTIONS)[1], np.uint8).ravel()
        return {
            "camera_info": make.camera_info(self._info, camera),
            "image_raw/compressed": make.new(
                COMPRESSED_IMAGE, header=camera, format="mono8; png compressed ", data=image
            ),
            "truth/surface": make.surface(frame.surface, gel),
            "truth/force_field": make.force_field(frame.force, gel),
            **{
                f"truth/{view}/grid": make.grid(
                    grid, make.header(frame.stamp_ns, view_frame(self._sensor, view))
                )
                for view, grid in frame.grids.items()
            },
            "truth/indenter_pose": pose_message(make, frame.pose, gel),
        }


def add_simulated_topic(writer: BagWriter, topic: str, kind: str) -> None:
    """Add a topic of a message type that the suite or its simulator defines."""
    writer.add_topic(topic, kind, definition=simulation_definition(kind))


def write_simulated(writer: BagWriter, topic: str, kind: str, stamp_ns: int, message: Any) -> None:
    """Write a message on such a topic."""
    writer.write(topic, stamp_ns, bytes(simulation_typestore().serialize_cdr(message, kind)))


def pose_message(make: making.MessageMaker, pose: Pose, header: Any) -> Any:
    """A PoseStamped."""
    place = make.new(
        "geometry_msgs/msg/Pose",
        position=make.point(pose.position),
        orientation=make.quaternion(Rotation.from_matrix(pose.rotation)),
    )
    return make.new(POSE_STAMPED, header=header, pose=place)


def transform_message(make: making.MessageMaker, child: str, pose: Pose, header: Any) -> Any:
    """A TransformStamped: the pose of a child in the frame of the header."""
    return make.transform(header, child, pose.position, Rotation.from_matrix(pose.rotation))


class RecordingWriter:
    """Writes the bag of one sensor into the folder of its scene.

    The same frames give the same bytes.  A frame is a chunk of the file: should the process be
    killed, only the next one is lost.
    Raises CmpTactileError where the suite's message definitions are not installed.
    """

    def __init__(self, bag: Path, sensor: SensorDescription) -> None:
        self._bag = bag
        # A bag is a new folder, and this one has the scene already: its file goes on from here.
        self._beside = bag / ".partial"
        shutil.rmtree(self._beside, ignore_errors=True)
        self._writer = BagWriter(self._beside / bag.name)
        self._writer.path = self._writer.path.replace(bag / self._writer.path.name)
        self._frames = FrameWriter(self._writer, sensor)

    def append(self, frame: SimulatedFrame) -> None:
        """Write the next frame."""
        self._frames.append(frame)
        self._writer.flush()

    def close(self) -> None:
        """Write index and metadata.yaml."""
        self._writer.close()
        metadata = self._writer.folder / "metadata.yaml"
        # There is none where the disk is full.
        if metadata.exists():
            metadata.replace(self._bag / metadata.name)
        shutil.rmtree(self._beside)


class RecordedFrame:
    """A frame of a recording; each of its messages is decoded when it is asked for."""

    def __init__(
        self,
        stamp_ns: int,
        messages: Mapping[str, StoredMessage],
        sensor: SensorDescription,
        views: Mapping[str, ViewGeometry],
    ) -> None:
        """messages: by topic, below the sensor's namespace."""
        self.stamp_ns = stamp_ns
        self._messages, self._sensor, self._views = messages, sensor, views

    @property
    def png(self) -> bytes:
        """The camera frame as the bytes of a PNG file."""
        return bytes(self._message("image_raw/compressed").data)

    @property
    def image(self) -> NDArray[np.uint8]:
        """The camera frame, (H, W)."""
        return reading.image_from_msg(self._message("image_raw/compressed"))

    @cached_property
    def grids(self) -> dict[str, Grid]:
        """The true markers by view, px of the view."""
        shape = self._sensor.pattern.shape
        return {
            name: reading.grid_from_msg(self._message(f"truth/{name}/grid"), shape, view.placement)
            for name, view in self._views.items()
        }

    @cached_property
    def surface(self) -> Surface:
        """The true markers in 3-D, gel frame, m."""
        message = self._message("truth/surface")
        return reading.surface_from_msg(message, self._sensor.pattern.shape)

    @cached_property
    def force(self) -> ForceField:
        """The true force field, gel frame."""
        return reading.force_field_from_msg(self._message("truth/force_field"))

    @cached_property
    def pose(self) -> Pose:
        """Of the indenter, gel frame."""
        pose = self._message("truth/indenter_pose").pose
        p, q = pose.position, pose.orientation
        rotation = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        return Pose(np.array([p.x, p.y, p.z]), rotation)

    def _message(self, topic: str) -> Any:
        return self._messages[topic].decode()


@dataclass(frozen=True)
class RecordedTruth:
    """What is true of n frames; NaN where a point is not seen, and for a view that is not there.

    stamp_ns (n,).  corners_left_px, corners_right_px (n, rows, cols, 2): px of the whole camera
    frame.  corners_m (n, rows, cols, 3) m, gel frame.  wrench (n, 6) N and N m, on the gel.
    contact_area (n,) m^2.  slip_state (n,): codes of cmp_tactile_processing's SlipState.
    slip_ratio, traction_ratio, friction_coefficient (n,): as in its SlipEstimate.
    """

    stamp_ns: NDArray[np.int64]
    corners_left_px: NDArray[np.float64]
    corners_right_px: NDArray[np.float64]
    corners_m: NDArray[np.float64]
    wrench: NDArray[np.float64]
    contact_area: NDArray[np.float64]
    slip_state: NDArray[np.uint8]
    slip_ratio: NDArray[np.float64]
    traction_ratio: NDArray[np.float64]
    friction_coefficient: NDArray[np.float64]


def read_truth(bag: Path) -> RecordedTruth:
    """The truth of all frames of a bag that `cmp_tactile simulate` made; sensor.yaml is beside it.

    Raises FrameSourceError for a bag that cannot be read, InputError for its sensor.yaml, and
    OutputError where it holds no truth.
    """
    sensor = SensorDescription.load(bag / "sensor.yaml")
    topics = [*TRUE_TOPICS, *(f"truth/{view}/grid" for view in sensor.views)]
    rows = [_row(frame, sensor) for frame in recorded_frames(bag, sensor, topics)]
    if not rows:
        msg = f"{bag}: found no truth, expected the topics {', '.join(topics)}"
        raise OutputError(msg)
    return RecordedTruth(**{name: np.array([row[name] for row in rows]) for name in rows[0]})


def _row(frame: RecordedFrame, sensor: SensorDescription) -> dict[str, Any]:
    """The values of RecordedTruth for a frame."""
    unseen = np.full((*sensor.pattern.shape.corners, 2), np.nan)
    pixels = {name: grid.corners_frame for name, grid in frame.grids.items()}
    return {
        "stamp_ns": frame.stamp_ns,
        "corners_left_px": pixels.get("left", unseen),
        "corners_right_px": pixels.get("right", unseen),
        "corners_m": frame.surface.position,
        "wrench": frame.force.wrench,
        "contact_area": frame.force.contact_area,
        "slip_state": np.uint8(frame.force.slip_state),
        **{name: getattr(frame.force.slip, name) for name in SLIP_FIGURES},
    }


def recorded_frames(
    bag: Path, sensor: SensorDescription, topics: Sequence[str] = ()
) -> Iterator[RecordedFrame]:
    """The whole frames of a bag, in order.

    topics: those that are read, below the sensor's namespace; without them all.
    Ends at the first frame that lacks a message, as the last one of an interrupted run may.
    Raises FrameSourceError for a bag that cannot be read.
    """
    prefix, types = recorded_topics(sensor)
    wanted = [prefix + topic for topic in topics or types]
    storage, views = BagStorage(bag), build_views(sensor)
    if not storage.topics.keys() >= set(wanted):
        return
    for stamp_ns, messages in groupby(storage.messages(wanted), key=_time_ns):
        frame = {item.topic.removeprefix(prefix): item for item in messages}
        if len(frame) < len(wanted):
            return
        yield RecordedFrame(stamp_ns, frame, sensor, views)


def _time_ns(message: StoredMessage) -> int:
    return message.time_ns
