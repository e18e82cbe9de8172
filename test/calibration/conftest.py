"""The rig of the calibrations by the gel."""

import pytest

from cmp_tactile_processing.sensor.description import SensorDescription
from hard_frames.studio import pattern_rig


@pytest.fixture(scope="session")
def gel_rig() -> SensorDescription:
    """A mirror rig like the sample's with 12 x 12 corners: quick to fit."""
    return pattern_rig(12, 12)
