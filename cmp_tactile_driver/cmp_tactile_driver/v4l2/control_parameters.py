"""Controls of a camera as parameters of the node that publishes its frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.parameter import Parameter

from cmp_tactile_driver.sources.frames import Frame
from cmp_tactile_driver.v4l2.controls import Control, ControlKind, ControlValue
from cmp_tactile_processing.errors import FrameSourceError, InputError
from cmp_tactile_processing.ros.parameters import declare_checked

if TYPE_CHECKING:
    from cmp_tactile_driver.v4l2.pair import CameraPair
    from cmp_tactile_driver.v4l2.source import V4L2Source

PREFIX = "controls."


class ControlParameters:
    """Parameters `controls.NAME` of a node, from when it is configured until it is cleaned up.

    Those that were given when the node was started are set, the others are as the camera has them.
    A control that cannot be set is refused with the reason, also at start by InputError.  What
    the camera makes of them when frames begin to come is shown too, with a warning where it
    keeps other values than were set.
    """

    def __init__(self, node: Any, source: V4L2Source | CameraPair) -> None:
        self._node = node
        self._source = source
        self._following = False
        self._controls = dict(source.controls().by_name)
        self._declared: list[str] = []
        self._refused = ""
        given = self._given()
        try:
            self._declare()
            if given:
                source.set_controls(given)
        except BaseException:
            self._undeclare()
            raise
        node.add_on_set_parameters_callback(self._set)
        node.add_post_set_parameters_callback(self._follow)
        self._follow([])
        # Frames begin on the thread that reads, parameters are set by the executor.
        self._settled = node.create_guard_condition(self._report_settled)
        source.when_settled = self._settled.trigger
        for title in source.controls().skipped:
            node.get_logger().info(
                f"{source.name}: control {title!r} has no single value: it is left out"
            )

    @property
    def diagnostics(self) -> Mapping[str, object]:
        """Figures of the camera."""
        return self._source.diagnostics

    def frame_sent(self, frame: Frame, header: Any) -> None:
        """Nothing to add to a frame."""

    def close(self) -> None:
        """Undeclare the parameters."""
        self._source.when_settled = int
        self._node.destroy_guard_condition(self._settled)
        self._node.remove_on_set_parameters_callback(self._set)
        self._node.remove_post_set_parameters_callback(self._follow)
        self._undeclare()

    def _given(self) -> dict[str, ControlValue]:
        overrides: Mapping[str, Any] = self._node._parameter_overrides  # noqa: SLF001
        given = {
            name.removeprefix(PREFIX): item.value
            for name, item in overrides.items()
            if name.startswith(PREFIX)
        }
        for name in given:
            if name not in self._controls:
                known = ", ".join(self._controls) or "none"
                msg = (
                    f"{self._source.name}: parameter {PREFIX}{name}: found no such control, "
                    f"expected one of: {known}"
                )
                raise InputError(msg)
        return given

    def _declare(self) -> None:
        for name, value in self._source.controls().values().items():
            control = self._controls[name]
            declare_checked(self._node, PREFIX + name, value, _descriptor(control, value))
            self._declared.append(PREFIX + name)

    def _undeclare(self) -> None:
        for name in self._declared:
            if self._node.has_parameter(name):
                self._node.undeclare_parameter(name)
        self._declared.clear()

    def _set(self, parameters: list[Parameter[Any]]) -> SetParametersResult:
        values = {
            item.name.removeprefix(PREFIX): item.value
            for item in parameters
            if item.name in self._declared
        }
        if values and not self._following:
            try:
                self._source.set_controls(values)
            except FrameSourceError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _report_settled(self) -> None:
        refused, before = self._source.refused_controls, self._refused
        self._refused = refused
        if refused and refused != before:
            self._node.get_logger().warning(f"{self._source.name}: {refused}")
        self._follow([])

    def _follow(self, _parameters: list[Parameter[Any]]) -> None:
        """Let the parameters show what the camera made of it: one control may change others."""
        if self._following:
            return
        try:
            values = self._source.keep_controls()
        except FrameSourceError:  # unplugged: they stay as they are to be again
            return
        changed = [
            Parameter(PREFIX + name, value=value)
            for name, value in values.items()
            # A camera that was away may have come back with other controls.
            if PREFIX + name in self._declared
            and self._node.get_parameter(PREFIX + name).value != value
        ]
        self._following = True
        try:
            if changed:
                self._node.set_parameters(changed)
        finally:
            self._following = False


def _descriptor(control: Control, value: ControlValue) -> ParameterDescriptor:
    # read_only parameters could not be undeclared; the control refuses by itself.
    fixed = " (set by the camera)" if control.fixed else ""
    descriptor = ParameterDescriptor(description=f"{control.title}, {control.kind.value}{fixed}")
    if control.kind is ControlKind.MENU:
        choices = ", ".join(f"{number}: {text}" for number, text in control.choices)
        descriptor.additional_constraints = f"one of {choices}"
    elif control.kind is ControlKind.TEXT:
        constraints = f"text of {control.low} to {control.high} characters"
        descriptor.additional_constraints = constraints
    elif control.kind is ControlKind.BUTTON:
        descriptor.additional_constraints = "true presses the button"
    if control.kind is ControlKind.INTEGER and control.low <= int(value) <= control.high:
        limits = IntegerRange(from_value=control.low, to_value=control.high)
        # A camera may start at a value that is on none of its own steps.
        on_step = (int(value) - control.low) % max(control.step, 1) == 0
        limits.step = control.step if on_step else 0
        descriptor.integer_range = [limits]
    return descriptor
