"""The topics of a sensor in a bag as arrays over its frames, for `cmp_tactile_processing.load`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.bags.files import StoredMessage
from cmp_tactile_driver.bags.reader import COMPRESSED_IMAGE, IMAGE
from cmp_tactile_driver.bags.recording import is_bag
from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_processing.errors import FrameError, FrameSourceError, InputError
from cmp_tactile_processing.image.encodings import BitDepth
from cmp_tactile_processing.measured import GridShape
from cmp_tactile_processing.ros.messages import reading
from cmp_tactile_processing.ros.messages.making import FORCE_FIELD, SLIP_FIGURES, SURFACE
from cmp_tactile_processing.sensor.yaml_file import did_you_mean

Array = NDArray[Any]
Frame = tuple[int, int]
"""Stamp in ns, and which of the frames with this stamp it is."""

WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
PLACES = {
    "force_field": (("force_field", "truth/force_field"), (FORCE_FIELD,)),
    "surface": (("surface", "truth/surface"), (SURFACE,)),
    "wrench": (("wrench",), (WRENCH_STAMPED,)),
    "pose": (("truth/indenter_pose",), (POSE_STAMPED,)),
    "image": (("image_raw", "image_raw/compressed"), (IMAGE, COMPRESSED_IMAGE)),
}
"""Where a topic may be below the namespace of its sensor, the best first, and its types.

