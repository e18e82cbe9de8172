"""docs/launch.md lists the arguments that the launch files have."""

from __future__ import annotations

import re
from pathlib import Path

from cmp_tactile_bringup.graph import load_graph, read_arguments
from cmp_tactile_bringup.launch_table import GRAPHS, MARKER, renew
from cmp_tactile_bringup.parameter_file import parameters_of_nodes
from cmp_tactile_bringup.run_arguments import all_arguments

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / "cmp_tactile_bringup" / "config"
DOCUMENT = ROOT / "docs" / "launch.md"


def test_launch_md_is_what_the_graph_files_say():
    assert DOCUMENT.read_text(encoding="utf-8") == renew(DOCUMENT), (
        "run: python3 -m cmp_tactile_bringup.launch_table docs/launch.md"
    )


def test_every_launch_file_has_a_section():
    files = {path.name for path in (ROOT / "cmp_tactile_bringup" / "launch").glob("*.launch.py")}
    assert files == {f"{name}.launch.py" for name in GRAPHS}
    text = DOCUMENT.read_text(encoding="utf-8").partition(MARKER)[2]
    for name in GRAPHS:
        section = text.partition(f"## {name}.launch.py")[2].partition("\n## ")[0]
        listed = set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE))
        expected = {argument.name for argument in read_arguments(CONFIG / f"{name}.yaml")}
        # Of the right finger those alone that differ from the left one's.
        assert listed <= expected
        assert all(item.startswith("right_") for item in expected - listed)


def test_the_commands_of_the_document_have_the_arguments_that_there_are():
    prose = DOCUMENT.read_text(encoding="utf-8").partition(MARKER)[0].replace("\\\n", " ")
    commands = re.findall(r"ros2 launch cmp_tactile_bringup ([a-z]+)\.launch\.py(.*)", prose)
    assert len(commands) >= 5
    for name, given in commands:
        known = {argument.name for argument in all_arguments(CONFIG / f"{name}.yaml")} | {"rviz"}
        assert set(re.findall(r"(\w+):=", given)) <= known, name


def test_the_parameter_file_of_the_document_fits_a_gripper(tmp_path):
    text = re.search(r"```yaml\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    assert text is not None
    file = tmp_path / "params.yaml"
    file.write_text(text[1])
    graph = load_graph(CONFIG / "gripper.yaml")
    found = parameters_of_nodes(file, [c.full_name for c in graph.components])
    assert found["/left_finger/camera_driver"] == {"controls.exposure_time_absolute": 80}
    assert found["/right_finger/force_reconstructor"]["slip.full_ratio"] == 0.8
