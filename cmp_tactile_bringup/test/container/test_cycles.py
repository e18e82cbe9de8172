"""Components of a sensor come and go beside another sensor at full rate."""

import gc
import threading
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

import numpy as np
from ros_graph import RosGraph
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cmp_tactile_bringup.container.components import ComponentContainer, find_component
from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_processing.ros.messages.conversions import frame_to_msg
from cmp_tactile_processing.ros.wiring import Input, LazyResult, WiredNode

WARM_UP, CYCLES = 2, 4
PERIOD_S = 0.02
# A component that stayed would have some 10,000.  Memory does not show it: each node of rclpy
# leaves 0.1 MB behind in ROS itself.
MAX_GROWTH_OBJECTS = 180
# Sockets and threads of DDS come with the first of a kind, not with every one.
MAX_GROWTH_HANDLES = 2
GUESTS = ("ViewSplitter", "StereoTriangulator", "SurfaceVisualizer")


class Camera(WiredNode):
    """A frame every 20 ms, numbered by its stamp."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("camera", **node_kwargs)
        self._output = self.add_output(
            self.create_publisher(Image, "image_raw", 10), frame_to_msg, own_thread=True
        )
        self._frame = np.full((768, 1024), 90, np.uint8)
        self.sent = 0
        self.create_timer(PERIOD_S, self._send)

    def _send(self) -> None:
        self.sent += 1
        header = Header(frame_id="camera")
        header.stamp.sec = self.sent
        self._output.publish(self._frame, header)


class Counter(WiredNode):
    """Keeps the numbers of the left views that it gets."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("counter", **node_kwargs)
        self.seen: list[int] = []
        self.connect_input(Input(self._begin), Image, "left/image_raw", 10)

    def _begin(self, given: LazyResult) -> Any:
        return lambda: self.seen.append(given.header.stamp.sec)


OWN = {"Camera": Camera, "Counter": Counter}


class Cell(RosGraph):
    """A container whose components the test can look into."""

    def __init__(self) -> None:
        super().__init__()
        self.built: weakref.WeakSet[Any] = weakref.WeakSet()
        self._classes: dict[str, Any] = {}
        self.container = ComponentContainer(self.context, lookup=self._find)

    def _find(self, package: str, plugin: str) -> Any:
        if plugin not in self._classes:
            base = OWN[plugin] if plugin in OWN else find_component(package, plugin)
            built = self.built

            class Watched(base):  # type: ignore[misc, valid-type]
                def __init__(self, **node_kwargs: Any) -> None:
                    super().__init__(**node_kwargs)
                    built.add(self)

            self._classes[plugin] = Watched
        return self._classes[plugin]

    def load(self, plugin: str, namespace: str) -> int:
        package, space = "cmp_tactile_processing", f"{self.namespace}/{namespace}"
        item = Component(package, plugin, namespace=space)
        if plugin not in OWN:
            given = {"sensor_description": "sample_rig"}
            item = replace(item, plugin=f"{package}::{plugin}", parameters=given)
        return self.container.load(item)

    def find(self, kind: type) -> Any:
        (found,) = (node for node in self.built if isinstance(node, kind))
        return found

    def close(self) -> None:
        self.container.shutdown()
        super().close()


@pytest.fixture
def cell() -> Iterator[Cell]:
    cell = Cell()
    yield cell
    cell.close()


def _handles() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def _objects() -> int:
    gc.unfreeze()
    gc.collect()
    # The container freezes some meanwhile.
    return len(gc.get_objects()) + gc.get_freeze_count()


def test_components_come_and_go_beside_a_sensor_at_full_rate(cell):
    for plugin in ("ViewSplitter", "Counter", "Camera"):
        cell.load(plugin, "stays")
    camera, counter = cell.find(Camera), cell.find(Counter)

    def cycle(number: int) -> None:
        # Names of its own: what is kept by the name of a topic would show, too.
        space = f"guest_{number}"
        ids = [cell.load(plugin, space) for plugin in GUESTS]
        assert len(cell.container.list()) == 3 + len(GUESTS)
        # Not in the order in which they came.
        for unique_id in (ids[1], ids[0], ids[2]):
            cell.container.unload(unique_id)

    for number in range(WARM_UP):
        cycle(number)
    before = threading.active_count(), _handles(), _objects()
    sent = camera.sent
    for number in range(WARM_UP, WARM_UP + CYCLES):
        cycle(number)
    assert camera.sent > sent
    # By itself, before anybody here collects garbage.
    cell.wait(lambda: len(cell.built) == 3, "the guests to be freed")
    cell.wait(lambda: threading.active_count() <= before[0], "their threads to be gone")
    assert _handles() <= before[1] + MAX_GROWTH_HANDLES
    assert _objects() < before[2] + MAX_GROWTH_OBJECTS
    left = sorted(type(node).__mro__[1].__name__ for node in cell.built)
    assert left == ["Camera", "Counter", "ViewSplitter"]
    cell.wait(
        lambda: not any("guest" in space for _, space in cell.node.get_node_names_and_namespaces()),
        "the guests to be gone from the graph",
    )
    topics = [name for name, _ in cell.node.get_topic_names_and_types() if "guest" in name]
    assert topics == []
    cell.wait(lambda: len(counter.seen) >= camera.sent - 5, "the frames")
    assert counter.seen == list(range(counter.seen[0], counter.seen[-1] + 1))
    assert [item.errors.count for item in cell.container.list().values()] == [0, 0, 0]


def test_no_collection_looks_through_what_was_loaded(cell):
    """It would hold up frames for a tenth of a second and more."""
    gc.unfreeze()
    before = len(gc.get_objects())
    cell.load("Camera", "stays")
    assert len(gc.get_objects()) < before / 10
