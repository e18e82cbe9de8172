"""Graph files: arguments keep their types, and every mistake is named with its place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_bringup.graphs.description import load_graph, read_arguments
from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor.description import write_sensor_description
from cmp_tactile_processing.sensor.library import load_sensor

CONFIG = Path(__file__).parents[2] / "config"
GRAPH = """
version: 1
arguments:
  speed: {type: number, default: 1.0, description: speed}
  count: {type: integer, default: 3, description: how many}
  word: {type: text, default: a b, description: a word}
  on: {type: boolean, default: false, description: a switch}
  side: {type: text, default: left, choices: [left, right], description: a side}
  where: {type: path, description: a place}
sensor_description: sample_rig
namespace: rig_$(side)
container: box
components:
  - package: pkg
    plugin: pkg::A
    name: first
    remappings: {in: other/$(side)}
    parameters:
      speed: $(speed)
      count: $(count)
      text: "$(word): $(count)"
      on: $(on)
      where: $(where)
      list: [1.0, 2.0]
      sensor: $(sensor_description)
  - {package: pkg, plugin: "pkg::B", name: second, namespace: sub}
  - {package: pkg, plugin: "pkg::B", name: second, namespace: /elsewhere}
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "config" / "graph.yaml"
    file.parent.mkdir()
    file.write_text(GRAPH.replace("\n  on:", "\n  'on':").replace("      on:", "      'on':"))
    return file


def test_arguments_and_their_types(path):
    given = {"where": "here", "speed": "2", "count": "5", "on": "true", "side": "right"}
    graph = load_graph(path, given)
    first = graph.components[0]
    assert (graph.namespace, graph.container) == ("/rig_right", "box")
    assert first.remappings == {"in": "other/right"}
    parameters = dict(first.parameters)
    assert parameters.pop("sensor").endswith("sample_rig.yaml")
    assert parameters == {
        "speed": 2.0,
        "count": 5,
        "text": "a b: 5",
        "on": True,
        "where": str(Path("here").resolve()),
        "list": [1.0, 2.0],
    }
    assert isinstance(parameters["speed"], float)
    spaces = [component.namespace for component in graph.components]
    assert spaces == ["/rig_right", "/rig_right/sub", "/elsewhere"]


PLAYED = """
version: 1
arguments:
  sensor: {type: text, default: "", description: a sensor}
  what: {type: KIND, default: grasp, description: what is played}
sensor_description: $(sensor)
container: box
components:
  - include: parts/inner.yaml
  - {package: pkg, plugin: "pkg::B", name: second, parameters: {what: $(what)}}
"""
INNER = """
components:
  - {package: pkg, plugin: "pkg::A", name: first, parameters: {sensor: $(sensor_description)}}
"""


@pytest.fixture
def played(tmp_path: Path):
    """A graph file that plays recordings or scenes, with a part in another file."""

    def make(kind: str) -> Path:
        (tmp_path / "parts").mkdir()
        (tmp_path / "parts" / "inner.yaml").write_text(INNER)
        file = tmp_path / "played.yaml"
        file.write_text(PLAYED.replace("KIND", kind))
        return file

    return make


@pytest.mark.parametrize("kind", ["recording", "scene"])
def test_a_packaged_scene_brings_its_sensor_and_an_included_part_its_components(played, kind):
    graph = load_graph(played(kind))
    assert graph.sensors[0].description.name == "sample_rig.yaml"
    assert graph.namespace == "/sample_rig"
    assert [component.name for component in graph.components] == ["first", "second"]
    assert graph.components[0].parameters["sensor"] == str(graph.sensors[0].description)
    assert graph.components[1].parameters["what"] == "grasp"
    assert load_graph(graph.path, {"sensor": "prototype"}).namespace == "/prototype"


def test_a_recording_brings_the_sensor_beside_it(played, grasp_bag, tmp_path):
    file = played("recording")
    graph = load_graph(file, {"what": str(grasp_bag)})
    assert graph.sensors[0].description == (grasp_bag / "sensor.yaml").resolve()
    assert graph.components[1].parameters["what"] == str(grasp_bag.resolve())
    with pytest.raises(GraphError, match="argument sensor: found nothing, expected the file of a"):
        load_graph(file, {"what": str(tmp_path)})


def test_a_recording_that_is_not_there_is_named_before_its_sensor(played):
    file = played("recording")
    message = "argument what: /nowhere: found no such file or folder, expected a ROS 2 bag"
    with pytest.raises(GraphError, match=message):
        load_graph(file, {"what": "/nowhere"})


