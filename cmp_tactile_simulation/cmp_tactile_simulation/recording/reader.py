"""Reads the frames of a simulated recording back, whole or interrupted, without ROS."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.bags.storage import StoredMessage, open_storage
from cmp_tactile_driver.sources.files import decode_compressed
from cmp_tactile_processing.ros.messages.definitions import simulation_typestore
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.recording.frame_messages import recorded_topics
from cmp_tactile_simulation.recording.frame_output import WrittenFrame

__all__ = ["FrameBytes", "deserialised", "recorded_frames", "written_frame"]

FrameBytes = dict[str, bytes]


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


def deserialised(frame: FrameBytes, topic: str, sensor: SensorDescription) -> Any:
    """One message of a frame."""
    return simulation_typestore().deserialize_cdr(
        frame[topic], recorded_topics(sensor).types[topic]
    )


def written_frame(frame: FrameBytes, sensor: SensorDescription) -> WrittenFrame:
    """What the video shows of a recorded frame."""
    image = deserialised(frame, "image_raw/compressed", sensor)
    surface = deserialised(frame, "truth/surface", sensor)
    force = deserialised(frame, "truth/force_field", sensor)
    grid = surface.rows, surface.cols, 3
    total, moment = force.wrench.force, force.wrench.torque
    return WrittenFrame(
        image=decode_compressed(image.format, image.data),
        corners_m=_doubles(surface.position, grid),
        displacement=_doubles(surface.displacement, grid),
        force_position=_doubles(force.position, (-1, 3)),
        force=_doubles(force.force, (-1, 3)),
        wrench=np.array([total.x, total.y, total.z, moment.x, moment.y, moment.z]),
        contact_area=float(force.contact_area),
    )


def _time_ns(message: StoredMessage) -> int:
    return message.time_ns


def _doubles(values: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    return np.asarray(values, np.float64).reshape(shape)
