"""A simulated frame in a bag, without ROS: its messages, and what is true of it, read back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_driver.bags.storage import StoredMessage, open_storage
from cmp_tactile_driver.errors import BagError
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.measured import ForceField, Surface
from cmp_tactile_processing.ros.messages import making, reading
from cmp_tactile_processing.ros.messages.definitions import bag_messages, simulation_typestore
from cmp_tactile_processing.ros.messages.making import camera_frame, gel_frame, view_frame
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.scenes.simulation import SimulatedFrame

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
TRUE_TOPICS = ("truth/surface", "truth/force_field")
SLIP_FIGURES = ("slip_ratio", "traction_ratio", "friction_coefficient")
FrameBytes = dict[str, bytes]
"""CDR bytes of a frame's messages by topic, below the sensor's namespace."""
# Camera noise leaves PNG's dictionary nothing to find: entropy coding alone is both the smallest
# (21.9 MB against 23.8 MB for 60 frames) and seven times as fast.  OpenCV uses the strategy only
# where a compression level is given too.
PNG_OPTIONS = (
    cv2.IMWRITE_PNG_COMPRESSION,
    6,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
)


def encode_png(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The bytes (n,) of an image as lossless PNG."""
    return np.asarray(cv2.imencode(".png", image, PNG_OPTIONS)[1], np.uint8).ravel()


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


class FrameMessages:
    """Makes the messages of one sensor's frames.

    Raises MessageDefinitionError where the suite's message definitions are not installed.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self._sensor, self._make = sensor, bag_messages()
        self._topics = recorded_topics(sensor)
        self._info = making.whole_frame_info(sensor)

    def serialised(self, frame: SimulatedFrame) -> Iterator[tuple[str, bytes]]:
        """Topic (below the namespace) and CDR bytes of all messages of a frame, in order."""
        make = self._make
        camera = make.header(frame.stamp_ns, camera_frame(self._sensor))
        gel = make.header(frame.stamp_ns, gel_frame(self._sensor))
        messages = {
            "camera_info": make.camera_info(self._info, camera),
            "image_raw/compressed": make.new(
                COMPRESSED_IMAGE,
                header=camera,
                format="mono8; png compressed ",
                data=encode_png(frame.image),
            ),
            "truth/surface": make.surface(frame.surface, gel),
            "truth/force_field": make.force_field(frame.force, gel),
            **{
                f"truth/{view}/grid": make.grid(
                    grid, make.header(frame.stamp_ns, view_frame(self._sensor, view))
                )
                for view, grid in frame.grids.items()
            },
            "truth/indenter_pose": self._pose(frame.pose, gel),
        }
        for topic, kind in self._topics.types.items():
            yield topic, bytes(simulation_typestore().serialize_cdr(messages[topic], kind))

    def _pose(self, pose: Pose, header: Any) -> Any:
        place = self._make.new(
            "geometry_msgs/msg/Pose",
            position=self._make.point(pose.position),
            orientation=self._make.quaternion(Rotation.from_matrix(pose.rotation)),
        )
        return self._make.new(POSE_STAMPED, header=header, pose=place)


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

    Raises BagError for a bag that cannot be read, DescriptionError for its sensor.yaml, and
    OutputError where it holds no truth.
    """
    sensor = SensorDescription.load(bag / "sensor.yaml")
    views = build_views(sensor)
    topics = [*TRUE_TOPICS, *(f"truth/{view}/grid" for view in views)]
    rows = [
        _row(stamp_ns, frame, sensor, views)
        for stamp_ns, frame in recorded_frames(bag, sensor, topics)
    ]
    if not rows:
        msg = f"{bag}: found no truth, expected the topics {', '.join(topics)}"
        raise OutputError(msg)
    return RecordedTruth(**{name: np.array([row[name] for row in rows]) for name in rows[0]})


def _row(
    stamp_ns: int, frame: FrameBytes, sensor: SensorDescription, views: Mapping[str, ViewGeometry]
) -> dict[str, Any]:
    """The values of RecordedTruth for a frame."""
    shape, force = sensor.pattern.shape, true_force(frame, sensor)
    pixels = dict.fromkeys(("left", "right"), np.full((*shape.corners, 2), np.nan))
    for name, view in views.items():
        message = deserialised(frame, f"truth/{name}/grid", sensor)
        pixels[name] = reading.grid_from_msg(message, shape, view.placement).corners_frame
    return {
        "stamp_ns": stamp_ns,
        "corners_left_px": pixels["left"],
        "corners_right_px": pixels["right"],
        "corners_m": true_surface(frame, sensor).position,
        "wrench": force.wrench,
        "contact_area": force.contact_area,
        "slip_state": np.uint8(force.slip_state),
        **{name: getattr(force.slip, name) for name in SLIP_FIGURES},
    }


def read_true_force(bag: Path, stamp_ns: int) -> ForceField:
    """The true force field of the frame with that stamp; errors as `read_truth`."""
    sensor = SensorDescription.load(bag / "sensor.yaml")
    for stamp, frame in recorded_frames(bag, sensor, ("truth/force_field",)):
        if stamp == stamp_ns:
            return true_force(frame, sensor)
    msg = f"{bag}: found no truth/force_field with the stamp {stamp_ns} ns"
    raise OutputError(msg)


def true_force(frame: FrameBytes, sensor: SensorDescription) -> ForceField:
    """The force field of a recorded frame."""
    return reading.force_field_from_msg(deserialised(frame, "truth/force_field", sensor))


def true_surface(frame: FrameBytes, sensor: SensorDescription) -> Surface:
    """The surface of a recorded frame."""
    message = deserialised(frame, "truth/surface", sensor)
    return reading.surface_from_msg(message, sensor.pattern.shape)


def recorded_frames(
    bag: Path, sensor: SensorDescription, topics: Sequence[str] = ()
) -> Iterator[tuple[int, FrameBytes]]:
    """Stamp in ns, and message bytes by topic, of the whole frames of a bag, in order.

    topics: below the sensor's namespace; without them all that a simulation records.
    Ends at the first frame that lacks a message, as the last one of an interrupted run may.
    Raises BagError for a bag that cannot be read.
    """
    prefix, types = recorded_topics(sensor)
    wanted = [prefix + topic for topic in topics or types]
    storage = open_storage(bag)
    if not storage.topics.keys() >= set(wanted):
        return
    for stamp_ns, messages in groupby(storage.messages(wanted), key=_time_ns):
        frame = {item.topic.removeprefix(prefix): item.data for item in messages}
        if len(frame) < len(wanted):
            return
        yield stamp_ns, frame


def count_frames(bag: Path, sensor: SensorDescription) -> int:
    """How many whole frames a bag has; 0 where there is none yet."""
    try:
        return sum(1 for _ in recorded_frames(bag, sensor))
    except BagError:
        return 0


def deserialised(frame: FrameBytes, topic: str, sensor: SensorDescription) -> Any:
    """One message of a frame."""
    return simulation_typestore().deserialize_cdr(
        frame[topic], recorded_topics(sensor).types[topic]
    )


def _time_ns(message: StoredMessage) -> int:
    return message.time_ns
