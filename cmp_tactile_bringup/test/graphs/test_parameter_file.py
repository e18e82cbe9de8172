"""Parameter files of ROS: the nodes that an entry means, and mistakes that would go unseen."""

from __future__ import annotations

from pathlib import Path

import pytest

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_bringup.graphs.parameter_file import parameters_of_nodes
from cmp_tactile_bringup.graphs.run_arguments import read_run

CONFIG = Path(__file__).parents[2] / "config"
NODES = ("/hand/left/splitter", "/hand/right/splitter", "/hand/right/force")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "params.yaml"


@pytest.mark.parametrize(
    ("key", "meant"),
    [
        ("/**", NODES),
        ("/**/splitter", NODES[:2]),
        ("/hand/*/splitter", NODES[:2]),
        ("/hand/right/**", NODES[1:]),
        ("/hand/right/force", NODES[2:]),
        ("hand/right/force", NODES[2:]),
    ],
)
def test_an_entry_means_the_nodes_that_its_name_fits(file, key, meant):
    file.write_text(f"{key}:\n  ros__parameters: {{gain: 2.0}}\n")
    assert parameters_of_nodes(file, NODES) == {name: {"gain": 2.0} for name in meant}


def test_nested_names_and_the_order_of_precedence(file):
    file.write_text("""
/**: {ros__parameters: {gain: 1.0, slip: {ratio: 0.5, told: true}}}
hand: {right: {force: {ros__parameters: {gain: 2.0, sizes: [1, 2]}}}}
""")
    found = parameters_of_nodes(file, NODES)
    assert found[NODES[0]] == {"gain": 1.0, "slip.ratio": 0.5, "slip.told": True}
    assert found[NODES[2]] == {**found[NODES[0]], "gain": 2.0, "sizes": [1, 2]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("/hand/left/force: {ros__parameters: {}}", "found parameters of /hand/left/force, expect"),
        ("/**: {parameters: 1}", "parameters: found 1, expected a mapping with ros__parameters"),
        ("/**: {ros__parameters: 1}", "ros__parameters: found 1, expected a mapping"),
        ("/**: {ros__parameters: {a: null}}", "a: found None, expected a boolean, number, text"),
        ("/**: {ros__parameters: {a: [1, b]}}", r"a: found \[1, 'b'\], expected a boolean"),
        ("- 1", "found .* expected a mapping"),
    ],
)
def test_mistakes_are_named(file, text, message):
    file.write_text(text)
    with pytest.raises(GraphError, match=message):
        parameters_of_nodes(file, NODES)


def test_a_graph_takes_its_parameter_file(file):
    file.write_text("/**/view_splitter: {ros__parameters: {reliable_input: false}}")
    given = {"params_file": str(file), "container": "/box"}
    run = read_run(CONFIG / "gripper.yaml", given)
    assert run.container == "/box"
    splitters = [c for c in run.graph.components if c.name == "view_splitter"]
    assert [c.parameters["reliable_input"] for c in splitters] == [False, False]
    with pytest.raises(GraphError, match=r"none\.yaml: cannot be read"):
        read_run(CONFIG / "gripper.yaml", {"params_file": "none.yaml"})
    with pytest.raises(GraphError, match="found argument 'params', expected one of: namespace"):
        read_run(CONFIG / "gripper.yaml", {"params": "none.yaml"})
