"""What importing the package loads."""

import pytest
from command_output import output_of

import cmp_tactile_processing

CODE = """
import sys
import cmp_tactile_processing
rooms = ("tracking", "stereo", "surface", "force", "slip", "pipeline")
loaded = [f"cmp_tactile_processing.{room}" for room in rooms] + ["numba", "scipy", "cv2", "rclpy"]
print([name for name in loaded if name in sys.modules])
"""


def test_importing_the_package_loads_no_stage():
    assert output_of("-c", CODE) == "[]\n"


@pytest.mark.parametrize("name", cmp_tactile_processing.__all__)
def test_public_names_come_with_their_first_use(name):
    assert getattr(cmp_tactile_processing, name).__name__ == name
    assert name in dir(cmp_tactile_processing)


def test_a_name_that_there_is_not():
    with pytest.raises(AttributeError, match="has no attribute 'Pipelin'"):
        _ = cmp_tactile_processing.Pipelin
