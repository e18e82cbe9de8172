"""Graphs of several sensors from shared parts: whose argument is whose, and what is left out."""

from __future__ import annotations

from pathlib import Path

import pytest

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_bringup.graphs.description import load_graph, read_arguments
from cmp_tactile_processing.errors import DescriptionError

HAND = """
version: 1
arguments:
  hand: {type: text, default: "", description: namespace of the hand}
  speed: {type: number, default: 1.0, description: speed of both}
namespace: $(hand)
container: box
components:
  - include: parts/finger.yaml
    prefix: thumb_
    arguments: {speed: $(speed), tip: 3}
    defaults: {name: thumb, mount: 0 0 1 0 0 0.5}
  - include: parts/finger.yaml
    prefix: index_
    arguments: {speed: $(speed), source: wire}
    defaults: {name: index}
  - {package: pkg, plugin: "pkg::Palm", name: palm}
"""
FINGER = """
arguments:
  name: {type: text, default: "", description: a name}
  source: {type: text, default: bag, choices: [bag, wire, none], description: where from}
  tip: {type: integer, default: 1, when: {source: [bag, wire]}, description: a number}
  speed: {type: number, default: 2.0, description: speed}
  mount: {type: pose, default: 0 0 0 0 0 0, description: a pose}
sensor_description: sample_rig
sensor_name: $(name)
namespace: $(name)
components:
  - include: bag.yaml
    when: {source: bag}
  - {package: pkg, plugin: "pkg::Wire", name: wire, load: last, when: {source: wire},
     parameters: {tip: $(tip)}}
  - {package: pkg, plugin: "pkg::Touch", name: touch, unless: {source: none},
     parameters: {sensor: $(sensor_name), at: $(mount.position), turned: $(mount.orientation)}}
"""
BAG = """
arguments:
  file: {type: text, default: some, description: a file}
  speed: {type: number, default: 3.0, description: speed}
components:
  - {package: pkg, plugin: "pkg::Bag", name: bag, load: last,
     parameters: {file: $(file), speed: $(speed), sensor: $(sensor_name)}}
"""


@pytest.fixture
def hand(tmp_path: Path) -> Path:
    (tmp_path / "parts").mkdir()
    finger = FINGER.replace(
        "include: bag.yaml", "include: bag.yaml\n    arguments: {speed: $(speed)}"
    )
    (tmp_path / "parts" / "finger.yaml").write_text(finger)
    (tmp_path / "parts" / "bag.yaml").write_text(BAG)
    path = tmp_path / "hand.yaml"
    path.write_text(HAND)
    return path


