"""What processing a real recording loads."""

from command_output import output_of

CODE = """
import sys
from pathlib import Path

import cmp_tactile_bringup.offline.processor
from cmp_tactile_bringup.recordings.library import check_source, required_sensor

source = Path(sys.argv[1])
check_source(source)
required_sensor(source, "sample_rig")
print([name for name in sys.modules if name.startswith("cmp_tactile_simulation")])
"""


def test_processing_a_recording_loads_nothing_of_the_simulator(images):
    assert output_of("-c", CODE, images) == "[]\n"
