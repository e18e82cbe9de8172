"""A container in a context of its own, and somebody outside of it."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

SAMPLES = "sample_components"
# Of components that are to be found by a process of its own.
SAMPLES_FOLDER = Path(__file__).parents[1] / SAMPLES
EXECUTABLES = "cmp_tactile_bringup.container.executables"


class Box:
    """A container, and the node of the test in the same namespace.

    services: the container has a node `box` with its services.
    """

    def __init__(self, ros: Any, lookup: Any, *, services: bool) -> None:
        import rclpy

        from cmp_tactile_bringup.container.components import ComponentContainer, find_component
        from cmp_tactile_bringup.container.services import ContainerServices

        self.context = rclpy.Context()
        self.context.init(args=[])
        self.container = ComponentContainer(self.context, lookup=lookup or find_component)
        self.namespace, self.node, self.wait = ros.namespace, ros.node, ros.wait
        self.services = (
            ContainerServices(self.container, "box", ros.namespace) if services else None
        )
        self._ros = ros

    def describe(self, plugin: str, name: str = "", **fields: Any) -> Any:
        """A sample component in the namespace of the test."""
        from cmp_tactile_bringup.graphs.description import Component

        fields.setdefault("namespace", self.namespace)
        return Component(SAMPLES, f"{SAMPLES}::{plugin}", name, **fields)

    def load(self, plugin: str, name: str = "", **fields: Any) -> int:
        """Load a sample component."""
        return self.container.load(self.describe(plugin, name, **fields))

    def talk(self, topic_in: str = "in", topic_out: str = "out") -> tuple[Any, list[str]]:
        """A publisher that a component hears, and the list of what it answers."""
        from std_msgs.msg import String

        answers: list[str] = []
        self.node.create_subscription(String, topic_out, lambda m: answers.append(m.data), 10)
        publisher = self.node.create_publisher(String, topic_in, 10)
        self.wait(publisher.get_subscription_count, f"a subscriber of {topic_in}")
        # The graph knows a publisher before its messages arrive.
        self.wait(lambda: self._say(publisher, "hello") or answers, f"a publisher of {topic_out}")
        self._say(publisher, "ready")
        self.wait(lambda: answers[-1].endswith("ready"), "the last answer")
        answers.clear()
        return publisher, answers

    def _say(self, publisher: Any, text: str) -> None:
        from std_msgs.msg import String

        publisher.publish(String(data=text))
        self._ros.run(0.05)

    def names(self) -> list[str]:
        """The container's nodes in the ROS graph."""
        found = self.node.get_node_names_and_namespaces()
        return sorted(name for name, space in found if name != "tester" and space == self.namespace)

    def request_later(self, kind: Any, **fields: Any) -> Any:
        """The future of an answer of the container's service of that kind."""
        name = {"Load": "load_node", "Unlo": "unload_node", "List": "list_nodes"}[kind.__name__[:4]]
        service = f"box/_container/{name}"
        return self._ros.call_later(kind, service, kind.Request(**fields))

    def request(self, kind: Any, **fields: Any) -> Any:
        """The answer of the container's service of that kind."""
        future = self.request_later(kind, **fields)
        self.wait(future.done, f"the answer to {kind.__name__}")
        return future.result()

    def request_load_later(self, plugin: str, **fields: Any) -> Any:
        """The future answer to the request to load a component into the namespace of the test."""
        from composition_interfaces.srv import LoadNode

        fields = {"package_name": SAMPLES, "node_namespace": self.namespace, **fields}
        return self.request_later(LoadNode, plugin_name=plugin, **fields)

    def request_load(self, plugin: str, **fields: Any) -> Any:
        """That answer."""
        future = self.request_load_later(plugin, **fields)
        self.wait(future.done, f"the answer for {plugin}")
        return future.result()

    def listed(self) -> dict[int, str]:
        """Full names of the components by id, as the service lists them."""
        from composition_interfaces.srv import ListNodes

        answer = self.request(ListNodes)
        return dict(zip(answer.unique_ids, answer.full_node_names, strict=True))

    def close(self) -> None:
        """End the container."""
        self.container.shutdown()
        if self.services is not None:
            self.services.close()
        self.context.try_shutdown()


@pytest.fixture
def make_box(ros: Any) -> Iterator[Callable[..., Box]]:
    """Makes containers that end with the test."""
    made: list[Box] = []

    def make(lookup: Any = None, *, services: bool = False) -> Box:
        made.append(Box(ros, lookup, services=services))
        return made[-1]

    yield make
    for box in made:
        box.close()


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts Python with the sample components in reach."""
    started: list[subprocess.Popen[str]] = []
    path = os.pathsep.join([str(SAMPLES_FOLDER), os.environ.get("PYTHONPATH", "")])

    def run(*arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            env={**os.environ, "PYTHONPATH": path},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        started.append(process)
        return process

    yield run
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def container(ros: Any, start: Callable[..., Any]) -> subprocess.Popen[str]:
    """component_container as `box` in the namespace of the test, named as launch names it."""
    names = ["-r", "__node:=box", "-r", f"__ns:={ros.namespace}"]
    return start("-m", EXECUTABLES, "component_container", "--ros-args", *names)
