"""What is true of the frames of a simulated recording, read back from its bag."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.bag_storage import open_storage
from cmp_tactile_processing.force_field import ForceField, SlipState
from cmp_tactile_processing.optics import build_views
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.message_definitions import simulation_typestore

__all__ = ["RecordedTruth", "read_true_force", "read_truth"]

TOPICS = ("truth/surface", "truth/force_field", "truth/left/grid", "truth/right/grid")


@dataclass(frozen=True)
class RecordedTruth:
    """What is true of n frames; NaN where a point is not seen.

    stamp_ns (n,).  corners_left_px, corners_right_px (n, rows, cols, 2): px of the whole camera
    frame.  corners_m (n, rows, cols, 3) m, gel frame.  wrench (n, 6) N and N m, on the gel.
    contact_area (n,) m^2.  slip_state (n,): codes of cmp_tactile_processing's SlipState.
    """

    stamp_ns: NDArray[np.int64]
    corners_left_px: NDArray[np.float64]
    corners_right_px: NDArray[np.float64]
    corners_m: NDArray[np.float64]
    wrench: NDArray[np.float64]
    contact_area: NDArray[np.float64]
    slip_state: NDArray[np.uint8]


def read_truth(bag: Path) -> RecordedTruth:
    """The truth of all frames of a bag that `cmp_tactile simulate` made; sensor.yaml is beside it.

    Raises BagError for a bag that cannot be read, DescriptionError for its sensor.yaml, and
    OutputError where it holds no truth.
    """
    sensor = SensorDescription.load(bag / "sensor.yaml")
    frames: dict[int, dict[str, Any]] = {}
    for topic, stamp_ns, message in _messages(bag, f"/{sensor.ros_name}/"):
        frames.setdefault(stamp_ns, {})[topic] = message
    # The last frame of an interrupted recording may lack some of its messages.
    whole = {stamp: frame for stamp, frame in frames.items() if len(frame) == len(TOPICS)}
    if not whole:
        msg = f"{bag}: found no truth, expected the topics {', '.join(TOPICS)}"
        raise OutputError(msg)
    views = build_views(sensor)
    shape = sensor.pattern.shape.corners

    def stacked(read: Callable[[dict[str, Any]], Any], dtype: Any) -> NDArray[Any]:
        return np.array([read(frame) for frame in whole.values()], dtype)

    def corners_px(view: str) -> NDArray[np.float64]:
        seen = stacked(lambda frame: frame[f"truth/{view}/grid"].corner_px, np.float64)
        return views[view].placement.to_frame(seen.reshape(-1, *shape, 2))

    position = stacked(lambda frame: frame["truth/surface"].position, np.float64)
    return RecordedTruth(
        stamp_ns=np.array(list(whole), np.int64),
        corners_left_px=corners_px("left"),
        corners_right_px=corners_px("right"),
        corners_m=position.reshape(-1, *shape, 3),
        wrench=stacked(lambda frame: _wrench(frame["truth/force_field"].wrench), np.float64),
        contact_area=stacked(lambda frame: frame["truth/force_field"].contact_area, np.float64),
        slip_state=stacked(lambda frame: frame["truth/force_field"].slip_state, np.uint8),
    )


def read_true_force(bag: Path, stamp_ns: int) -> ForceField:
    """The true force field of the frame with that stamp; errors as `read_truth`."""
    sensor = SensorDescription.load(bag / "sensor.yaml")
    for _, stamp, message in _messages(bag, f"/{sensor.ros_name}/", ("truth/force_field",)):
        if stamp == stamp_ns:
            return _force_field(message)
    msg = f"{bag}: found no truth/force_field with the stamp {stamp_ns} ns"
    raise OutputError(msg)


def _force_field(message: Any) -> ForceField:
    return ForceField(
        rows=message.rows,
        cols=message.cols,
        position=np.asarray(message.position, np.float64).reshape(-1, 3),
        force=np.asarray(message.force, np.float64).reshape(-1, 3),
        contact=np.asarray(message.contact, np.uint8) != 0,
        wrench=np.array(_wrench(message.wrench)),
        contact_area=message.contact_area,
        centre_of_pressure=_point(message.centre_of_pressure),
        reference_point=_point(message.reference_point),
        slip_state=SlipState(message.slip_state),
        valid_fraction=message.valid_fraction,
        regularization=message.regularization,
        young=message.young,
        poisson=message.poisson,
    )


def _point(message: Any) -> NDArray[np.float64]:
    return np.array([message.x, message.y, message.z])


def _messages(
    bag: Path, prefix: str, topics: Sequence[str] = TOPICS
) -> Iterator[tuple[str, int, Any]]:
    storage, store = open_storage(bag), simulation_typestore()
    wanted = [prefix + name for name in topics]
    kinds = storage.topics
    for stored in storage.messages(wanted):
        message: Any = store.deserialize_cdr(stored.data, kinds[stored.topic])
        stamp = message.header.stamp
        stamp_ns = stamp.sec * 10**9 + stamp.nanosec
        yield stored.topic.removeprefix(prefix), stamp_ns, message


def _wrench(message: Any) -> list[float]:
    force, torque = message.force, message.torque
    return [force.x, force.y, force.z, torque.x, torque.y, torque.z]
