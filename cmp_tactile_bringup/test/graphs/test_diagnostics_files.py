"""The example for diagnostic_aggregator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

import rclpy
from rclpy.parameter import Parameter

from cmp_tactile_bringup.graphs.description import CONTAINER
from cmp_tactile_bringup.graphs.packaged import load_graph

pytestmark = pytest.mark.ros

CONFIG = Path(__file__).parents[2] / "config"
FILE = CONFIG / "diagnostics" / "aggregator.yaml"


@pytest.fixture(scope="module")
def parameters() -> dict[str, Parameter[Any]]:
    """As the aggregator has them: its node `analyzers` declares what the file gives."""
    context = rclpy.Context()
    context.init()
    node = rclpy.create_node(
        "analyzers",
        context=context,
        cli_args=["--ros-args", "--params-file", str(FILE)],
        use_global_arguments=False,
        automatically_declare_parameters_from_overrides=True,
    )
    found = dict(node.get_parameters_by_prefix(""))
    node.destroy_node()
    context.try_shutdown()
    for name in ("use_sim_time", "start_type_description_service"):
        found.pop(name, None)
    return found


def _analyzers(parameters: dict[str, Parameter[Any]]) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for name, parameter in parameters.items():
        analyzer, dot, key = name.partition(".")
        if dot:
            found.setdefault(analyzer, {})[key] = parameter.value
    return found


def _taking(analyzers: dict[str, dict[str, Any]], status: str) -> list[str]:
    """Names of the analyzers to which a status of that name goes."""
    return [
        name
        for name, analyzer in analyzers.items()
        if status.startswith(tuple(analyzer["find_and_remove_prefix"]))
    ]


def test_every_node_of_the_gripper_has_one_analyzer_that_expects_it(parameters):
    components = load_graph("gripper").components
    names = {f"{item.namespace}/{item.name}".lstrip("/") for item in components}
    analyzers = _analyzers(parameters)
    for name in names:
        taking = _taking(analyzers, name)
        assert len(taking) == 1, name
        assert name in analyzers[taking[0]]["expected"]
    expected = {name for analyzer in analyzers.values() for name in analyzer.get("expected", [])}
    assert expected == names


def test_every_analyzer_has_a_container_of_the_gripper(parameters):
    analyzers = _analyzers(parameters)
    taking = []
    for part in load_graph("gripper").by_process():
        namespace, name = part.namespace.lstrip("/"), part.components[0].name
        taking += _taking(analyzers, f"{namespace}/{CONTAINER}: {namespace}/{name}")
    assert sorted(taking) == sorted(analyzers.keys() - {"grasp"})
