"""What the page's buttons do: services, parameters of the nodes, a recording."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, ParameterType
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python

from cmp_tactile_driver.nodes.recorder import Recorder
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.ros.services import answer_of
from cmp_tactile_viewer.snapshot import Setting, ShownSensor

STAGES = ("stereo_triangulator", "force_reconstructor")
# Those of ROS itself are many, and seldom wanted.
LEFT_OUT = ("qos_overrides.", "use_sim_time", "start_type_description_service")


@dataclass(frozen=True)
class RunningSensor:
    """A sensor on topics.

    namespace: absolute.  description_file: also the name of a packaged one.  own_name: where it has
    another one than that of its description, else empty.  shown: how it appears on the page.
    """

    namespace: str
    description_file: str
    own_name: str
    shown: ShownSensor


def node_settings(node: Node, namespace: str, views: Iterable[str]) -> tuple[Setting, ...]:
    """The parameters of a sensor's stages that may change while they run.

    Raises CmpTactileError where one does not answer.
    """
    names = (*(f"{view}_gridline_tracker" for view in views), *STAGES)
    # The first that does not answer ends it: the others would be as late.
    return tuple(item for name in names for item in _settings_of(node, f"{namespace}/{name}"))


def _settings_of(node: Node, owner: str) -> Iterator[Setting]:
    asked = ListParameters.Request()
    listed = answer_of(node, ListParameters, f"{owner}/list_parameters", asked).result.names
    names = [name for name in listed if not name.startswith(LEFT_OUT)]
    described = answer_of(
        node,
        DescribeParameters,
        f"{owner}/describe_parameters",
        DescribeParameters.Request(names=names),
    ).descriptors
    values = answer_of(
        node, GetParameters, f"{owner}/get_parameters", GetParameters.Request(names=names)
    ).values
    short = owner.rpartition("/")[2]
    for descriptor, value in zip(described, values, strict=True):
        plain = parameter_value_to_python(value)
        if descriptor.read_only or not isinstance(plain, (bool, int, float, str)):
            continue
        low, high = _range(descriptor)
        change = partial(_change, node, owner, descriptor)
        yield Setting(short, descriptor.name, plain, descriptor.description, change, low, high)


def _range(descriptor: ParameterDescriptor) -> tuple[float | None, float | None]:
    for item in (*descriptor.floating_point_range, *descriptor.integer_range):
        return float(item.from_value), float(item.to_value)
    return None, None


def _change(node: Node, owner: str, descriptor: ParameterDescriptor, value: Any) -> str:
    if descriptor.type == ParameterType.PARAMETER_INTEGER:
        value = round(value)
    elif descriptor.type == ParameterType.PARAMETER_DOUBLE:
        value = float(value)
    message = Parameter(descriptor.name, value=value).to_parameter_msg()
    request = SetParameters.Request(parameters=[message])
    result = answer_of(node, SetParameters, f"{owner}/set_parameters", request).results[0]
    if not result.successful:
        raise CmpTactileError(result.reason)
    return f"is now {value}"


class RecordingButton:
    """Records a sensor into a folder beside the process, from one press to the next."""

    def __init__(self, node: Node, sensor: RunningSensor) -> None:
        self._node, self._sensor = node, sensor
        self._recorder: Recorder | None = None

    def press(self) -> str:
        """Begin, or end; what to say.  Raises CmpTactileError where it cannot be written."""
        return self._begin() if self._recorder is None else self.close()

    def state(self) -> str:
        """What the button says while it records, else ""."""
        recorder = self._recorder
        if recorder is None:
            return ""
        progress = recorder.progress
        return f"end recording, {0.0 if progress is None else progress.duration_s:.0f} s"

    def _begin(self) -> str:
        time_of_day = datetime.now().astimezone().strftime("%Y_%m_%d-%H_%M_%S")
        bag = Path.cwd() / f"{self._sensor.shown.name}_{time_of_day}"
        given = {
            "output": str(bag),
            "sensor_description": self._sensor.description_file,
            "sensor_name": self._sensor.own_name,
        }
        executor = self._node.executor
        if executor is None:
            raise CmpTactileError("the viewer's node is not running")
        self._recorder = Recorder(
            context=self._node.context,
            namespace=self._sensor.namespace,
            use_global_arguments=False,
            parameter_overrides=[Parameter(name, value=value) for name, value in given.items()],
        )
        executor.add_node(self._recorder)
        return f"into {bag}"

    def close(self) -> str:
        """End a recording, if there is one."""
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            return ""
        if self._node.executor is not None:
            self._node.executor.remove_node(recorder)
        recorder.stop()
        bag, progress = recorder.bag, recorder.progress
        recorder.destroy_node()
        if progress is None:
            return f"{bag}: no messages were recorded"
        return f"{bag}: {sum(progress.messages.values())} messages, {progress.duration_s:.1f} s"
