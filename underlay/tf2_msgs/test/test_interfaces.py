"""The interfaces are those of the real package, so that its programs understand ours."""

import json
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

from ament_index_python.packages import get_package_share_directory
from tf2_msgs.msg import TF2Error

pytestmark = pytest.mark.ros

# As ROS 2 Jazzy and Kilted compute them from the real definitions: the names and types of all
# fields, through every nested message. Nodes with equal hashes understand each other.
TYPE_HASHES = {
    "msg/TFMessage": "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "msg/TF2Error": "RIHS01_db2485e7d6a0ec75bf087e058ee45df682acc3a621ca7780503d10aac141809a",
    "srv/FrameGraph": "RIHS01_0d1fbc6222c018ba5f33822904a2fdd4063705289956d3fdde07cd8c50fe8067",
    "action/LookupTransform": (
        "RIHS01_0b8adf6bc0b5958879e3265b41a457e03558fe523890a81252c70eba97a82c5d"
    ),
}


@pytest.mark.parametrize("interface", TYPE_HASHES)
def test_type_hash(interface):
    share = Path(get_package_share_directory("tf2_msgs"))
    description = json.loads((share / f"{interface}.json").read_text())
    hashes = {each["type_name"]: each["hash_string"] for each in description["type_hashes"]}
    assert hashes[f"tf2_msgs/{interface}"] == TYPE_HASHES[interface]


def test_error_codes():
    """Constants are no part of the hash."""
    names = ("NO", "LOOKUP", "CONNECTIVITY", "EXTRAPOLATION", "INVALID_ARGUMENT", "TIMEOUT")
    codes = [getattr(TF2Error, f"{name}_ERROR") for name in (*names, "TRANSFORM")]
    assert codes == [0, 1, 2, 3, 4, 5, 6]
