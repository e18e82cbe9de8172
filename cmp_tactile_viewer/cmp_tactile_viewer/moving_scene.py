"""Where gels and a held object are: from transforms (tf), and the marker of the object's mesh."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_processing.ros.messages.making import (
    MARKER,
    MARKER_TOPIC,
    TRIANGLE_LIST,
    gel_frame,
)
from cmp_tactile_processing.ros.messages.reading import stamp_ns
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_viewer.snapshot import Body, Pose, ShownSensor, Snapshot

TF_MESSAGE = "tf2_msgs/msg/TFMessage"
# A shorter quaternion is none: messages that nobody filled in have zeros.
MIN_QUATERNION_LENGTH = 0.1


class _Transform(NamedTuple):
    """T_parent_child at a moment.  turn: a quaternion (x, y, z, w)."""

    stamp_ns: int
    parent: str
    place: tuple[float, float, float]
    turn: tuple[float, float, float, float]


class MovingScene:
    """Gels and a body that move, by messages of ROS or of `rosbags`.

    frame: of the scene, in which poses are given; empty until it is known.
    """

    def __init__(self, frame: str = "", most_kept: int | None = None) -> None:
        """most_kept: newest transforms of each frame that are kept; None for all of a recording."""
        self.frame, self._most_kept = frame, most_kept
        self._transforms: dict[str, list[_Transform]] = {}
        self._body: tuple[str, NDArray[np.float64]] | None = None

    def take_transforms(self, message: Any) -> None:
        """Take a tf2_msgs/TFMessage, without transforms that are not finite."""
        for item in message.transforms:
            p, q = item.transform.translation, item.transform.rotation
            place, turn = (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)
            length = np.linalg.norm(turn)
            if not np.isfinite([*place, length]).all() or length < MIN_QUATERNION_LENGTH:
                continue
            parent, stamp = item.header.frame_id.lstrip("/"), stamp_ns(item.header.stamp)
            known = self._transforms.setdefault(item.child_frame_id.lstrip("/"), [])
            if self._most_kept and known and stamp < known[-1].stamp_ns:
                # A recording, or a simulation, begins again.
                known.clear()
            insort(known, _Transform(stamp, parent, place, turn))
            if self._most_kept:
                del known[: -self._most_kept]

    def take_marker(self, message: Any) -> None:
        """Take a visualization_msgs/Marker as the body's mesh if it is a list of triangles."""
        corners = np.array([(point.x, point.y, point.z) for point in message.points])
        whole = len(corners) and len(corners) % 3 == 0 and np.isfinite(corners).all()
        if message.type == TRIANGLE_LIST and whole:
            self._body = message.header.frame_id.lstrip("/"), corners.reshape(-1, 3, 3)

    def find_frame(self, sensors: Sequence[SensorDescription]) -> None:
        """Take the common root of all gel frames as the frame; none where there is no such root."""
        roots = {self._from_root(gel_frame(sensor), 0)[0] for sensor in sensors}
        gels = {gel_frame(sensor) for sensor in sensors}
        self.frame = roots.pop() if len(roots) == 1 and not roots & gels else ""

    def placed(self, snapshot: Snapshot, sensor: SensorDescription) -> Snapshot:
        """The snapshot with the poses of gel and body at its moment, if they are known."""
        body, moment = None, snapshot.stamp_ns
        if self._body is not None:
            frame, triangles = self._body
            pose = self._pose(frame, moment)
            body = Body(triangles, pose) if pose else None
        return replace(snapshot, mount=self._pose(gel_frame(sensor), moment), body=body)

    def _pose(self, frame: str, moment_ns: int) -> Pose | None:
        """T_scene_frame; None where they are in different trees."""
        if not self.frame:
            return None
        root, T_root_frame = self._from_root(frame, moment_ns)
        scene_root, T_root_scene = self._from_root(self.frame, moment_ns)
        if root != scene_root:
            return None
        T = np.linalg.inv(T_root_scene) @ T_root_frame
        x, y, z = T[:3, 3].tolist()
        a, b, c, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        return Pose((x, y, z), (w, a, b, c))

    def _from_root(self, frame: str, moment_ns: int) -> tuple[str, NDArray[np.float64]]:
        """The root of a frame's tree, and T_root_frame (4, 4)."""
        T, passed = np.eye(4), {frame}
        while known := self._transforms.get(frame):
            # The last one before; the first where it is later.
            number = bisect_right(known, moment_ns, key=lambda item: item.stamp_ns)
            transform = known[max(number - 1, 0)]
            step = np.eye(4)
            step[:3, :3] = Rotation.from_quat(transform.turn).as_matrix()
            step[:3, 3] = transform.place
            T, frame = step @ T, transform.parent
            if frame in passed:
                break
            passed.add(frame)
        return frame, T


class RecordedScene:
    """Poses of the gels and of what they hold in a bag; they stand still where it has no tf."""

    def __init__(self, storage: BagStorage, sensors: Sequence[ShownSensor]) -> None:
        """All transforms are read when the first frame is shown."""
        self._storage = storage
        self._sensors = {sensor.name: sensor.description for sensor in sensors}

    def placed(self, name: str, snapshot: Snapshot) -> Snapshot:
        """A snapshot of a sensor with these poses at its moment."""
        return self._scene.placed(snapshot, self._sensors[name])

    @cached_property
    def _scene(self) -> MovingScene:
        scene, topics = MovingScene(), self._storage.topics
        transforms = [topic for topic, kind in topics.items() if kind == TF_MESSAGE]
        for message in self._storage.decoded(transforms):
            scene.take_transforms(message)
        if topics.get(MARKER_TOPIC) == MARKER:
            for message in self._storage.decoded([MARKER_TOPIC]):
                scene.take_marker(message)
        scene.find_frame([*self._sensors.values()])
        return scene
