"""The rig of the sample frames."""

import pytest

from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor


@pytest.fixture(scope="session")
def sensor() -> SensorDescription:
    """As packaged."""
    return load_sensor("sample_rig")
