"""What must not end the container: requests and components of any kind."""

from __future__ import annotations

import itertools
import os
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

import rclpy
from ament_index_python import get_resource
from composition_interfaces.srv import ListNodes, LoadNode
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.msg import ParameterValue
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from cmp_tactile_bringup.container.components import ENTRY_POINT_GROUP, ComponentContainer
from cmp_tactile_bringup.container.services import ContainerServices
from cmp_tactile_processing.ros.intra_process_node import IntraProcessNode

SAMPLES = Path(__file__).parents[1] / "sample_components"
TIMEOUT_S = 60.0
_numbers = itertools.count()


class Quits(IntraProcessNode):
    """Asks for the end of the process at every message `quit`, echoes the others."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("quits", **node_kwargs)
        self._publisher = self.create_publisher(String, "out", 10)
        self.create_subscription(String, "in", self._on_text, 10)

    def _on_text(self, message: String) -> None:
        if message.data == "quit":
            sys.exit("enough")
        self._publisher.publish(message)


class Talks(IntraProcessNode):
    """Publishes what the test tells it to, in the container."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("talks", **node_kwargs)
        self.publisher = self.create_publisher(String, "in", 10)
        Talks.last = self

    last: Any = None


class Unsure(Node):
    """Cannot even tell whether it failed."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("unsure", **node_kwargs)

    @property
    def failure(self) -> str:
        """Raises."""
        msg = "no idea"
        raise RuntimeError(msg)


OWN = {"Quits": Quits, "Talks": Talks, "Unsure": Unsure}


class Box:
    """A container with services, and somebody outside."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        self.context.init(args=[])
        self.namespace = f"/faults_{os.getpid()}_{next(_numbers)}"
        self.container = ComponentContainer(self.context, lookup=lambda _, name: OWN[name])
        self.services = ContainerServices(self.container, "box", self.namespace)
        self.node = rclpy.create_node("tester", context=self.context, namespace=self.namespace)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._load = self.node.create_client(LoadNode, "box/_container/load_node")
        self._list = self.node.create_client(ListNodes, "box/_container/list_nodes")
        self.wait(self._load.service_is_ready, "the container")
        self.wait(self._list.service_is_ready, "the container")

    def wait(self, condition: Callable[[], Any], what: str) -> None:
        end = time.monotonic() + TIMEOUT_S
        while not condition():
            if time.monotonic() > end:
                pytest.fail(f"waited {TIMEOUT_S:g} s in vain for {what}")
            self._executor.spin_once(timeout_sec=0.02)

    def load(self, plugin: str, **fields: Any) -> Any:
        request = LoadNode.Request(
            package_name="test", plugin_name=plugin, node_namespace=self.namespace, **fields
        )
        future = self._load.call_async(request)
        self.wait(future.done, f"an answer to {plugin}")
        return future.result()

    def list(self) -> list[str]:
        future = self._list.call_async(ListNodes.Request())
        self.wait(future.done, "the list")
        return [name.rpartition("/")[2] for name in future.result().full_node_names]

    def close(self) -> None:
        self.container.shutdown()
        self.services.close()
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def box() -> Iterator[Box]:
    box = Box()
    yield box
    box.close()


def test_a_request_that_cannot_be_read_is_answered_with_the_reason(box):
    strange = ParameterMsg(name="prefix", value=ParameterValue(type=42))
    for _ in range(3):
        answer = box.load("Talks", parameters=[strange])
        assert not answer.success
        assert "42" in answer.error_message
    assert not box.load("Talks", extra_arguments=[strange]).success or box.list() == ["talks"]
    assert box.load("Quits").success
    assert "quits" in box.list()


@pytest.mark.parametrize("inside", [False, True], ids=["over DDS", "handed over"])
def test_a_callback_that_asks_for_the_end_is_counted_and_ends_nothing(box, capfd, inside):
    answers: list[str] = []
    box.node.create_subscription(String, "out", lambda m: answers.append(m.data), 10)
    assert box.load("Quits").success
    assert box.load("Talks").success
    outside = box.node.create_publisher(String, "in", 10)
    publisher = Talks.last.publisher if inside else outside
    box.wait(publisher.get_subscription_count, "the component to listen")
    box.wait(lambda: box.node.count_publishers("out"), "the component to talk")
    for text in ("a", "quit", "b", "quit", "c"):
        publisher.publish(String(data=text))
    box.wait(lambda: len(answers) == 3, "what comes after")
    assert answers == ["a", "b", "c"]
    (status,) = (s for s in box.container.list() if s.full_name.endswith("quits"))
    assert (status.callback_errors, status.last_error) == (2, "SystemExit: enough")
    assert "in _on_text" in capfd.readouterr().err


def test_an_error_of_the_services_that_stays_takes_no_core_and_is_told_once(box, capfd):
    executor, tries = box.services._executor, []
    spin = executor.spin_until_future_complete

    def fail(future: Any) -> None:
        if len(tries) == 4:
            spin(future)
            return
        tries.append(time.monotonic())
        msg = "it stays"
        raise RuntimeError(msg)

    executor.spin_until_future_complete = fail
    # What it waits in now ends with the next error.
    executor.create_task(lambda: 1 / 0)
    box.wait(lambda: len(tries) == 4, "four attempts")
    assert min(b - a for a, b in itertools.pairwise(tries)) >= 0.1
    assert box.load("Talks").success
    assert capfd.readouterr().err.count("Traceback") == 1


def test_a_component_that_cannot_be_asked_does_not_silence_the_others(box):
    reports: list[DiagnosticStatus] = []
    box.node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda m: reports.extend(m.status), 10
    )
    assert box.load("Unsure").success
    assert box.load("Talks").success
    assert box.list() == ["unsure", "talks"]
    name = f"{box.namespace[1:]}/box: {box.namespace[1:]}/talks"
    box.wait(lambda: [s for s in reports if s.name == name], "the diagnostics")
    assert "no idea" in box.container.list()[0].failure
    assert box.list() == ["unsure", "talks"]


@pytest.mark.parametrize("package", ["cmp_tactile_driver", "cmp_tactile_processing"])
def test_ros2_component_types_lists_what_can_be_loaded(package):
    """As the tool reads it: the first fields of the resource's lines."""
    lines = get_resource("rclcpp_components", package)[0].splitlines()
    listed = {line.partition(";")[0] for line in lines if line}
    points = entry_points(group=ENTRY_POINT_GROUP)
    assert listed == {point.name for point in points if point.name.startswith(f"{package}::")}
    assert len(listed) >= 3
