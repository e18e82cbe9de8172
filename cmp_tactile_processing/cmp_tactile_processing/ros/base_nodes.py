"""What nodes have in common: reports, guarded callbacks, QoS, the sensor, frames that wait."""

from __future__ import annotations

import traceback
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Generic, TypeVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.task import Future
from rclpy.timer import Timer
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from cmp_tactile_processing.errors import CmpTactileError, Finding
from cmp_tactile_processing.ros.diagnostics import (
    InputWatch,
    StageDiagnostics,
    Stamp,
    status_message,
    status_name,
    summary,
)
from cmp_tactile_processing.ros.messages.reading import stamp_ns
from cmp_tactile_processing.ros.parameters import (
    SensorParameters,
    declare_parameters,
    unknown_overrides,
    why_refused,
)
from cmp_tactile_processing.ros.wiring import Finish, Input, LazyResult, Output, WiredNode
from cmp_tactile_processing.sensor.description import load_sensor

SERVICE_QOS = QoSProfile(depth=1000)
"""As that of parameters: of more requests at once than the 10 of ROS's default the rest is lost,
and whoever asked waits without end."""
DIAGNOSTICS_PERIOD_S = 1.0

Frame = TypeVar("Frame")

RESULT_DEPTH = 10
IMAGE_DEPTH = 5
# A second of frames at 20 Hz: a stage may be slow for a while before it loses one.
INPUT_DEPTH = 20
WARNING_PERIOD_S = 5.0
RELIABLE_INPUT = "reliable_input"


def latched_qos(depth: int = 1) -> QoSProfile:
    """For what late subscribers must get too.  A new one: rclpy writes overrides into it."""
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class ReportingNode(WiredNode, ABC):
    """Stands before Node or LifecycleNode among the bases; calls `start_reporting` when set up."""

    @abstractmethod
    def _status(self) -> DiagnosticStatus:
        """How the node is, with the figures since the last call; made by `status_of`."""

    def start_reporting(self, also_to: Sequence[Publisher[Any]] = ()) -> None:
        """Report on /diagnostics once a second from now on.

        also_to: publishers of DiagnosticStatus that get every status too.
        """
        self._also_to = also_to
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_steady_timer(DIAGNOSTICS_PERIOD_S, self.report)

    def report(self) -> None:
        """Report now."""
        status = self._status()
        for publisher in self._also_to:
            publisher.publish(status)
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics_publisher.publish(message)

    def status_of(
        self,
        hardware_id: str,
        values: Mapping[str, object],
        findings: Iterable[Finding],
        otherwise: str,
    ) -> DiagnosticStatus:
        """A status with these figures and findings; otherwise: the message where none is found."""
        return status_message(status_name(self), hardware_id, summary(findings, otherwise), values)

    def warn_of_unknown_parameters(self, *but: str) -> None:
        """Of those given at the start that the node has not, by now; but: beginnings of names."""
        for text in unknown_overrides(self):
            if not text.startswith(but):
                self.get_logger().warning(f"{text} (given at the start; it has no effect)")

    @contextmanager
    def destroyed_on_error(self) -> Iterator[None]:
        """Within it, an error also destroys the node, which nobody has yet."""
        try:
            yield
        except BaseException:
            self.destroy_node()
            raise

    def set_parameters_atomically(
        self, parameter_list: list[Parameter[Any]]
    ) -> SetParametersResult:
        """As Node's; the services of the node set parameters by this."""
        for reason in (why_refused(self, item) for item in parameter_list):
            if reason:
                return SetParametersResult(successful=False, reason=reason)
        return super().set_parameters_atomically(parameter_list)

    def create_steady_timer(
        self, period_s: float, callback: Callable[[], None], *, autostart: bool = True
    ) -> Timer:
        """A timer that goes on while a simulation or a recording, and its clock, are paused."""
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        return self.create_timer(period_s, callback, clock=steady, autostart=autostart)

    def create_service(self, *args: Any, **kwargs: Any) -> Any:
        """As Node's."""
        kwargs.setdefault("qos_profile", SERVICE_QOS)
        return super().create_service(*args, **kwargs)


Wanted = tuple[int, float, str]
"""Number of frames, longest wait for them in s, and the topics that they come from."""
Answer = Callable[[bool, str], None]
"""Answers a request by success and explanation; a second time changes nothing."""