def _change(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_arguments_that_are_not_given_become_the_graphs_own(hand):
    arguments = {argument.name: argument for argument in read_arguments(hand)}
    assert list(arguments) == [
        "hand",
        "speed",
        "thumb_name",
        "thumb_source",
        "thumb_mount",
        "thumb_file",
        "index_name",
        "index_tip",
        "index_mount",
    ]
    assert arguments["thumb_name"].default == "thumb"
    assert arguments["thumb_file"].help == "a file; only with thumb_source:=bag"
    # The source of the index is settled, so that its number always counts and its file never.
    assert arguments["index_tip"].help == "a number"


def test_an_argument_that_no_choice_gives_effect_is_not_offered(hand):
    _change(hand, "source: wire", "source: $(how)")
    how = "  how: {type: text, default: wire, choices: [wire, none], description: how}\n"
    _change(hand, "namespace: $(hand)", f"{how}namespace: $(hand)")
    arguments = {argument.name: argument for argument in read_arguments(hand)}
    assert "index_file" not in arguments
    assert arguments["index_tip"].help == "a number; only with how:=wire"


def test_two_sensors_of_one_description_are_kept_apart(hand):
    graph = load_graph(hand, {"hand": "right"})
    assert [(s.name, s.namespace) for s in graph.sensors] == [
        ("thumb", "/right/thumb"),
        ("index", "/right/index"),
    ]
    assert {s.description.name for s in graph.sensors} == {"sample_rig.yaml"}
    assert graph.namespace == "/right"
    # The sources come last, though they stand first.
    assert [component.full_name for component in graph.components] == [
        "/right/thumb/touch",
        "/right/index/touch",
        "/right/palm",
        "/right/thumb/bag",
        "/right/index/wire",
    ]
    assert load_graph(hand).namespace == "/"


def test_values_reach_the_part_that_they_are_for(hand):
    given = {"speed": "0.5", "thumb_file": "mine", "index_tip": "7", "index_mount": "1,2,3, 4,5,6"}
    parameters = {c.full_name: c.parameters for c in load_graph(hand, given).components}
    assert parameters["/thumb/bag"] == {"file": "mine", "speed": 0.5, "sensor": "thumb"}
    assert parameters["/index/wire"] == {"tip": 7}
    assert parameters["/thumb/touch"]["at"] == [0.0, 0.0, 1.0]
    assert parameters["/thumb/touch"]["turned"] == [0.0, 0.0, 0.5]
    assert parameters["/index/touch"] == {
        "sensor": "index",
        "at": [1.0, 2.0, 3.0],
        "turned": [4.0, 5.0, 6.0],
    }


def test_what_a_condition_leaves_out_is_not_loaded(hand):
    graph = load_graph(hand, {"thumb_source": "none"})
    assert [c.full_name for c in graph.components] == ["/index/touch", "/palm", "/index/wire"]
    assert [sensor.name for sensor in graph.sensors] == ["index"]


def test_an_argument_without_effect_is_refused(hand):
    message = "thumb_file: found mine, which has no effect with thumb_source:=wire, expected it wi"
    with pytest.raises(GraphError, match=message):
        load_graph(hand, {"thumb_source": "wire", "thumb_file": "mine"})
    assert load_graph(hand, {"thumb_source": "wire", "thumb_file": "some"}).components


@pytest.mark.parametrize("pose", ["0 0 0", "0 0 0 0 0 up", "nan 0 0 0 0 0"])
def test_a_pose_is_six_numbers(hand, pose):
    with pytest.raises(GraphError, match=f"thumb_mount: found '{pose}', expected six numbers"):
        load_graph(hand, {"thumb_mount": pose})


def test_sensors_of_one_name_are_refused(hand):
    with pytest.raises(DescriptionError, match="components: found '/thumb/touch', expected every"):
        load_graph(hand, {"index_name": "thumb"})
    _change(hand.parent / "parts" / "finger.yaml", "namespace: $(name)", "namespace: n_$(tip)")
    with pytest.raises(DescriptionError, match="found 'thumb', expected every sensor with a name"):
        load_graph(hand, {"index_name": "thumb"})


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("hand", "parts/finger", "parts/fin", r"parts/fin.yaml: cannot be read"),
        ("hand", "tip: 3", "top: 3", r"components\[0\].arguments.top: found 3, expected no such"),
        ("hand", "tip: 3", "tip: three", r"arguments.tip: found 'three', expected a value of type"),
        ("hand", "source: wire", "source: air", "found 'air', expected a value .* of bag, wire"),
        ("hand", "tip: 3", "tip: $(tap)", r"arguments: found '\$\(tap\)', expected .* one of: ha"),
        ("hand", "name: thumb", "nam: thumb", "defaults.nam: found 'thumb', expected no such argu"),
        ("hand", "prefix: index_", "prefix: thumb_", "'thumb_name, include of finger.yaml', expe"),
        ("finger", "when: {source: wire}", "when: {sauce: wire}", "when: found 'sauce', expected"),
        (
            "finger",
            "when: {source: wire}",
            "when: {source: air}",
            "when.source: found 'air', expec",
        ),
        ("finger", "[bag, wire]", "[bag, air]", r"when.source: found \['bag', 'air'\], expected"),
        ("finger", "load: last", "load: first", "load: found 'first', expected one of last"),
        ("finger", "sensor_name: $(name)", "sensor_name: a b", "sensor_name: found 'a b', expect"),
        ("finger", "mount.position", "mount.place", r"found '\$\(mount.place\)', expected"),
        ("bag", "arguments:", "version: 1\narguments:", "version: found 1, expected no such key"),
        ("bag", "- {package", "- include: finger.yaml\n  - {package", "does not include this one"),
    ],
)
def test_wrong_parts_are_named(hand, file, old, new, message):
    path = hand if file == "hand" else hand.parent / "parts" / f"{file}.yaml"
    _change(path, old, new)
    with pytest.raises(DescriptionError, match=message):
        load_graph(hand)


def test_a_parameter_is_set_by_name_or_by_full_name(hand):
    both = load_graph(hand).with_parameter("touch.gain=2")
    assert [c.parameters.get("gain") for c in both.components] == [2, 2, None, None, None]
    one = load_graph(hand).with_parameter("index/touch.gain=2")
    assert [c.parameters.get("gain") for c in one.components] == [None, 2, None, None, None]


EITHER = """  - include: bag.yaml
    when: {source: bag}
    arguments: {speed: $(speed)}
  - include: bag.yaml
    unless: {source: bag}
    arguments: {speed: 9.0}
"""


def test_two_includes_of_which_one_counts_share_their_arguments(hand):
    finger = hand.parent / "parts" / "finger.yaml"
    old = "  - include: bag.yaml\n    arguments: {speed: $(speed)}\n    when: {source: bag}\n"
    _change(finger, old, EITHER)
    arguments = {argument.name: argument for argument in read_arguments(hand)}
    assert arguments["thumb_file"].help == "a file"
    graph = load_graph(hand, {"thumb_file": "mine", "index_file": "other", "speed": 5})
    found = {item.full_name: item.parameters for item in graph.components if item.name == "bag"}
    assert (found["/thumb/bag"]["file"], found["/thumb/bag"]["speed"]) == ("mine", 5.0)
    assert (found["/index/bag"]["file"], found["/index/bag"]["speed"]) == ("other", 9.0)
    # Where both can count, a name stands for one of them alone.
    _change(finger, "unless: {source: bag}", "unless: {source: wire}")
    with pytest.raises(DescriptionError, match=r"file, include of bag\.yaml', expected every argu"):
        read_arguments(hand)
