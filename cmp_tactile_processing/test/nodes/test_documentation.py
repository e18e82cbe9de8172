"""docs/nodes.md says what the nodes do."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from rcl_interfaces.msg import ParameterType

from cmp_tactile_processing.ros.parameters import unit_of

pytestmark = pytest.mark.ros

REPOSITORY = Path(__file__).parents[3]
DOCUMENT = REPOSITORY / "docs" / "nodes.md"
UNITS = {"", "Hz", "MB", "N", "N/s", "Pa", "m", "m/(N m)", "m/N", "m/s", "px", "rad", "s"}
NUMBERS = (ParameterType.PARAMETER_DOUBLE, ParameterType.PARAMETER_INTEGER)


@pytest.fixture(scope="module")
def tables():
    return runpy.run_path(str(REPOSITORY / "docs" / "interface_tables.py"))


@pytest.fixture(scope="module")
def interfaces(tables):
    return tables["read_interfaces"]()


def test_nodes_md_is_what_the_nodes_say(tables, interfaces):
    """A changed topic, parameter or description must be renewed in the document."""
    _, marker, found = DOCUMENT.read_text(encoding="utf-8").partition(tables["MARKER"])
    assert marker, f"{DOCUMENT} lacks the line {tables['MARKER']}"
    assert found.strip() == tables["as_markdown"](interfaces).strip(), (
        "run: setup/run python3 docs/interface_tables.py docs/nodes.md"
    )


def test_every_parameter_and_node_is_described(interfaces):
    """The unit stands in brackets at the end of the description; a number has a range."""
    names = [node.name for node in interfaces]
    assert names[:3] == ["camera_driver", "replay", "recorder"]
    assert names[-2:] == ["web_viewer", "component_container"]
    assert len(names) == 10
    for node in interfaces:
        assert node.description, node.plugin
        assert ("out", "/diagnostics") in {(t.direction, t.name) for t in node.topics}, node.name
        for item, _ in node.parameters:
            where = f"{node.name}: {item.name}"
            assert item.description, where
            assert item.type != ParameterType.PARAMETER_NOT_SET, where
            assert unit_of(item) in UNITS, where
            ranges = item.floating_point_range or item.integer_range or item.additional_constraints
            assert ranges or item.type not in NUMBERS, where
