"""What the camera driver loads."""

import pytest
from command_output import output_of

pytest.importorskip("rclpy")

CODE = """
import sys
import cmp_tactile_driver.nodes.camera_driver
stages = ("tracking", "stereo", "surface", "force", "slip", "pipeline", "calibration")
unwanted = tuple(f"cmp_tactile_processing.{stage}" for stage in stages)
print([name for name in sys.modules if name.startswith((*unwanted, "cmp_tactile_simulation"))])
"""


def test_the_driver_loads_no_stage_and_no_simulator():
    assert output_of("-c", CODE) == "[]\n"
