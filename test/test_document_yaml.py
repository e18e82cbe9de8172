"""Every block of YAML in the documents is read by what it is meant for.

Reports of the kind, tried here:
ros2/ros2 569 (a file for `node` does nothing for a node in a namespace): docs/camera.md had
`camera_driver:`, which fits no node of a graph; each block fits the nodes of a graph.
ros2/rclcpp 2166 (what rcl makes of a file is not what was meant): rcl's values of each block are
compared with those of our own reader, also of nested sections and of names with dots.
manankharwar/fusioncore 134 (a key that fits no node is ignored in silence): every entry fits one,
and every parameter is one that docs/nodes.md lists.
"""

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from documents import blocks

from cmp_tactile_bringup.calibration.loads import read_known_loads
from cmp_tactile_bringup.export.topics import read_feature_map
from cmp_tactile_bringup.graphs.description import PARAMETERS, parameters_of_nodes
from cmp_tactile_bringup.graphs.packaged import load_graph
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.yaml_file import read_yaml
from cmp_tactile_processing.sensor.yaml_text import dump_yaml, yaml_value
from cmp_tactile_simulation.dataset.recipe import packaged_recipes, read_recipe
from cmp_tactile_simulation.grasp.scene import load_grasp, packaged_grasps
from cmp_tactile_simulation.scenes.file import read_scene

ROOT = Path(__file__).resolve().parent.parent
NODES_TEXT = (ROOT / "docs" / "nodes.md").read_text(encoding="utf-8")
WASHER = ROOT / "docs" / "examples" / "washer"
CAMERA = {"source": "v4l2", "device": "SERIAL", "sensor": "sample_rig"}
FINGERS = {f"{side}_{key}": CAMERA[key] for side in ("left", "right") for key in CAMERA}
# Of packaged graphs with every source that the documents set parameters of.
GRAPHS = {
    "gripper": FINGERS,
    "sensor": {"device": "SERIAL", "sensor": "sample_rig"},
    "simulate": {"scene": "ball:16mm"},
}
NODES = [
    component.full_name
    for graph, arguments in GRAPHS.items()
    for component in load_graph(graph, arguments).components
]


def documented() -> Iterator[Any]:
    documents = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("cmp_*/README.md")]
    for document in sorted(documents):
        text = document.read_text(encoding="utf-8")
        for number, block in enumerate(blocks(text, "ya?ml")):
            yield pytest.param(block, id=f"{document.relative_to(ROOT)}-{number}")


OWN_KEYS = {
    "feature map": {"features"},
    "grasp": {"gripper", "fingertips"},
    "grasp's part": {"servo"},
    "recipe": {"indenters", "history", "variants"},
}


def kind_of(block: str) -> str:
    content = yaml_value(block)
    keys = {"motion"} if isinstance(content, list) else set(content)
    if "controller_manager" in keys:
        return "ros2_control"
    if PARAMETERS in block:
        return "parameters"
    of_one_kind = [kind for kind, own in OWN_KEYS.items() if keys & own]
    if of_one_kind:
        return of_one_kind[0]
    if "version" in keys:
        return "scene" if "motion" in keys else "sensor"
    if "loads" in keys:
        return "loads"
    return "scene's part" if keys & {"sensor", "motion"} else "sensor's part"


def read_scene_text(folder: Path, text: str) -> None:
    (folder / "scene.yaml").write_text(text, encoding="utf-8")
    # Whatever mesh it names.
    for name in re.findall(r"file: (\w+\.stl)", text):
        shutil.copy(WASHER / "washer.stl", folder / name)
    read_scene(folder / "scene.yaml")


def read_scene_with(folder: Path, **part: Any) -> None:
    """The washer's scene with a part of it replaced."""
    whole = read_yaml(WASHER / "washer.yaml").content
    read_scene_text(folder, dump_yaml(whole | part))


def read_sensor(folder: Path, block: str) -> None:
    (folder / "sensor.yaml").write_text(block, encoding="utf-8")
    SensorDescription.load(folder / "sensor.yaml")


