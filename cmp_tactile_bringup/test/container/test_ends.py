"""No wait lasts and nothing is forgotten where the end comes while a component loads."""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Iterator
from typing import Any

import pytest

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

import rclpy
from rclpy.node import Node
from waiting import wait_until

from cmp_tactile_bringup.container.components import ComponentContainer
from cmp_tactile_bringup.container.graph_runner import ContainerClient, StoppedError
from cmp_tactile_bringup.container.services import ContainerServices
from cmp_tactile_bringup.errors import ComponentLoadError
from cmp_tactile_bringup.graphs.description import Component

TIMEOUT_S = 60.0
_numbers = itertools.count()


class Plain(Node):
    """Does nothing."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("plain", **node_kwargs)


class Unasked(Plain):
    """Fails after its constructor, before it runs."""

    def has_parameter(self, name: str) -> bool:
        """Raises, once it is asked for the parameter that it was given."""
        if name == "speed":
            raise RuntimeError(name)
        return super().has_parameter(name)


class Slow(Plain):
    """Is built when the test says so."""

    began, go = threading.Event(), threading.Event()

    def __init__(self, **node_kwargs: Any) -> None:
        Slow.began.set()
        Slow.go.wait(TIMEOUT_S)
        super().__init__(**node_kwargs)


KINDS = {"Plain": Plain, "Unasked": Unasked, "Slow": Slow}


@pytest.fixture
def container(make_box: Any) -> Iterator[ComponentContainer]:
    Slow.began.clear()
    Slow.go.clear()
    yield make_box(lambda _, plugin: KINDS[plugin]).container
    Slow.go.set()


def _described(plugin: str, **parameters: Any) -> Component:
    return Component("tests", plugin, parameters=parameters)


def test_a_component_that_ends_before_it_runs_is_reported(container):
    with pytest.raises(ComponentLoadError, match="RuntimeError: speed"):
        container.load(_described("Unasked", speed=1), timeout=TIMEOUT_S)
    assert container.list() == ()


def test_a_component_that_is_ready_as_the_container_ends_is_not_listed(container, monkeypatch):
    """Else every later list would look for a thread that has ended."""
    take_name = container._take_name

    def ends_before(unique_id: int, name: str) -> None:
        container.shutdown()
        take_name(unique_id, name)

    monkeypatch.setattr(container, "_take_name", ends_before)
    with pytest.raises(ComponentLoadError, match="the container is shutting down"):
        container.load(_described("Plain"))
    assert container.list() == ()


def test_what_was_given_up_is_left_behind_as_long_as_it_runs(container):
    with pytest.raises(ComponentLoadError, match="took more than"):
        container.load(_described("Slow"), timeout=0.05)
    assert container.list() == ()
    assert container.left_behind == ("unnamed (Slow)",)
    Slow.go.set()
    wait_until(lambda: not container.left_behind, "its end")


def test_what_is_still_built_as_its_user_stops_is_unloaded_too(container):
    space = f"/ends_{os.getpid()}_{next(_numbers)}"
    services = ContainerServices(container, "box", space)
    node = rclpy.create_node("asks", context=container.context, namespace=space)
    client = ContainerClient(node, f"{space}/box", Slow.began.is_set)
    try:
        wait_until(lambda: client.is_there, "the container")
        with pytest.raises(StoppedError):
            client.load(Component("tests", "Slow", "slow", space))
        Slow.go.set()
        client.unload_all(TIMEOUT_S)
        assert container.list() == ()
        assert not [name for name in node.get_node_names() if name == "slow"]
    finally:
        client.close()
        node.destroy_node()
        services.close()