class FrameService(Generic[Frame]):
    """A Trigger service that collects frames, one request at a time.

    name: the service's; busy: the answer while another request is open; before: what is to be done
    first, it returns why it failed.
    """

    def __init__(
        self,
        node: ReportingNode,
        name: str,
        busy: str,
        wanted: Callable[[], Wanted],
        before: Callable[[], Awaitable[str]] | None = None,
    ) -> None:
        self._node, self._busy, self._wanted = node, busy, wanted
        self._before, self._asked, self._count = before, False, 0
        self._frames: list[Frame] | None = None
        self._finish: Answer = lambda *_: None
        # A group of its own: the service waits for frames, which must come in meanwhile.
        node.create_service(Trigger, name, self._answer, callback_group=ReentrantCallbackGroup())

    @property
    def is_open(self) -> bool:
        """Whether frames are being collected."""
        return self._frames is not None

    def take(self, frame: Frame) -> tuple[list[Frame], Answer] | None:
        """Add a frame; all of them, and what is to answer the request, if it was the last one."""
        frames, finish = self._frames, self._finish
        if frames is None:
            return None
        frames.append(frame)
        if len(frames) < self._count:
            return None
        self._frames = None
        return frames, finish

    async def _answer(
        self, _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        if self._asked:
            response.success, response.message = False, self._busy
            return response
        self._asked = True
        try:
            reason = await self._before() if self._before is not None else ""
            found = (False, reason) if reason else await self._collect()
        finally:
            self._asked = False
        response.success, response.message = found
        return response

    async def _collect(self) -> tuple[bool, str]:
        """Success and explanation, once the frames have come or the time is up."""
        self._count, timeout_s, topics = self._wanted()
        frames: list[Frame] = []
        outcome: Future[tuple[bool, str]] = Future()

        def finish(success: bool, explanation: str) -> None:
            if not outcome.done():
                outcome.set_result((success, explanation))

        def give_up() -> None:
            found = f"found {len(frames)} frames on {topics} in {timeout_s:g} s"
            finish(False, f"{found}, expected {self._count}")

        self._finish, self._frames = finish, frames
        executor = self._node.executor
        if executor is not None:
            # The last frame comes on another thread, which the executor does not see.
            outcome.add_done_callback(lambda _: executor.wake())
        timer = self._node.create_steady_timer(timeout_s, give_up)
        found = await outcome
        self._node.destroy_timer(timer)
        if self._frames is frames:
            self._frames = None
        return found


class InputNode(ReportingNode):
    """A node around one stage; subclasses build stage, publishers and subscriptions in `_set_up`.

    Keyword arguments are those of rclpy.node.Node.  Raises CmpTactileError, with the node
    destroyed, where parameters cannot be used.
    """

    default_name: str
    hardware_id = ""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__(self.default_name, **node_kwargs)
        with self.destroyed_on_error():
            self.diagnostics = StageDiagnostics()
            self._find_hardware()
            self._set_up()
            self.start_reporting()
            self.warn_of_unknown_parameters()

    def _find_hardware(self) -> None:
        """What the node belongs to; none but for a StageNode."""

    @abstractmethod
    def _set_up(self) -> None:
        """Declare parameters, build the stage, create publishers and subscriptions."""

    def add_publisher(
        self, message_type: type, topic: str, depth: int = RESULT_DEPTH, *, latched: bool = False
    ) -> Publisher[Any]:
        """A reliable publisher; latched: late subscribers get the last `depth` messages."""
        return self.create_publisher(
            message_type,
            topic,
            latched_qos(depth) if latched else QoSProfile(depth=depth),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def add_result(
        self,
        message_type: type,
        topic: str,
        to_msg: Callable[[Any, Any], Any],
        depth: int = RESULT_DEPTH,
    ) -> Output:
        """What the stage makes of each frame; to_msg: makes a message of it and a header."""
        return self.add_output(self.add_publisher(message_type, topic, depth), to_msg)

    def add_input(  # noqa: PLR0913  each has a default
        self,
        message_type: type,
        topic: str,
        callback: Callable[[Any, Header], None],
        from_msg: Callable[[Any], Any],
        *,
        begin: Callable[[Any], Any] = lambda value: value,
        needs_all: Callable[[], bool] = lambda: True,
        reliable: bool = True,
        newest: bool = False,
    ) -> None:
        """Call back with what comes on a topic.

        Whatever that causes is logged and counted, never raised.
        callback: takes a value, as `from_msg` reads it or a stage of the same container made it,
        and the header.  begin: does the first part of the work, on a thread of its own where two
        views are at work; the callback takes what it returns.  needs_all: whether the value is to
        be whole now, see `Output.is_wanted`.  newest: one frame waits, and a newer one takes its
        place.
        """
        name = self.resolve_topic_name(topic)

        def begin_guarded(given: LazyResult) -> Finish:
            self.diagnostics.frames_in += 1
            header = given.header
            watch.take(given.info)
            if watch.stamps.take(stamp_ns(header.stamp)) is Stamp.BACK:
                self._run_guarded(name, self._on_time_back, topic)
            prepared: list[Any] = []
            self._run_guarded(name, lambda: prepared.append(begin(given.value)))
            return lambda: (
                self._run_guarded(name, callback, *prepared, header) if prepared else None
            )

        policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        end = Input(begin_guarded, from_msg, needs_all)
        watch = InputWatch(end, newest=newest)
        self.connect_input(
            end,
            message_type,
            topic,
            QoSProfile(depth=1 if newest else INPUT_DEPTH, reliability=policy),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=partial(self._on_incompatible_qos, name)
            ),
        )
        self.diagnostics.inputs.append(watch)

    def _on_incompatible_qos(self, name: str, event: Any) -> None:
        kind = qos_policy_name_from_kind(event.last_policy_kind)
        text = f"{name}: a publisher offers another QoS ({kind}), no message of it is received"
        if self.has_parameter(RELIABLE_INPUT):
            text += f"; for a camera that publishes best effort, set {RELIABLE_INPUT} to false"
        self.get_logger().warning(text)

    def _on_time_back(self, topic: str) -> None:
        if not self.diagnostics.started_again:
            text = "time went back: the node starts again; the diagnostics count later jumps"
            self.get_logger().info(f"{self.resolve_topic_name(topic)}: {text}")
        self.diagnostics.started_again += 1
        self._start_again(topic)

    def _start_again(self, topic: str) -> None:
        """Forget what earlier frames of an input showed, as time went back; for subclasses."""

    def frame_out(self, header: Header) -> None:
        """Count a published result whose camera frame had the stamp of that header."""
        now = self.get_clock().now().nanoseconds
        self.diagnostics.sent.sent((now - stamp_ns(header.stamp)) * 1e-9)

    def warn(self, topic: str, text: str) -> None:
        """Log a warning about a topic's messages, one in five seconds at most."""
        message = f"{topic}: {text}"
        self.get_logger().warning(message, throttle_duration_sec=WARNING_PERIOD_S)

    def _update_diagnostics(self) -> None:
        """Refresh `diagnostics.extra` before a report; for subclasses."""

    def _run_guarded(self, topic: str, callback: Callable[..., None], *arguments: Any) -> None:
        try:
            callback(*arguments)
        except CmpTactileError as error:
            self.diagnostics.bad_frame(f"{topic}: {error}")
            self.warn(topic, str(error))
        except Exception as error:  # noqa: BLE001  one frame must not end the node
            if not self.context.ok():
                return
            self.diagnostics.bad_frame(f"{topic}: {error!r}")
            self.get_logger().error(f"{topic}: unexpected error\n{traceback.format_exc()}")

    def _status(self) -> DiagnosticStatus:
        self._update_diagnostics()
        topics = [watch.end.subscription.topic_name for watch in self.diagnostics.inputs]
        self.diagnostics.unpublished = [item for item in topics if not self.count_publishers(item)]
        values, findings = self.diagnostics.report()
        return self.status_of(self.hardware_id, values, findings, "running")


class StageNode(InputNode):
    """An InputNode of one sensor; raises CmpTactileError also for its description."""

    def _find_hardware(self) -> None:
        own = declare_parameters(self, SensorParameters())
        self.sensor = load_sensor(own.sensor_description, own.sensor_name)
        self.hardware_id = self.sensor.ros_name
