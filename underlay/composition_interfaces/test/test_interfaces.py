"""The interfaces are those of the real package, so that launch_ros and ros2 component find ours."""

import json
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from ament_index_python.packages import get_package_share_directory

pytestmark = pytest.mark.ros

# As ROS 2 Kilted computes them from the real definitions: the names and types of all fields,
# through every nested message. Nodes with equal hashes understand each other.
TYPE_HASHES = {
    "srv/ListNodes": "RIHS01_13f30d73a74c844ee4bacf78f3680f08777cad137f10fbd6a648544cc7b59d2a",
    "srv/LoadNode": "RIHS01_2e521ef6066fba6d7fc3a3b175d486709f01b4d738d9a59188858546fc8e5acd",
    "srv/UnloadNode": "RIHS01_dce562f83adc735ddcfe9dfb927b89293d4dd0fe2b8fc91e772fb83e970a43b0",
}


@pytest.mark.parametrize("interface", TYPE_HASHES)
def test_type_hash(interface):
    share = Path(get_package_share_directory("composition_interfaces"))
    description = json.loads((share / f"{interface}.json").read_text())
    hashes = {each["type_name"]: each["hash_string"] for each in description["type_hashes"]}
    assert hashes[f"composition_interfaces/{interface}"] == TYPE_HASHES[interface]
