"""Two nodes of one name are known by what both report."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from waiting import wait_until

from cmp_tactile_processing.ros.diagnostics import namesakes
from cmp_tactile_processing.ros.diagnostics.namesakes import Namesakes

pytestmark = pytest.mark.ros


@pytest.fixture
def thumb(ros: Any) -> Iterator[tuple[str, Callable[[], None]]]:
    """Full name of a node, as of another process, and what lets it report once."""
    node = rclpy.create_node("thumb", context=ros.context, namespace=ros.namespace)
    publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
    there = [KeyValue(key="process", value="1 on elsewhere")]
    name = f"{ros.namespace}/thumb"
    status = DiagnosticStatus(name=name.lstrip("/"), values=there)
    wait_until(lambda: name in _names(ros.node), "the node in the graph")
    yield name, lambda: publisher.publish(DiagnosticArray(status=[status]))
    node.destroy_node()


def _names(node: Any) -> list[str]:
    return [f"{space}/{name}" for name, space in node.get_node_names_and_namespaces()]


def test_a_name_is_in_use_while_its_node_reports(ros, thumb, monkeypatch):
    monkeypatch.setattr(namesakes, "REPORTED_S", 0.5)
    found, (name, report) = Namesakes(ros.node), thumb
    assert found.process_of(f"{ros.namespace}/finger", own=0) == ""
    assert found.process_of(name, own=1) == ""
    ros.wait(lambda: report() or found.process_of(name, own=0) == "1 on elsewhere", "its report")
    # As one that was killed, which the graph still has.
    ros.wait(lambda: not found.process_of(name, own=0), "the end of its reports")


def test_whoever_wants_a_name_waits_for_reports_and_for_nothing_else(ros, thumb, monkeypatch):
    monkeypatch.setattr(namesakes, "REPORTED_S", 0.5)
    name, _ = thumb
    assert Namesakes(ros.node).awaited_process_of(name, lambda: False) == ""
    monkeypatch.setattr(namesakes, "REPORTED_S", 1e6)
    assert Namesakes(ros.node).awaited_process_of(f"{name}s", lambda: False) == ""
    assert Namesakes(ros.node).awaited_process_of(name, lambda: True) == ""
