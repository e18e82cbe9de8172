"""What a wake-up of a node's executor costs, without rclpy's event handlers and with them."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any
from unittest.mock import patch

import rclpy
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter

from cmp_tactile_driver.nodes.camera_driver import CameraDriver
from cmp_tactile_driver.nodes.recorder import Recorder
from cmp_tactile_processing.nodes.stereo_triangulator import StereoTriangulator
from cmp_tactile_processing.nodes.view_splitter import ViewSplitter
from cmp_tactile_processing.ros import base_nodes

WAKE_UPS = 200
NODES: dict[Any, dict[str, Any]] = {
    CameraDriver: {"input": "none", "autostart": False},
    Recorder: {"autostart": False},
    ViewSplitter: {},
    StereoTriangulator: {},
}


@contextmanager
def default_handlers() -> Iterator[None]:
    """Nodes that are built in here get the event handlers that rclpy makes by default."""
    with (
        patch.object(base_nodes, "PublisherEventCallbacks", _defaults(PublisherEventCallbacks)),
        patch.object(
            base_nodes, "SubscriptionEventCallbacks", _defaults(SubscriptionEventCallbacks)
        ),
    ):
        yield


def _defaults(kind: Callable[[], Any]) -> Callable[..., Any]:
    return lambda **_: kind()


def cost(node_class: Any, parameters: dict[str, Any], *, handlers: bool) -> tuple[int, float]:
    """Event handlers of a node with nothing to do, and processor time of a wake-up, us."""
    context = rclpy.Context()
    context.init()
    given = [Parameter(name, value=value) for name, value in parameters.items()]
    sensor = Parameter("sensor_description", value="sample_rig")
    with default_handlers() if handlers else nullcontext():
        node = node_class(
            context=context, use_global_arguments=False, parameter_overrides=[*given, sensor]
        )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    trigger = node.create_guard_condition(lambda: None)
    try:
        for _ in range(WAKE_UPS):
            trigger.trigger()
            executor.spin_once(timeout_sec=0)
        began = time.process_time()
        for _ in range(WAKE_UPS):
            trigger.trigger()
            executor.spin_once(timeout_sec=0)
        took = time.process_time() - began
        events = sum(item.get_num_entities().num_events for item in node.waitables)
        return events, took / WAKE_UPS * 1e6
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


def main() -> None:
    """Print a Markdown table: the least of some rounds, both kinds in turn."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=7, help="of which the least counts")
    rounds = parser.parse_args().rounds
    print("| node | handlers | us | handlers | us | ratio |\n|---|---|---|---|---|---|")
    for node_class, parameters in NODES.items():
        found: dict[bool, list[tuple[int, float]]] = {False: [], True: []}
        for _ in range(rounds):
            for handlers, costs in found.items():
                costs.append(cost(node_class, parameters, handlers=handlers))
        (few, less), (many, more) = (
            min(costs, key=lambda item: item[1]) for costs in found.values()
        )
        row = f"{few} | {less:.1f} | {many} | {more:.1f} | {less / more:.2f}"
        print(f"| {node_class.__name__} | {row} |", flush=True)


if __name__ == "__main__":
    main()
