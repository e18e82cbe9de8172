"""The newest transform to each frame, and what follows from them."""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.time import Time
from scipy.spatial.transform import Rotation


class TransformException(Exception):  # noqa: N818  the name of tf2
    """There is no such transform."""


class Buffer:
    """Keeps the newest transform to each frame; the real one also keeps and interpolates others."""

    def __init__(self) -> None:
        # Parent of each frame, and the pose (4, 4) in it.
        self._parents: dict[str, tuple[str, NDArray[np.float64]]] = {}

    def set_transform(self, transform: TransformStamped, _authority: str) -> None:
        """Keep a transform."""
        place, turn = transform.transform.translation, transform.transform.rotation
        T = np.eye(4)
        T[:3, 3] = place.x, place.y, place.z
        T[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        self._parents[transform.child_frame_id] = transform.header.frame_id, T

    def lookup_transform(
        self, target_frame: str, source_frame: str, time: Time
    ) -> TransformStamped:
        """The newest transform that takes points of the source into the target.

        Raises TransformException where frames are not connected, and for any time but 0.
        """
        root, T_root_source = self._to_root(source_frame)
        other_root, T_root_target = self._to_root(target_frame)
        if root != other_root or time.nanoseconds:
            msg = f"found no newest transform from {source_frame} to {target_frame}"
            raise TransformException(msg)
        T = np.linalg.inv(T_root_target) @ T_root_source
        found: Any = TransformStamped(child_frame_id=source_frame)
        found.header.frame_id = target_frame
        place, turn = found.transform.translation, found.transform.rotation
        place.x, place.y, place.z = T[:3, 3].tolist()
        turn.x, turn.y, turn.z, turn.w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        return found

    def _to_root(self, frame: str) -> tuple[str, NDArray[np.float64]]:
        """The frame that has no parent, or closes a circle, and the pose (4, 4) in it."""
        T, passed = np.eye(4), {frame}
        while frame in self._parents:
            frame, T_parent = self._parents[frame]
            T = T_parent @ T
            if frame in passed:
                break
            passed.add(frame)
        return frame, T