The first of these that a bag has gives the frames.
"""


def read_bag(path: Path, sensor: str = "") -> tuple[dict[str, Any], Array, dict[str, str]] | None:
    """Arrays by variable, stamps (frames,) ns, and facts of a sensor's topics; None for no bag.

    What a frame lacks is NaN, or 0 where it is whole numbers.  Images are read when they are used.
    Raises CmpTactileError for a bag without such topics, or several sensors and none is named.
    """
    if not is_bag(path):
        return None
    storage = BagStorage(path)
    topics = topics_of_sensors(storage.topics)
    if not topics:
        there = ", ".join(sorted(storage.topics)) or "no topics"
        msg = f"{path}: found {there}, expected topics such as /my_sensor/force_field"
        raise FrameSourceError(msg)
    if sensor not in topics and (sensor or len(topics) > 1):
        hint = did_you_mean(sensor, topics) if sensor else ": name one"
        found = f"the sensor {sensor!r}" if sensor else f"{len(topics)} sensors"
        msg = f"{path}: found {found}, expected one of {', '.join(topics)}{hint}"
        raise FrameSourceError(msg)
    name = sensor or next(iter(topics))
    return _Reading(path, storage, topics[name]).read(name)


def topics_of_sensors(topics: Mapping[str, str]) -> dict[str, dict[str, str]]:
    """By the namespace of a sensor, without slashes at its ends: what it has, and on which topic.

    topics: types by name.  A camera counts as a sensor where nothing was computed of any frame.
    """
    for wanted in (("force_field", "surface"), ("image",)):
        endings = [f"/{ending}" for kind in wanted for ending in PLACES[kind][0]]
        names = {t.removesuffix(e) for t in topics for e in endings if t.endswith(e)}
        names = {name.removesuffix("/truth") for name in names}
        found = {name: dict(_topics_below(name, topics)) for name in sorted(names)}
        found = {name.strip("/"): has for name, has in found.items() if set(wanted) & set(has)}
        if found:
            return found
    return {}


def _topics_below(name: str, topics: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    for what, (endings, kinds) in PLACES.items():
        there = [
            f"{name}/{ending}" for ending in endings if topics.get(f"{name}/{ending}") in kinds
        ]
        if there:
            yield what, there[0]


class _Reading:
    """Of one sensor."""

    def __init__(self, path: Path, storage: BagStorage, topics: Mapping[str, str]) -> None:
        """topics: by what they have."""
        self._path, self._storage, self._topics = path, storage, topics
        names = {topic: what for what, topic in topics.items()}
        self._messages: dict[str, dict[Frame, StoredMessage]] = {what: {} for what in topics}
        repeated: Counter[tuple[str, int]] = Counter()
        for message in storage.index(list(names)):
            what, stamp_ns = names[message.topic], message.moment_ns
            self._messages[what][stamp_ns, repeated[what, stamp_ns]] = message
            repeated[what, stamp_ns] += 1
        filled = [what for what in PLACES if self._messages.get(what)]
        if not filled:
            msg = f"{path}: found no message on {', '.join(names)}, expected at least one"
            raise FrameSourceError(msg)
        self._frames = sorted(self._messages[filled[0]])
        self._filled = filled

    def read(self, name: str) -> tuple[dict[str, Any], Array, dict[str, str]]:
        arrays: dict[str, Any] = {}
        for what in self._filled:
            if what == "image":
                arrays |= self._images()
            elif what != "wrench" or "wrench" not in arrays:
                arrays |= self._numbers(what, ROWS[what])
        facts = {"source": str(self._path), "sensor": name}
        facts |= {f"topic_{what}": self._topics[what] for what in self._filled}
        if self._storage.loss:
            facts["loss"] = self._storage.loss
        return arrays, np.array([stamp_ns for stamp_ns, _ in self._frames], np.int64), facts

    def _numbers(self, what: str, row_of: Callable[[Any], dict[str, Any]]) -> dict[str, Array]:
        arrays: dict[str, Array] = {}
        numbers = {frame: number for number, frame in enumerate(self._frames)}
        wanted = {key: item for key, item in self._messages[what].items() if key in numbers}
        for key, stored in zip(wanted, self._storage.read(list(wanted.values())), strict=False):
            for name, value in self._row(stored, row_of).items():
                if name not in arrays:
                    lacking = np.nan if value.dtype.kind == "f" else 0
                    shape = (len(self._frames), *value.shape)
                    arrays[name] = np.full(shape, lacking, value.dtype)
                if value.shape != arrays[name].shape[1:]:
                    expected = "x".join(map(str, arrays[name].shape[1:]))
                    found = "x".join(map(str, value.shape))
                    msg = f"{self._at(stored)}: {name}: found {found} values, expected {expected}"
                    raise InputError(msg)
                arrays[name][numbers[key]] = value
        return arrays

    def _row(self, stored: StoredMessage, row_of: Callable[[Any], dict[str, Any]]) -> Any:
        try:
            row = row_of(stored.decode())
        except (FrameError, InputError) as error:
            msg = f"{self._at(stored)}: cannot be read by this version: {error}"
            raise FrameSourceError(msg) from None
        values = {name: np.asarray(value) for name, value in row.items()}
        return {k: v.astype(np.float32) if v.dtype.kind == "f" else v for k, v in values.items()}

    def _at(self, stored: StoredMessage) -> str:
        return f"{self._path}: {stored.topic} at {stored.time_ns} ns"

    def _images(self) -> dict[str, Any]:
        found = [self._messages["image"].get(frame) for frame in self._frames]
        there = np.array([message is not None for message in found])
        if not there.any():
            return {}
        images = StoredImages(self._path, self._storage, found)
        return (
            {"image": images}
            if there.all()
            else {"image": images, "has_image": there * np.uint8(1)}
        )


class StoredImages:
    """Images (frames, y, x) or (frames, y, x, 3) BGR uint8 that are read when they are used.

    Those of no message are black.
    """

    dtype = np.dtype(np.uint8)

    def __init__(
        self, path: Path, storage: BagStorage, messages: Sequence[StoredMessage | None]
    ) -> None:
        """Raises FrameSourceError where the first cannot be read."""
        self._path, self._storage, self._messages = path, storage, messages
        self._depth = BitDepth(str(path))
        first = next(message for message in messages if message is not None)
        self.shape = (len(messages), *next(self._read([first])).shape)

    def read(self, numbers: NDArray[np.intp]) -> NDArray[np.uint8]:
        """The images of the frames with these numbers."""
        wanted = [self._messages[number] for number in numbers]
        images = np.zeros((len(wanted), *self.shape[1:]), np.uint8)
        places = [place for place, message in enumerate(wanted) if message is not None]
        there = [message for message in wanted if message is not None]
        for place, image in zip(places, self._read(there), strict=True):
            images[place] = image
        return images

    def _read(self, messages: Sequence[StoredMessage]) -> Iterator[NDArray[np.uint8]]:
        for stored in self._storage.read(messages):
            where = f"{self._path}: {stored.topic} at {stored.time_ns} ns"
            try:
                image = reading.image_from_msg(stored.decode(), None, self._depth)
            except FrameError as error:
                msg = f"{where}: not an image that can be read: {error}"
                raise FrameSourceError(msg) from None
            if hasattr(self, "shape") and image.shape != self.shape[1:]:
                found, expected = ("x".join(map(str, s)) for s in (image.shape, self.shape[1:]))
                msg = f"{where}: found an image of {found}, expected {expected} as in the first"
                raise FrameSourceError(msg)
            yield image


def _of_force_field(message: Any) -> dict[str, Any]:
    field = reading.force_field_from_msg(message)
    nodes = field.rows, field.cols
    return {
        "node_position": field.position.reshape(*nodes, 3),
        "node_force": field.force.reshape(*nodes, 3),
        "contact": field.contact.reshape(nodes),
        "wrench": field.wrench,
        "wrench_std": field.wrench_std,
        "contact_area": float(field.contact_area),
        "slip_state": np.uint8(field.slip_state),
        **{name: float(getattr(field.slip, name)) for name in SLIP_FIGURES},
        "flags": np.uint16(field.flags),
    }


def _of_surface(message: Any) -> dict[str, Any]:
    shape = GridShape(message.rows, message.cols, message.points_per_segment)
    surface = reading.surface_from_msg(message, shape)
    return {"position": surface.position, "displacement": surface.displacement}


def _of_wrench(message: Any) -> dict[str, Any]:
    force, torque = message.wrench.force, message.wrench.torque
    return {"wrench": [force.x, force.y, force.z, torque.x, torque.y, torque.z]}


def _of_pose(message: Any) -> dict[str, Any]:
    place, turn = message.pose.position, message.pose.orientation
    axis, w = np.array([turn.x, turn.y, turn.z]), turn.w
    cross = np.cross(np.eye(3), axis)
    pose = np.eye(4)
    pose[:3, :3] = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    pose[:3, 3] = place.x, place.y, place.z
    return {"pose": pose}


ROWS = {
    "force_field": _of_force_field,
    "surface": _of_surface,
    "wrench": _of_wrench,
    "pose": _of_pose,
}