def read_part_of_a_scene(folder: Path, block: str) -> None:
    content = yaml_value(block)
    read_scene_with(folder, **({"motion": content} if isinstance(content, list) else content))


def read_part_of_a_sensor(folder: Path, block: str) -> None:
    read_scene_with(folder, sensor={"base": "prototype", **yaml_value(block)})


def read_loads(folder: Path, block: str) -> None:
    (folder / "loads.yaml").write_text(block, encoding="utf-8")
    assert read_known_loads(folder / "loads.yaml")[0]


def read_map(folder: Path, block: str) -> None:
    (folder / "map.yaml").write_text(block, encoding="utf-8")
    assert read_feature_map(folder / "map.yaml")[1].features


def read_recipe_with(folder: Path, block: str) -> None:
    """A packaged recipe with keys of the block."""
    whole = read_yaml(packaged_recipes()["presses"]).content
    (folder / "recipe.yaml").write_text(dump_yaml(whole | yaml_value(block)), encoding="utf-8")
    assert read_recipe(folder / "recipe.yaml").samples


def read_grasp(folder: Path, block: str) -> None:
    (folder / "grasp.yaml").write_text(block, encoding="utf-8")
    # Whatever model it names.
    for name in re.findall(r"model: (\S+\.xml)", block):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text("<mujoco/>", encoding="utf-8")
    assert load_grasp(str(folder / "grasp.yaml")).motion


def read_part_of_a_grasp(folder: Path, block: str) -> None:
    """The packaged box with a hand of its own."""
    whole = read_yaml(packaged_grasps()["box"]).content
    del whole["gripper"]
    read_grasp(folder, dump_yaml(whole | {"model": "hand.xml"} | yaml_value(block)))


def read_ros2_control(_folder: Path, block: str) -> None:
    """Its nodes are not ours: each has parameters, and one axis has as many numbers as the next."""
    nodes = yaml_value(block)
    assert all(set(node) == {PARAMETERS} for node in nodes.values())
    admittance = nodes["admittance_controller"][PARAMETERS]["admittance"]
    assert {len(value) for value in admittance.values() if isinstance(value, list)} == {6}


READERS: dict[str, Callable[[Path, str], None]] = {
    "scene": read_scene_text,
    "scene's part": read_part_of_a_scene,
    "sensor": read_sensor,
    "sensor's part": read_part_of_a_sensor,
    "loads": read_loads,
    "feature map": read_map,
    "recipe": read_recipe_with,
    "grasp": read_grasp,
    "grasp's part": read_part_of_a_grasp,
    "ros2_control": read_ros2_control,
}
BLOCKS = list(documented())


@pytest.mark.parametrize(
    "block", [item for item in BLOCKS if kind_of(item.values[0]) != "parameters"]
)
def test_a_description_is_read(block, tmp_path):
    READERS[kind_of(block)](tmp_path, block)


@pytest.mark.ros
@pytest.mark.parametrize(
    "block", [item for item in BLOCKS if kind_of(item.values[0]) == "parameters"]
)
def test_a_parameter_file_is_read_by_ros_and_by_a_graph(block, ros, tmp_path):
    file = tmp_path / "params.yaml"
    file.write_text(block, encoding="utf-8")
    # Raises for an entry that fits none of the nodes.
    found = parameters_of_nodes(file, NODES)
    for full_name, parameters in found.items():
        assert parameters_by_rcl(ros.context, file, full_name) == parameters
        for name in parameters:
            assert name.startswith("controls.") or f"`{name}`" in NODES_TEXT, name


def parameters_by_rcl(context: Any, file: Path, full_name: str) -> dict[str, Any]:
    """What a node of that name is given by `--ros-args --params-file`."""
    from rclpy.node import Node

    namespace, _, name = full_name.rpartition("/")
    node = Node(
        name,
        namespace=namespace,
        context=context,
        cli_args=["--ros-args", "--params-file", str(file)],
        use_global_arguments=False,
    )
    given = {key: item.value for key, item in node._parameter_overrides.items()}
    node.destroy_node()
    return given
