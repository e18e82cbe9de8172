"""Poses of frames in one another, by tf2."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from tf2_ros import Buffer, TransformException, TransformListener


class FramePoses:
    """Listens to /tf and /tf_static for a node."""

    def __init__(self, node: Node) -> None:
        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, node)

    def find(self, frame: str, of: str) -> NDArray[np.float64] | None:
        """Newest pose (4, 4) of a frame: takes its points into `frame`; None if it is not known."""
        try:
            found = self._buffer.lookup_transform(frame, of, Time()).transform
        except TransformException:
            return None
        place, turn = found.translation, found.rotation
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        pose[:3, 3] = place.x, place.y, place.z
        return pose
