"""What a reference force sensor read during a recording, and the bag's fixed transforms, no ROS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from cmp_tactile_bringup.recordings.library import RecordingError
from cmp_tactile_driver.bags.reader import BAD_MESSAGE
from cmp_tactile_driver.bags.storage import open_storage

__all__ = [
    "NS_PER_S",
    "ClockOffset",
    "WrenchFrame",
    "WrenchSeries",
    "at_frames",
    "estimated_offset",
    "fixed_transform",
    "read_wrench",
]

TF_STATIC = "/tf_static"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
NS_PER_S = 10**9
# Clocks of one recording differ by less, s: further away, another press would be taken for it.
LARGEST_OFFSET_S = 0.5
OFFSET_STEPS_PER_FRAME = 4
# Below this likeness of force and motion over time, the offset is not known.
LEAST_CORRELATION = 0.9
# Force that must come and go for the offset to be found, standard deviation in N.
LEAST_CHANGE_N = 0.05
LEAST_FRAMES = 8

Edges = dict[str, dict[str, NDArray[np.float64]]]


@dataclass(frozen=True)
class WrenchFrame:
    """How a wrench is turned into the force on the gel, in the gel frame.

    rotation (3, 3): of the reference sensor's axes into the gel frame's.  position (3,) m: its
    origin in the gel frame, NaN where not known; then torque is not used.
    reaction: the sensor reads the force of the gel on the object, the opposite of what is wanted.
    """

    rotation: NDArray[np.float64]
    position: NDArray[np.float64]
    reaction: bool = False

    @classmethod
    def turned(
        cls,
        rotation_deg: Sequence[float] = (0.0, 0.0, 0.0),
        position: Sequence[float] | None = None,
        *,
        reaction: bool = False,
    ) -> WrenchFrame:
        """From turns about the gel's x, then y, then z direction, degrees."""
        rotation = Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix()
        place = np.full(3, np.nan) if position is None else np.array(position, np.float64)
        return cls(rotation, place, reaction)

    def on_gel(self, wrench: NDArray[np.float64]) -> NDArray[np.float64]:
        """Wrenches (n, 6) N and N m as forces on the gel and moments about the gel's origin."""
        force, torque = wrench[:, :3] @ self.rotation.T, wrench[:, 3:] @ self.rotation.T
        torque = torque + np.cross(self.position, force)
        return np.hstack([force, torque]) * (-1.0 if self.reaction else 1.0)


@dataclass(frozen=True)
class WrenchSeries:
    """source: bag and topic.  stamp_ns (n,), rising; wrench (n, 6) N and N m as recorded.

    frame_id: of the first message, empty where it names none.
    """

    source: str
    stamp_ns: NDArray[np.int64]
    wrench: NDArray[np.float64]
    frame_id: str = ""


@dataclass(frozen=True)
class ClockOffset:
    """seconds: what the reference sensor's clock is ahead of the camera's.

    correlation: of force and motion with it, NaN where it was not estimated.
    """

    seconds: float
    correlation: float = math.nan


def read_wrench(bag: Path, topic: str) -> WrenchSeries:
    """The messages of a WrenchStamped topic, by their stamps, or log times where they have none.

    Raises BagError for a bag that cannot be read, RecordingError where it has no such topic or
    fewer than two messages of it with a force that is not NaN.
    """
    storage = open_storage(bag)
    if storage.topics.get(topic) != WRENCH_STAMPED:
        there = sorted(name for name, kind in storage.topics.items() if kind == WRENCH_STAMPED)
        msg = (
            f"{bag}: found no {WRENCH_STAMPED} on {topic!r}, "
            f"expected one of: {', '.join(there) or 'there is none'}"
        )
        raise RecordingError(msg)
    store = get_typestore(Stores.ROS2_JAZZY)
    rows: dict[int, list[float]] = {}
    frame_id = ""
    for stored in storage.messages([topic]):
        try:
            message: Any = store.deserialize_cdr(stored.data, WRENCH_STAMPED)
        except BAD_MESSAGE as error:
            msg = f"{bag}: {topic} at {stored.time_ns} ns: not a {WRENCH_STAMPED}: {error}"
            raise RecordingError(msg) from None
        stamp = message.header.stamp
        stamp_ns = stamp.sec * NS_PER_S + stamp.nanosec or stored.time_ns
        frame_id = frame_id or message.header.frame_id
        f, t = message.wrench.force, message.wrench.torque
        rows[stamp_ns] = [f.x, f.y, f.z, t.x, t.y, t.z]
    stamps = sorted(rows)
    wrench = np.array([rows[stamp] for stamp in stamps]).reshape(-1, 6)
    known = int(np.isfinite(wrench[:, :3]).all(axis=1).sum())
    if known < 2:
        nan = f" and {len(rows) - known} without a number" if known < len(rows) else ""
        msg = f"{bag}: {topic}: found {known} messages{nan}, expected two or more"
        raise RecordingError(msg)
    return WrenchSeries(f"{bag}: {topic}", np.array(stamps, np.int64), wrench, frame_id)


