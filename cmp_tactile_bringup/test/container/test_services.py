"""The services of the component container, as launch and `ros2 component` call them."""

from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from composition_interfaces.srv import ListNodes, LoadNode, UnloadNode
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_msgs.msg import String

SAMPLES = Path(__file__).parents[1] / "sample_components"


@pytest.fixture
def client(make_box: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(SAMPLES))
    return make_box(services=True)


def _load(client: Any, plugin: str, **fields: Any) -> Any:
    return client.request_load(f"sample_components::{plugin}", **fields)


def test_load_list_unload(client):
    answer = _load(client, "Echo", node_name="parrot", remap_rules=["out:=beak"])
    assert (answer.success, answer.error_message, answer.unique_id) == (True, "", 1)
    assert answer.full_node_name == f"{client.namespace}/parrot"
    assert client.listed() == {1: f"{client.namespace}/parrot"}
    client.wait(lambda: client.node.count_publishers("beak"), "the remapped topic")
    assert client.request(UnloadNode, unique_id=1).success
    assert client.listed() == {}
    answer = client.request(UnloadNode, unique_id=1)
    assert not answer.success
    assert answer.error_message == "no component has the id 1; loaded ids: none"


def test_parameters_keep_value_and_type(ros, client):
    given = {"prefix": "a b: 'c'", "numbers": [0.5, 1.0]}
    messages = [Parameter(k, value=v).to_parameter_msg() for k, v in given.items()]
    assert _load(client, "Echo", parameters=messages).success
    answer = ros.call(
        GetParameters, "echo/get_parameters", GetParameters.Request(names=list(given))
    )
    assert answer.values[0].string_value == given["prefix"]
    assert list(answer.values[1].double_array_value) == given["numbers"]


def test_remap_rule_without_its_sign_is_refused_in_one_line(client):
    answer = _load(client, "Echo", remap_rules=["out:beak"])
    assert not answer.success
    expected = "sample_components::Echo: remap rule: found 'out:beak', expected FROM:=TO"
    assert answer.error_message == expected
    assert client.listed() == {}


def test_services_answer_while_constructors_are_slow(client):
    seconds = [Parameter("seconds", value=3.0).to_parameter_msg()]
    common: dict[str, Any] = {
        "package_name": "sample_components",
        "plugin_name": "sample_components::Slow",
        "node_namespace": client.namespace,
        "parameters": seconds,
    }
    slow = [client.request_later(LoadNode, node_name=f"slow_{k}", **common) for k in range(3)]
    assert client.listed() == {}
    assert not any(future.done() for future in slow)
    client.wait(lambda: all(future.done() for future in slow), "the slow components")
    assert all(future.result().success for future in slow)


@pytest.fixture
def errors(client: Any) -> Any:
    """The last status of a component that is an error; None where there is none."""
    reports: dict[str, DiagnosticStatus] = {}

    def take(message: DiagnosticArray) -> None:
        reports.update({status.name: status for status in message.status})

    client.node.create_subscription(DiagnosticArray, "/diagnostics", take, 10)

    def find(name: str) -> DiagnosticStatus | None:
        space = client.namespace[1:]
        status = reports.get(f"{space}/box: {space}/{name}")
        return status if status is not None and status.level == DiagnosticStatus.ERROR else None

    return find


@pytest.mark.parametrize(
    ("text", "last"), [("bad", "RuntimeError: cannot bear bad"), ("quit", "SystemExit: enough")]
)
def test_a_callback_that_raises_is_in_the_diagnostics_and_ends_nothing(
    client, errors, capfd, text, last
):
    assert _load(client, "Raises", node_name="raises").success
    publisher, answers = client.talk()
    for said in ("a", text, "b", text, "c"):
        publisher.publish(String(data=said))
    client.wait(lambda: len(answers) == 3, "what comes after")
    assert answers == ["a", "b", "c"]
    message = f"2 callbacks raised, last: {last}"
    client.wait(lambda: getattr(errors("raises"), "message", "") == message, "the diagnostics")
    assert errors("raises").hardware_id == client.namespace[1:]
    assert "in _on_text" in capfd.readouterr().err


def test_a_request_that_cannot_be_read_is_answered_with_the_reason(client):
    strange = ParameterMsg(name="prefix", value=ParameterValue(type=42))
    for _ in range(3):
        answer = _load(client, "Echo", parameters=[strange])
        assert not answer.success
        assert "42" in answer.error_message
    taken = _load(client, "Echo", extra_arguments=[strange]).success
    assert _load(client, "Ticker").success
    assert len(client.listed()) == 1 + taken


def test_a_thousand_requests_at_once_are_all_answered(client):
    """The queue of the client holds them, too: ROS's default keeps ten."""
    many = client.node.create_client(
        ListNodes, "box/_container/list_nodes", qos_profile=QoSProfile(depth=1000)
    )
    client.wait(many.service_is_ready, "the service")
    futures = [many.call_async(ListNodes.Request()) for _ in range(1000)]
    client.wait(lambda: all(future.done() for future in futures), "all answers")
    # It goes on.
    assert client.listed() == {}
