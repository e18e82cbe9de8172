"""docs/launch.md lists the arguments that the launch files have."""

from __future__ import annotations

import re
from pathlib import Path

from cmp_tactile_bringup.graphs.description import load_graph, read_arguments
from cmp_tactile_bringup.graphs.launch_table import GRAPHS, MARKER, renew
from cmp_tactile_bringup.graphs.parameter_file import parameters_of_nodes
from cmp_tactile_bringup.graphs.run_arguments import RVIZ, all_arguments

ROOT = Path(__file__).resolve().parents[3]
CONFIG = ROOT / "cmp_tactile_bringup" / "config"
DOCUMENT = ROOT / "docs" / "launch.md"


def test_launch_md_is_what_the_graph_files_say():
    assert DOCUMENT.read_text(encoding="utf-8") == renew(DOCUMENT), (
        "run: python3 -m cmp_tactile_bringup.graphs.launch_table docs/launch.md"
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


DOCUMENTS = ("README.md", "docs/*.md", "docs/tutorials/*.md", "cmp_tactile_*/README.md")


def test_the_commands_of_all_documents_can_be_given_as_they_stand():
    """No argument that is not there, and each one that has no default."""
    count = 0
    for path in (path for pattern in DOCUMENTS for path in ROOT.glob(pattern)):
        prose = path.read_text(encoding="utf-8").partition(MARKER)[0].replace("\\\n", " ")
        for name, given in re.findall(
            r"ros2 launch cmp_tactile_bringup ([a-z]+)\.launch\.py(.*)", prose
        ):
            count += 1
            arguments = (*all_arguments(CONFIG / f"{name}.yaml"), RVIZ)
            named = set(re.findall(r"(\w+):=", given))
            assert named <= {item.name for item in arguments}, path
            assert named >= {item.name for item in arguments if item.default is None}, path
    assert count >= 20


def test_the_parameter_file_of_the_document_fits_a_gripper(tmp_path):
    text = re.search(r"```yaml\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    assert text is not None
    file = tmp_path / "params.yaml"
    file.write_text(text[1])
    graph = load_graph(CONFIG / "gripper.yaml")
    found = parameters_of_nodes(file, [c.full_name for c in graph.components])
    assert found["/left_finger/camera_driver"] == {"controls.exposure_time_absolute": 80}
    assert found["/right_finger/force_reconstructor"]["slip.full_ratio"] == 0.8
