"""The layouts of Foxglove show topics of the packaged graphs, and fields of their messages."""

import json
import runpy
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from cmp_tactile_bringup.graphs.packaged import load_graph
from cmp_tactile_processing.ros.messages.conversions import message_class

pytestmark = pytest.mark.ros

REPOSITORY = Path(__file__).parents[3]
LAYOUTS = REPOSITORY / "cmp_tactile_bringup" / "foxglove"
SENSORS = {"cmp_tactile": ("simulate", {}), "gripper": ("gripper", {})}


def _layout(name: str) -> dict[str, Any]:
    return json.loads((LAYOUTS / f"{name}.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def published() -> dict[str, str]:
    """Type of message by topic within a sensor's namespace."""
    tables = runpy.run_path(str(REPOSITORY / "docs" / "interface_tables.py"))
    return {
        topic.name: topic.type
        for node in tables["read_interfaces"]()
        for topic in node.topics
        if topic.direction == "out"
    }


def _named(layout: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Kind of panel, topic and path within its message of all that is shown."""
    for panel, options in layout["configById"].items():
        kind = panel.partition("!")[0]
        topics = list(options.get("topics", ()))
        topics += [options.get("imageMode", {}).get("imageTopic"), options.get("topicToRender")]
        yield from ((kind, topic, "") for topic in topics if topic)
        for series in options.get("paths", ()):
            topic, _, path = series["value"].partition(".")
            yield kind, topic, path


def _panels(place: str | dict[str, Any]) -> list[str]:
    if isinstance(place, str):
        return [place]
    return _panels(place["first"]) + _panels(place["second"])


@pytest.mark.parametrize("name", SENSORS)
def test_every_panel_is_placed_once(name):
    layout = _layout(name)
    assert sorted(_panels(layout["layout"])) == sorted(layout["configById"])


@pytest.mark.parametrize("name", SENSORS)
def test_what_is_shown_is_published(name, published):
    graph, arguments = SENSORS[name]
    spaces = [sensor.namespace for sensor in load_graph(graph, arguments).sensors]
    shown = list(_named(_layout(name)))
    kinds = {"3D": ("MarkerArray", "PointCloud2"), "Image": ("Image",)}
    for kind, topic, path in shown:
        space = next((space for space in spaces if topic.startswith(f"{space}/")), "")
        short = topic.removeprefix(f"{space}/") if space else topic
        # The tables have the tracker of the left view.
        type_name = published[short.replace("right/", "left/")]
        message = message_class(type_name.replace("/", "/msg/"))
        assert type_name.rpartition("/")[2] in kinds.get(kind, type_name)
        value = reduce(getattr, path.split("."), message()) if path else 0.0
        assert isinstance(value, float)
    assert {topic.rpartition("/")[0] for _, topic, path in shown if path} == set(spaces)
