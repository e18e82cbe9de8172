"""Dataclass fields as ROS parameters: descriptors, overrides, refusals."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

pytest.importorskip("rclpy")

from rclpy.parameter import Parameter

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.ros.parameters import StageParameters, declare_parameters
from cmp_tactile_processing.sensor.parameters import Parameters, parameter

pytestmark = pytest.mark.ros


@dataclass(frozen=True)
class Settings(Parameters, section="settings"):
    """Parameters of every kind."""

    gain: float = parameter(1.0, "a gain", unit="m/N", within=(0.0, 2.0))
    floor: float = parameter(0.5, "a floor", within=(0.0, None))
    count: int = parameter(3, "a count", within=(1, 9))
    method: str = parameter("fast", "a method", choices=("fast", "exact"))
    enabled: bool = parameter(True, "a switch")


@pytest.fixture
def node(ros):
    return ros.node


def test_parameters_that_nobody_hears_of_are_read_only(node):
    declare_parameters(node, Settings())
    (result,) = node.set_parameters([Parameter("gain", value=0.5)])
    assert not result.successful
    assert "read-only" in result.reason


def test_whole_number_from_a_file_makes_a_float_parameter(node):
    """A description may say 2 where 2.0 is meant; the parameter must still take 0.5 later."""
    parameters = StageParameters(node, Settings(gain=2), lambda _: None)
    (result,) = node.set_parameters([Parameter("gain", value=0.5)])
    assert result.successful, result.reason
    assert parameters.value.gain == 0.5


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("floor", -1.0, "found -1.0, expected at least 0.0"),
        ("floor", "low", "found 'low', expected a number with a decimal point, at least 0.0"),
        ("floor", 3, "found 3, expected a number with a decimal point, at least 0.0"),
        ("gain", 2.5, "gain: found 2.5, expected a number with a decimal point, 0 to 2, in m/N"),
        ("count", 10, "parameter count: found 10, expected an integer, 1 to 9$"),
        ("count", 2.0, "parameter count: found 2.0, expected an integer, 1 to 9$"),
        ("enabled", 1, "parameter enabled: found 1, expected true or false$"),
        ("method", 1, "parameter method: found 1, expected a text, one of fast, exact$"),
    ],
)
def test_bad_override_at_the_start_names_parameter_found_and_expected(ros, name, value, reason):
    import rclpy

    node = rclpy.create_node(
        "settings",
        context=ros.context,
        namespace=ros.namespace,
        parameter_overrides=[Parameter(name, value=value)],
    )
    try:
        with pytest.raises(InputError, match=reason):
            StageParameters(node, Settings(), lambda _: None)
    finally:
        node.destroy_node()


def test_two_stages_of_one_node_keep_their_parameters_apart(node):
    seen, others = [], []
    one = StageParameters(node, Settings(), seen.append)
    other = StageParameters(node, Settings(), others.append, "slip")
    node.set_parameters([Parameter("slip.gain", value=2.0), Parameter("count", value=5)])
    assert seen == [one.value] == [Settings(count=5)]
    assert others == [other.value] == [Settings(gain=2.0)]
    (result,) = node.set_parameters([Parameter("slip.floor", value=-1.0)])
    assert not result.successful