def at_frames(
    series: WrenchSeries, stamp_ns: NDArray[np.int64], offset_s: float
) -> NDArray[np.float64]:
    """The wrench at camera frames (n,), (n, 6), interpolated linearly; NaN before and after it.

    Raises RecordingError where no frame lies within its time.
    """
    time_s = _seconds(stamp_ns, series.stamp_ns[0]) + offset_s
    known_s = _seconds(series.stamp_ns, series.stamp_ns[0])
    columns = [
        np.interp(time_s, known_s, column, left=np.nan, right=np.nan) for column in series.wrench.T
    ]
    wrench = np.stack(columns, axis=1)
    if np.isnan(wrench[:, 0]).all():
        frames = f"{stamp_ns[0] / NS_PER_S:.3f} to {stamp_ns[-1] / NS_PER_S:.3f} s"
        msg = (
            f"{series.source}: found stamps from {series.stamp_ns[0] / NS_PER_S:.3f} to "
            f"{series.stamp_ns[-1] / NS_PER_S:.3f} s, expected some at the camera's frames, "
            f"{frames}; --time-offset says how far the clocks are apart"
        )
        raise RecordingError(msg)
    return wrench


def estimated_offset(
    series: WrenchSeries, stamp_ns: NDArray[np.int64], displacement: NDArray[np.float64]
) -> ClockOffset:
    """The offset at which force and motion of the gel are most alike; 0 where that shows nothing.

    displacement (n, rows, cols, 3) m of the frames.  Within half a second either way.
    """
    motion = np.sqrt(np.nanmean(displacement**2, axis=(1, 2, 3)))
    step_s = float(np.median(np.diff(stamp_ns))) / NS_PER_S if len(stamp_ns) > 1 else 0.0
    if len(stamp_ns) < LEAST_FRAMES or not step_s > 0:
        return ClockOffset(0.0)
    step_s /= OFFSET_STEPS_PER_FRAME
    count = math.floor(LARGEST_OFFSET_S / step_s)
    offsets = np.arange(-count, count + 1) * step_s
    likeness = np.array([_likeness(series, stamp_ns, motion, item) for item in offsets])
    if np.isnan(likeness).all() or np.nanmax(likeness) < LEAST_CORRELATION:
        return ClockOffset(0.0)
    best = int(np.nanargmax(likeness))
    return ClockOffset(
        float(offsets[best] + _vertex(likeness, best) * step_s), float(likeness[best])
    )


def _likeness(
    series: WrenchSeries, stamp_ns: NDArray[np.int64], motion: NDArray[np.float64], offset_s: float
) -> float:
    """Correlation of the force's size with the motion's; NaN where too little is known."""
    try:
        wrench = at_frames(series, stamp_ns, offset_s)
    except RecordingError:
        return math.nan
    # The zero of a reference sensor is arbitrary: change counts, from its first reading on.
    force = np.linalg.norm(wrench[:, :3] - series.wrench[0, :3], axis=1)
    known = np.isfinite(force) & np.isfinite(motion)
    if known.sum() < max(LEAST_FRAMES, len(force) // 2) or force[known].std() < LEAST_CHANGE_N:
        return math.nan
    if not motion[known].std() > 0:
        return math.nan
    return float(np.corrcoef(force[known], motion[known])[0, 1])


def _vertex(values: NDArray[np.float64], best: int) -> float:
    """Where between its neighbours the largest value lies, in steps from -0.5 to 0.5."""
    if not 0 < best < len(values) - 1:
        return 0.0
    before, at, after = values[best - 1 : best + 2]
    bend = before - 2 * at + after
    return float(0.5 * (before - after) / bend) if bend < 0 else 0.0


def _seconds(stamp_ns: NDArray[np.int64], origin_ns: int) -> NDArray[np.float64]:
    return np.asarray((stamp_ns - origin_ns) * 1e-9)


def fixed_transform(bag: Path, to: str, from_: str) -> NDArray[np.float64] | None:
    """(4, 4) transform of points of one frame into another; None where the bag has none.

    Raises BagError for a bag that cannot be read.
    """
    edges = _edges(bag)
    found = {to: np.eye(4)}
    waiting = [to]
    while waiting:
        frame = waiting.pop()
        for next_frame, transform in edges.get(frame, {}).items():
            if next_frame not in found:
                found[next_frame] = found[frame] @ transform
                waiting.append(next_frame)
    return found.get(from_)


def _edges(bag: Path) -> Edges:
    """T_ab by frames a and b, both ways, of all fixed transforms."""
    storage, edges = open_storage(bag), Edges()
    if storage.topics.get(TF_STATIC) != TF_MESSAGE:
        return edges
    store = get_typestore(Stores.ROS2_JAZZY)
    for stored in storage.messages([TF_STATIC]):
        try:
            message: Any = store.deserialize_cdr(stored.data, TF_MESSAGE)
        except BAD_MESSAGE:
            # Frames that it alone names are then not known.
            continue
        for item in message.transforms:
            parent = item.header.frame_id.lstrip("/")
            child = item.child_frame_id.lstrip("/")
            T_parent_child = _matrix(item.transform)
            edges.setdefault(parent, {})[child] = T_parent_child
            edges.setdefault(child, {})[parent] = np.asarray(
                np.linalg.inv(T_parent_child), np.float64
            )
    return edges


def _matrix(transform: Any) -> NDArray[np.float64]:
    q, t = transform.rotation, transform.translation
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    matrix[:3, 3] = t.x, t.y, t.z
    return matrix
