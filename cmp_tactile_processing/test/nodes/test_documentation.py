"""docs/nodes.md says what the nodes do."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from cmp_tactile_processing.nodes.interface_table import (
    MARKER,
    NodeInterface,
    as_markdown,
    read_interfaces,
)

pytestmark = pytest.mark.ros

REPOSITORY = Path(__file__).parents[3]
DOCUMENT = REPOSITORY / "docs" / "nodes.md"


@pytest.fixture(scope="module")
def interfaces() -> list[NodeInterface]:
    return read_interfaces()


def test_nodes_md_is_what_the_nodes_say(interfaces):
    """A changed topic, parameter or description must be renewed in the document."""
    _, marker, tables = DOCUMENT.read_text(encoding="utf-8").partition(MARKER)
    assert marker, f"{DOCUMENT} lacks the line {MARKER}"
    assert tables.strip() == as_markdown(interfaces).strip(), (
        "run: python3 -m cmp_tactile_processing.nodes.interface_table docs/nodes.md"
    )


def test_every_parameter_and_node_is_described(interfaces):
    names = [node.name for node in interfaces]
    assert names[:3] == ["camera_driver", "replay", "recorder"]
    assert names[-2:] == ["surface_visualizer", "component_container"]
    assert len(names) == 9
    for node in interfaces:
        assert node.description, node.plugin
        assert ("out", "/diagnostics") in {(t.direction, t.name) for t in node.topics}, node.name
        for descriptor, _ in node.parameters:
            assert descriptor.description, f"{node.name}: {descriptor.name}"
