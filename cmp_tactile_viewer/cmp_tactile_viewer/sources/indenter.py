"""Where the indenter of a simulated sensor was in a recording."""

from __future__ import annotations

from bisect import bisect_right
from functools import cached_property
from typing import Any

from rosbags.serde import SerdeError

from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_processing.ros.messages.definitions import simulation_typestore
from cmp_tactile_processing.ros.messages.reading import stamp_ns
from cmp_tactile_viewer.snapshot import Pose

POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
# Of a simulated recording, and of a recorded simulated sensor, below the sensor's namespace.
NAMES = ("/truth/indenter_pose", "/indenter/pose")


class IndenterPoses:
    """The poses of the only indenter in a bag; none where it has none, or several."""

    def __init__(self, storage: BagStorage) -> None:
        """The poses are read when the first of them is asked for."""
        self._storage = storage
        self._topics = [
            topic
            for topic, kind in storage.topics.items()
            if kind == POSE_STAMPED and topic.endswith(NAMES)
        ]

    def __bool__(self) -> bool:
        return len(self._topics) == 1

    def at(self, stamp_ns: int) -> Pose | None:
        """The pose at a moment, the last one before where that has none; None before the first."""
        stamps, poses = self._by_stamp
        index = bisect_right(stamps, stamp_ns)
        return poses[index - 1] if index else None

    @cached_property
    def _by_stamp(self) -> tuple[list[int], list[Pose]]:
        poses: dict[int, Pose] = {}
        for stored in self._storage.messages(self._topics):
            try:
                message: Any = simulation_typestore().deserialize_cdr(stored.data, POSE_STAMPED)
            except (SerdeError, ValueError):
                continue  # the indenter is not what the recording is about
            p, q = message.pose.position, message.pose.orientation
            stamp = stamp_ns(message.header.stamp)
            poses[stamp] = Pose((p.x, p.y, p.z), (q.w, q.x, q.y, q.z))
        stamps = sorted(poses)
        return stamps, [poses[stamp] for stamp in stamps]
