"""What importing the package loads."""

from command_output import output_of

CODE = """
import sys
import cmp_tactile_processing
rooms = ("tracking", "stereo", "surface", "force", "slip", "pipeline")
loaded = [f"cmp_tactile_processing.{room}" for room in rooms] + ["numba", "scipy", "cv2", "rclpy"]
print([name for name in loaded if name in sys.modules])
"""


def test_importing_the_package_loads_no_stage():
    assert output_of("-c", CODE) == "[]\n"
