"""Further topics of a bag, by a file that maps features of an export to topics and fields."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.bags.arrays import StoredImages
from cmp_tactile_driver.bags.files import StoredMessage
from cmp_tactile_driver.bags.reader import image_topics
from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_processing.errors import (
    FrameError,
    FrameSourceError,
    InputError,
    RefusedValueError,
)
from cmp_tactile_processing.sensor.yaml_file import Part, YamlFile, did_you_mean, read_yaml, text

Array = NDArray[Any]
# Beside values: what a feature is no part of.
SKIPPED_FIELDS = ("header", "covariance")


@dataclass(frozen=True)
class Feature:
    """As LeRobot describes it: dtype of numpy or "image", shape and axes of a frame."""

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None = None


INDEX_FEATURES = {
    "timestamp": Feature("float32", (1,)),
    **{
        name: Feature("int64", (1,))
        for name in ("frame_index", "episode_index", "index", "task_index")
    },
}
"""What numbers the frames of every export."""


@dataclass(frozen=True)
class Series:
    """A feature over time.

    stamp_ns (n,), rising.  values: of the entries with these numbers, (k, *shape).  is_latest: a
    frame has the latest entry at or before it; else that which is nearest to the tick of the clock.
    """

    feature: Feature
    stamp_ns: NDArray[np.int64]
    values: Callable[[NDArray[np.intp]], Array]
    is_latest: bool = False


@dataclass(frozen=True)
class MappedTopic(Part):
    """field: path of a field in the message, such as pose.position; all numbers without it.

    Images need no field.  names: of the values; those of the message without them.
    """

    topic: str = field(metadata=text())
    field: str = ""
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class FeatureMap(Part):
    """Topics by the names of their features, such as observation.state or action."""

    features: Mapping[str, MappedTopic]

    def checked(self) -> FeatureMap:
        """Refuse names that LeRobot cannot hold, or that an export has anyway."""
        for name in self.features:
            if "/" in name or name in INDEX_FEATURES:
                expected = f"a name without / that is none of {', '.join(INDEX_FEATURES)}"
                raise RefusedValueError(expected, "features", found=name)
        return self


def read_feature_map(path: Path) -> tuple[YamlFile, FeatureMap]:
    """The file and what it says; InputError for one that is wrong."""
    file = read_yaml(path)
    return file, file.read(FeatureMap, 1)


def mapped_series(bag: Path, file: YamlFile, wanted: FeatureMap) -> Iterator[tuple[str, Series]]:
    """The features of a bag by name; InputError where it lacks a topic or a field."""
    storage = BagStorage(bag)
    for name, item in wanted.features.items():
        key, topic = f"features.{name}", f"/{item.topic.strip('/')}"
        if topic not in storage.topics:
            there = ", ".join(sorted(storage.topics))
            expected = f"a topic of {bag}: {there}{did_you_mean(topic, storage.topics)}"
            raise file.error(f"{key}.topic", item.topic, expected)
        messages = sorted(storage.index([topic]), key=lambda message: message.moment_ns)
        if not messages:
            raise file.error(f"{key}.topic", item.topic, f"a topic with messages in {bag}")
        stamps = np.array([message.moment_ns for message in messages], np.int64)
        if topic in image_topics(storage.topics):
            images = StoredImages(bag, storage, messages)
            yield name, Series(image_feature(images.shape), stamps, images.read, True)
            continue
        try:
            values, names = _read_values(bag, storage, messages, item)
        except KeyError as error:
            raise file.error(f"{key}.field", item.field, str(error.args[0])) from None
        if item.names and len(item.names) != values.shape[1]:
            raise file.error(f"{key}.names", list(item.names), f"{values.shape[1]} names")
        feature = Feature("float32", values.shape[1:], item.names or names)
        yield name, Series(feature, stamps, values.__getitem__, True)


def image_feature(shape: Sequence[int]) -> Feature:
    """Of images (frames, height, width) or (frames, height, width, 3)."""
    return Feature("image", (shape[1], shape[2], 3), ("height", "width", "channels"))


def _read_values(
    bag: Path, storage: BagStorage, messages: Sequence[StoredMessage], item: MappedTopic
) -> tuple[Array, tuple[str, ...]]:
    """Values (messages, n) float32 and their names.

    Raises KeyError with what is expected for a field that is not there or holds no numbers.
    """
    rows: list[list[float]] = []
    names: tuple[str, ...] = ()
    for stored in storage.read(messages):
        where = f"{bag}: {stored.topic} at {stored.time_ns} ns"
        try:
            message = stored.decode()
        except FrameError as error:
            known = "expected a type of ROS 2's own packages or of cmp_tactile_msgs"
            msg = f"{where}: {error}, {known}"
            raise FrameSourceError(msg) from None
        found = dict(_numbers(_field_of(message, item.field), item.field.rpartition(".")[2]))
        if not found:
            expected = f"a field with numbers of {stored.kind}"
            raise KeyError(expected)
        if rows and len(found) != len(names):
            msg = f"{where}: found {len(found)} values, expected {len(names)} as in the first"
            raise InputError(msg)
        joints = tuple(getattr(message, "name", ()))
        names = names or (joints if len(joints) == len(found) else tuple(found))
        rows.append(list(found.values()))
    if len(rows) < len(messages):
        raise FrameSourceError(storage.loss)
    return np.array(rows, np.float32), names


def _field_of(message: Any, path: str) -> Any:
    value = message
    for name in filter(None, path.split(".")):
        fields = [item for item in getattr(value, "__dataclass_fields__", ()) if item[0] != "_"]
        if name not in fields:
            expected = f"one of {', '.join(fields)}" if fields else "the path of a field"
            raise KeyError(expected + did_you_mean(name, fields))
        value = getattr(value, name)
    return value


def _numbers(value: Any, name: str) -> Iterator[tuple[str, float]]:
    """All numbers in a value, by name."""
    fields = [item for item in getattr(value, "__dataclass_fields__", ()) if item[0] != "_"]
    for item in fields:
        if not item.endswith(SKIPPED_FIELDS):
            yield from _numbers(getattr(value, item), f"{name}.{item}".strip("."))
    if isinstance(value, bool | int | float | np.number):
        yield name, float(value)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        yield from ((f"{name}_{number}", float(x)) for number, x in enumerate(value.ravel()))