def test_a_wrong_key_beside_an_include_is_named(played):
    file = played("scene")
    file.write_text(file.read_text().replace("inner.yaml", "inner.yaml\n    name: first"))
    with pytest.raises(DescriptionError, match=r"components\[0\].name: found 'first', expected no"):
        load_graph(file)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, r"graph.yaml: argument 'where' is missing \(a place\)"),
        ({"where": "x", "pace": "1"}, "found argument 'pace', expected one of: speed, count, "),
        ({"where": "x", "speed": "fast"}, "argument speed: found 'fast', expected a number"),
        ({"where": "x", "count": "1.5"}, "argument count: found '1.5', expected a integer"),
        ({"where": "x", "on": "1"}, "argument on: found '1', expected a boolean"),
        ({"where": "x", "side": "up"}, "argument side: found 'up', expected one of left, right"),
    ],
)
def test_wrong_arguments_are_named(path, arguments, message):
    with pytest.raises(GraphError, match=message):
        load_graph(path, arguments)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("version: 1", "version: 2", "version: found 2, expected 1"),
        ("type: number", "type: float", r"arguments.speed.type: found 'float', expected one of"),
        ("default: 3", "default: 3.5", r"arguments.count.default: found 3.5, expected a value of"),
        ("$(speed)", "$(sped)", r"parameters.speed: found '\$\(sped\)', expected .* speed, count"),
        ("name: first", "name: 1st", r"components\[0\].name: found '1st', expected letters"),
        ("namespace: sub", "namespace: a-b", r"components\[1\].namespace: found 'a-b'"),
        ("namespace: sub", "namespace: a__b", r"components\[1\].namespace: found 'a__b'"),
        ("plugin: pkg::A", "plugin: 3", r"components\[0\].plugin: found 3, expected a text"),
        ("    name: first", "    nam: first", r"components\[0\].name: found nothing"),
        ("namespace: /elsewhere", "namespace: sub", "every component with a name of its own"),
        ("list: [1.0, 2.0]", "list: {a: 1}", r"components\[0\].parameters.list: found {'a': 1}"),
        ("container: box", "contaner: box", "container: found nothing"),
    ],
)
def test_wrong_files_are_named(path, old, new, message):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(DescriptionError, match=message):
        load_graph(path, {"where": "x"})


def test_unknown_sensor_is_named(path):
    path.write_text(path.read_text().replace("description: sample_rig", "description: none"))
    with pytest.raises(
        GraphError, match=r"graph.yaml: sensor_description: none: found no such file"
    ):
        load_graph(path, {"where": "x"})


def test_parameters_set_by_hand(path):
    graph = load_graph(path, {"where": "x"})
    changed = graph.with_parameter("first.speed=0.5").with_parameter("first.new=[1, 2]")
    assert changed.components[0].parameters["speed"] == 0.5
    assert changed.components[0].parameters["new"] == [1, 2]
    assert graph.components[0].parameters["speed"] == 1.0


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("first.speed", "found 'first.speed', expected COMPONENT.PARAMETER=VALUE"),
        ("speed=1", "expected COMPONENT.PARAMETER=VALUE"),
        ("third.speed=1", "found component 'third', expected one of first, second"),
        ("first.speed=[1, a]", "expected a boolean, number, text or list of one kind"),
        ("first.speed={a: 1}", "expected a boolean, number, text or list of one kind"),
        ("first.speed=", "expected a boolean, number, text or list of one kind"),
    ],
)
def test_wrong_assignments_are_named(path, assignment, message):
    with pytest.raises(GraphError, match=message):
        load_graph(path, {"where": "x"}).with_parameter(assignment)


def test_the_packaged_graph_takes_its_namespace_from_the_sensor():
    path = CONFIG / "replay.yaml"
    assert load_graph(path).namespace == "/sample_rig"
    assert load_graph(path, {"sensor": "prototype"}).namespace == "/prototype"
    assert load_graph(path, {"namespace": "hand/left"}).namespace == "/hand/left"
    absolute = load_graph(path, {"namespace": "/hand/left"})
    assert absolute.namespace == "/hand/left"
    assert {component.namespace for component in absolute.components} == {"/hand/left"}


def test_a_sensor_with_one_view_has_one_tracker(tmp_path):
    sample = load_sensor("sample_rig")
    optics, views = replace(sample.optics, type="monocular"), {"right": sample.views["right"]}
    description = tmp_path / "one_eyed.yaml"
    write_sensor_description(
        description, replace(sample, name="one_eyed", optics=optics, views=views)
    )
    path = CONFIG / "replay.yaml"
    both = [component.name for component in load_graph(path).components]
    one = [item.name for item in load_graph(path, {"sensor": str(description)}).components]
    assert set(both) - set(one) == {"left_gridline_tracker"}
    assert set(one) <= set(both)


def test_a_view_that_no_sensor_has_is_named(path):
    text = path.read_text()
    path.write_text(text.replace("name: second, ", "name: second, needs_view: top, ", 1))
    with pytest.raises(DescriptionError, match=r"components\[1\].needs_view: found 'top'"):
        load_graph(path, {"where": "x"})


def test_every_argument_of_the_packaged_graph_is_described():
    arguments = read_arguments(CONFIG / "replay.yaml")
    assert {argument.name for argument in arguments} >= {"input", "sensor", "rate", "loop"}
    assert all(argument.default is not None for argument in arguments)


@pytest.mark.parametrize(("given", "expected"), [({}, True), ({"publish_clock": "false"}, False)])
def test_a_second_sensor_can_leave_the_clock_to_the_first(given, expected):
    replay = load_graph(CONFIG / "replay.yaml", given).components[-1]
    assert replay.parameters["publish_clock"] is expected
