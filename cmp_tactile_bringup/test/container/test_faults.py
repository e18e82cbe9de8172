"""What must not end the container: requests and components of any kind."""

import sys
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.msg import ParameterValue
from rclpy.node import Node
from std_msgs.msg import String


class Quits(Node):
    """Asks for the end of the process at every message `quit`, echoes the others."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("quits", **node_kwargs)
        self._publisher = self.create_publisher(String, "out", 10)
        self.create_subscription(String, "in", self._on_text, 10)

    def _on_text(self, message: String) -> None:
        if message.data == "quit":
            sys.exit("enough")
        self._publisher.publish(message)


class Talks(Node):
    """Publishes what the test wants, in the container."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("talks", **node_kwargs)
        self.publisher = self.create_publisher(String, "in", 10)
        Talks.last = self

    last: Any = None


OWN = {"Quits": Quits, "Talks": Talks}


@pytest.fixture
def box(make_box: Any) -> Any:
    return make_box(lambda _, name: OWN[name], services=True)


def _listed(box: Any) -> list[str]:
    return [name.rpartition("/")[2] for name in box.listed().values()]


def test_a_request_that_cannot_be_read_is_answered_with_the_reason(box):
    strange = ParameterMsg(name="prefix", value=ParameterValue(type=42))
    for _ in range(3):
        answer = box.request_load("Talks", parameters=[strange])
        assert not answer.success
        assert "42" in answer.error_message
    assert not box.request_load("Talks", extra_arguments=[strange]).success or _listed(box) == [
        "talks"
    ]
    assert box.request_load("Quits").success
    assert "quits" in _listed(box)


def test_a_callback_that_asks_for_the_end_is_counted_and_ends_nothing(box, capfd):
    answers: list[str] = []
    box.node.create_subscription(String, "out", lambda m: answers.append(m.data), 10)
    assert box.request_load("Quits").success
    assert box.request_load("Talks").success
    publisher = Talks.last.publisher
    box.wait(publisher.get_subscription_count, "the component to listen")
    box.wait(lambda: box.node.count_publishers("out"), "the component to talk")
    for text in ("a", "quit", "b", "quit", "c"):
        publisher.publish(String(data=text))
    box.wait(lambda: len(answers) == 3, "what comes after")
    assert answers == ["a", "b", "c"]
    (status,) = (s for s in box.container.list().values() if s.full_name.endswith("quits"))
    assert (status.errors.count, status.errors.last) == (2, "SystemExit: enough")
    assert "in _on_text" in capfd.readouterr().err
