"""docs/nodes.md and the RViz configuration say what the nodes do."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

pytest.importorskip("rclpy")

from cmp_tactile_processing.nodes.interface_table import (
    MARKER,
    NodeInterface,
    as_markdown,
    read_interfaces,
)

pytestmark = pytest.mark.ros

REPOSITORY = Path(__file__).parents[2]
DOCUMENT = REPOSITORY / "docs" / "nodes.md"
RVIZ = REPOSITORY / "cmp_tactile_bringup" / "rviz" / "cmp_tactile.rviz"
# Classes of rviz_default_plugins and what they show.
DISPLAYS = {
    "rviz_default_plugins/Grid": None,
    "rviz_default_plugins/TF": None,
    "rviz_default_plugins/Image": "sensor_msgs/Image",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/MarkerArray",
    "rviz_default_plugins/PointCloud2": "sensor_msgs/PointCloud2",
    "rviz_default_plugins/Wrench": "geometry_msgs/WrenchStamped",
}
TOOLS = {
    f"rviz_default_plugins/{name}" for name in ("MoveCamera", "Select", "FocusCamera", "Measure")
}
POLICIES = {
    "Durability Policy": {"Volatile", "Transient Local"},
    "History Policy": {"Keep Last"},
    "Reliability Policy": {"Reliable"},
}


@pytest.fixture(scope="module")
def interfaces() -> list[NodeInterface]:
    return read_interfaces()


@pytest.fixture(scope="module")
def manager() -> dict:
    return yaml.safe_load(RVIZ.read_text(encoding="utf-8"))["Visualization Manager"]


def test_nodes_md_is_what_the_nodes_say(interfaces):
    """A changed topic, parameter or description must be renewed in the document."""
    _, marker, tables = DOCUMENT.read_text(encoding="utf-8").partition(MARKER)
    assert marker, f"{DOCUMENT} lacks the line {MARKER}"
    assert tables.strip() == as_markdown(interfaces).strip(), (
        "run: python3 -m cmp_tactile_processing.nodes.interface_table docs/nodes.md"
    )


def test_every_parameter_and_node_is_described(interfaces):
    assert len(interfaces) == 7
    for node in interfaces:
        assert node.description, node.plugin
        for descriptor, _ in node.parameters:
            assert descriptor.description, f"{node.name}: {descriptor.name}"


def test_every_topic_in_rviz_is_published_with_the_displays_type(interfaces, manager):
    published = {
        topic.name: topic.type
        for node in interfaces
        for topic in node.topics
        if topic.direction == "out"
    }
    # The tables show the tracker with view: left.
    published |= {n.replace("left/", "right/"): t for n, t in published.items() if "left/" in n}
    shown = []
    for display in manager["Displays"]:
        assert display["Class"] in DISPLAYS
        if "Topic" in display:
            name = display["Topic"]["Value"]
            assert name.startswith("/sample_rig/")
            relative = name.removeprefix("/sample_rig/")
            assert published[relative] == DISPLAYS[display["Class"]]
            shown.append(relative)
            for policy, choices in POLICIES.items():
                assert display["Topic"][policy] in choices
        else:
            assert DISPLAYS[display["Class"]] is None
    assert set(shown) >= {
        "image_raw",
        "left/grid_overlay",
        "right/grid_overlay",
        "markers",
        "wrench",
    }


def test_rviz_frames_namespaces_and_tools_exist(manager):
    frames = [manager["Global Options"]["Fixed Frame"]]
    frames += [d["Reference Frame"] for d in manager["Displays"] if "Reference Frame" in d]
    frames.append(manager["Views"]["Current"]["Target Frame"])
    assert set(frames) == {"sample_rig_gel_frame"}
    (markers,) = (d for d in manager["Displays"] if d["Class"].endswith("/MarkerArray"))
    assert set(markers["Namespaces"]) == {
        "surface",
        "displacement",
        "force",
        "contact",
        "resultant",
        "contact_text",
    }
    assert {tool["Class"] for tool in manager["Tools"]} <= TOOLS
