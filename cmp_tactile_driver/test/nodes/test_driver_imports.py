"""What the camera driver loads."""

import subprocess
import sys

import pytest

pytest.importorskip("rclpy")

CODE = """
import sys
import cmp_tactile_driver.nodes.camera_driver
stages = ("tracking", "stereo", "surface", "force", "slip", "pipeline", "calibration")
unwanted = tuple(f"cmp_tactile_processing.{stage}" for stage in stages)
print([name for name in sys.modules if name.startswith((*unwanted, "cmp_tactile_simulation"))])
"""


def test_the_driver_loads_no_stage_and_no_simulator():
    run = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
