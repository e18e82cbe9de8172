"""Fixed transforms between frames, as a bag's /tf_static has them, without ROS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from cmp_tactile_driver.bags.reader import BAD_MESSAGE
from cmp_tactile_driver.bags.storage import open_storage

__all__ = ["fixed_transform"]

TF_STATIC = "/tf_static"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"

Edges = dict[str, dict[str, NDArray[np.float64]]]


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
