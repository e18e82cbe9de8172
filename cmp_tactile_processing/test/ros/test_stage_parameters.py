"""Dataclass fields as ROS parameters: descriptors, overrides, refusals."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

pytest.importorskip("rclpy")

from rclpy.parameter import Parameter

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.ros.parameters import (
    StageParameters,
    declare_parameters,
)
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


def test_descriptors_carry_range_unit_and_choices(node):
    StageParameters(node, Settings(), lambda _: None)
    gain, floor, count, method = node.describe_parameters(["gain", "floor", "count", "method"])
    assert gain.description == "a gain [m/N]"
    (bounds,) = gain.floating_point_range
    assert (bounds.from_value, bounds.to_value) == (0.0, 2.0)
    assert floor.additional_constraints == "at least 0.0"
    (bounds,) = count.integer_range
    assert (bounds.from_value, bounds.to_value) == (1, 9)
    assert method.additional_constraints == "one of fast, exact"
    assert not any(item.read_only for item in (gain, floor, count, method))


def test_good_values_set_together_arrive_together(node):
    seen = []
    parameters = StageParameters(node, Settings(), seen.append)
    node.set_parameters_atomically(
        [Parameter("gain", value=2.0), Parameter("method", value="exact")]
    )
    expected = Settings(gain=2.0, method="exact")
    assert seen == [expected]
    assert parameters.value == expected


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
        ("gain", 2.5, "parameter gain: found 2.5, expected 0 to 2 m/N$"),
        ("count", 10, "parameter count: found 10, expected 1 to 9$"),
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
        with pytest.raises(ParameterError, match=reason):
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


@dataclass(frozen=True)
class Place(Parameters):
    """Parameters of several numbers."""

    offset: tuple[float, float] = parameter((0.0, 0.5), "an offset", unit="m", within=(-1.0, 1.0))


def test_fixed_parameters_come_from_a_dataclass(node):
    assert declare_parameters(node, Place()) == Place()
    descriptor = node.describe_parameter("offset")
    assert (descriptor.description, descriptor.read_only) == ("an offset [m]", True)
    assert descriptor.additional_constraints == "2 numbers from -1 to 1"
    assert list(node.get_parameter("offset").value) == [0.0, 0.5]
    with pytest.raises(
        ParameterError, match=r"parameter offset: found \[0.0, 2.0\], expected 2 num"
    ):
        Place((0.0, 2.0))
    with pytest.raises(
        ParameterError, match=r"parameter offset: found \[0.0\], expected 2 numbers"
    ):
        Place((0.0,))  # type: ignore[arg-type]
