"""The services of the component container, as launch and `ros2 component` call them."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

import rclpy
from composition_interfaces.srv import ListNodes, LoadNode, UnloadNode
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from cmp_tactile_bringup.container.components import ComponentContainer
from cmp_tactile_bringup.container.services import ContainerServices

SAMPLES = Path(__file__).parents[1] / "sample_components"
TIMEOUT_S = 60.0
_numbers = itertools.count()


class Client:
    """A container with services, and somebody who calls them."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        self.context.init(args=[])
        self.namespace = f"/services_test_{os.getpid()}_{next(_numbers)}"
        self.container = ComponentContainer(self.context)
        self.services = ContainerServices(self.container, "box", self.namespace)
        self.node = rclpy.create_node("tester", context=self.context, namespace=self.namespace)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)

    def wait(self, condition: Callable[[], Any], what: str) -> None:
        end = time.monotonic() + TIMEOUT_S
        while not condition():
            if time.monotonic() > end:
                pytest.fail(f"waited {TIMEOUT_S:g} s in vain for {what}")
            self._executor.spin_once(timeout_sec=0.02)

    def call_later(self, kind: Any, name: str, **fields: Any) -> Any:
        client = self.node.create_client(kind, name)
        self.wait(client.service_is_ready, name)
        return client.call_async(kind.Request(**fields))

    def call(self, kind: Any, name: str, **fields: Any) -> Any:
        future = self.call_later(kind, name, **fields)
        self.wait(future.done, f"the answer of {name}")
        return future.result()

    def load_later(self, plugin: str, **fields: Any) -> Any:
        return self.call_later(
            LoadNode,
            "box/_container/load_node",
            package_name="sample_components",
            plugin_name=f"sample_components::{plugin}",
            node_namespace=self.namespace,
            **fields,
        )

    def load(self, plugin: str, **fields: Any) -> Any:
        future = self.load_later(plugin, **fields)
        self.wait(future.done, f"{plugin} to be loaded")
        return future.result()

    def list(self) -> dict[int, str]:
        answer = self.call(ListNodes, "box/_container/list_nodes")
        return dict(zip(answer.unique_ids, answer.full_node_names, strict=True))

    def close(self) -> None:
        self.container.shutdown()
        self.services.close()
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> Iterator[Client]:
    monkeypatch.syspath_prepend(str(SAMPLES))
    client = Client()
    yield client
    client.close()


def test_load_list_unload(client):
    answer = client.load("Echo", node_name="parrot", remap_rules=["out:=beak"])
    assert (answer.success, answer.error_message, answer.unique_id) == (True, "", 1)
    assert answer.full_node_name == f"{client.namespace}/parrot"
    assert client.list() == {1: f"{client.namespace}/parrot"}
    client.wait(lambda: client.node.count_publishers("beak"), "the remapped topic")
    unload = "box/_container/unload_node"
    assert client.call(UnloadNode, unload, unique_id=1).success
    assert client.list() == {}
    answer = client.call(UnloadNode, unload, unique_id=1)
    assert not answer.success
    assert answer.error_message == "no component has the id 1; loaded ids: none"


def test_parameters_keep_value_and_type(client):
    given = {"prefix": "a b: 'c'", "numbers": [0.5, 1.0]}
    messages = [Parameter(k, value=v).to_parameter_msg() for k, v in given.items()]
    assert client.load("Echo", parameters=messages).success
    answer = client.call(GetParameters, "echo/get_parameters", names=list(given))
    assert answer.values[0].string_value == given["prefix"]
    assert list(answer.values[1].double_array_value) == given["numbers"]


def test_failure_is_answered_with_its_reason(client):
    answer = client.load("FailsHalfWay")
    assert not answer.success
    assert answer.error_message.endswith("ValueError: no gel on this sensor")
    assert client.load("Echo").success


def test_services_answer_while_constructors_are_slow(client):
    seconds = [Parameter("seconds", value=3.0).to_parameter_msg()]
    slow = [client.load_later("Slow", node_name=f"slow_{k}", parameters=seconds) for k in range(3)]
    assert client.load("Echo").success
    assert list(client.list().values()) == [f"{client.namespace}/echo"]
    assert not any(future.done() for future in slow)
    client.wait(lambda: all(future.done() for future in slow), "the slow components")
    assert all(future.result().success for future in slow)


def test_callback_errors_are_told_in_the_diagnostics(client):
    assert client.load("Raises", node_name="raises").success
    reports: list[DiagnosticStatus] = []
    client.node.create_subscription(
        DiagnosticArray, "/diagnostics", lambda m: reports.extend(m.status), 10
    )
    publisher = client.node.create_publisher(String, "in", 10)
    client.wait(publisher.get_subscription_count, "the component to listen")
    publisher.publish(String(data="bad"))
    sensor = client.namespace[1:]
    name = f"{sensor}/box: {sensor}/raises"

    def told() -> list[DiagnosticStatus]:
        mine = [status for status in reports if status.name == name]
        return [status for status in mine if status.level == DiagnosticStatus.ERROR]

    client.wait(told, "the error in the diagnostics")
    assert told()[0].message == "1 callbacks raised, last: RuntimeError: cannot bear bad"
    assert told()[0].hardware_id == sensor


def test_a_thousand_requests_at_once_are_all_answered(client):
    """The queue of the client holds them, too: ROS's default keeps ten."""
    many = client.node.create_client(
        ListNodes, "box/_container/list_nodes", qos_profile=QoSProfile(depth=1000)
    )
    client.wait(many.service_is_ready, "the service")
    futures = [many.call_async(ListNodes.Request()) for _ in range(1000)]
    client.wait(lambda: all(future.done() for future in futures), "all answers")
    # It goes on.
    assert client.call(ListNodes, "box/_container/list_nodes").unique_ids.tolist() == []
