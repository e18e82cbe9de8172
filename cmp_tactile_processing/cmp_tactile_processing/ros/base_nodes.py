"""What nodes have in common: parameters, reports, guarded callbacks, QoS, the sensor of a stage."""

from __future__ import annotations

import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.event_handler import (
    PublisherEventCallbacks,
    SubscriptionEventCallbacks,
    UnsupportedEventTypeError,
)
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.utilities import get_rmw_implementation_identifier
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.ros.diagnostics.connections import mixed, unconnected, unpublished
from cmp_tactile_processing.ros.diagnostics.frame_watch import InputWatch, Stamp
from cmp_tactile_processing.ros.diagnostics.namesakes import Namesakes, this_process
from cmp_tactile_processing.ros.diagnostics.stage import StageDiagnostics
from cmp_tactile_processing.ros.diagnostics.status import (
    DiagnosticsReporter,
    Finding,
    status_message,
    status_name,
    summary,
)
from cmp_tactile_processing.ros.diagnostics.thresholds import SECTION, DiagnosticsParameters
from cmp_tactile_processing.ros.messages.conversions import with_header
from cmp_tactile_processing.ros.messages.reading import stamp_ns
from cmp_tactile_processing.ros.parameters import (
    ExplainingNode,
    SensorParameters,
    StageParameters,
    declare_parameters,
    unknown_overrides,
)
from cmp_tactile_processing.ros.wiring import Finish, Given, Input, Output, WiredNode
from cmp_tactile_processing.sensor.description import load_sensor

SERVICE_QOS = QoSProfile(depth=1000)
"""As that of parameters: of more requests at once than the 10 of ROS's default the rest is lost,
and whoever asked waits without end."""


class ReportingNode(ExplainingNode, WiredNode, ABC):
    """Stands before Node or LifecycleNode among the bases; calls `start_reporting` when set up.

    thresholds: of its figures, parameters `diagnostics.*` that may change while it runs.
    Its ends have none of rclpy's event handlers: those of a view splitter make each wake-up of its
    executor take 0.4 in place of 0.25 ms.
    """

    thresholds = DiagnosticsParameters()
    reporter: DiagnosticsReporter
    _namesakes: Namesakes
    _reported_namesake = ""
    _wrong_before: Sequence[str] = ()

    @abstractmethod
    def _status(self) -> DiagnosticStatus:
        """How the node is, with the figures since the last call; made by `status_of`."""

    def start_reporting(self, also_to: Sequence[Publisher[Any]] = ()) -> None:
        """Declare the thresholds and report once a second from now on.

        also_to: publishers that get every status too.
        """
        limits = StageParameters(self, DiagnosticsParameters(), self._use_thresholds, SECTION)
        self._use_thresholds(limits.value)
        self._namesakes = Namesakes(self)
        self.reporter = DiagnosticsReporter(self, self._status, also_to)

    def status_of(
        self,
        hardware_id: str,
        values: Mapping[str, object],
        findings: Iterable[Finding],
        otherwise: str,
    ) -> DiagnosticStatus:
        """A status with these figures and findings, and with ends that are not connected.

        otherwise: the message where nothing is found.
        """
        mixtures = (mixed(self, topic) for topic in self._take_mixed_topics())
        wrong = [*unconnected(self), *filter(None, mixtures)]
        for text in wrong:
            if text not in self._wrong_before:
                self.get_logger().warning(text)
        self._wrong_before = wrong
        found = [*findings, *(Finding(DiagnosticStatus.WARN, text) for text in wrong)]
        values = {**values, "wrong connections": "; ".join(wrong) or "none"}
        return status_message(status_name(self), hardware_id, summary(found, otherwise), values)

    def warn_of_unknown_parameters(self, *but: str) -> None:
        """Of those given at the start that the node has not, by now; but: beginnings of names."""
        for text in unknown_overrides(self):
            if not text.startswith(but):
                self.get_logger().warning(f"{text} (given at the start; it has no effect)")

    def name_finding(self) -> Finding:
        """Another process with a node of this name.

        For nodes that publish frames, so that one line reports two sensors of one name.
        """
        name = self.get_fully_qualified_name()
        process, before = self._namesakes.process_of(name), self._reported_namesake
        self._reported_namesake = process
        text = (
            f"{name} runs in process {process} and here in process {this_process()}: the frames "
            "of two sensors with one name are mixed; end one of them, or give it another "
            "namespace"
        )
        if process and process != before:
            self.get_logger().error(text)
        return Finding(DiagnosticStatus.ERROR, text if process else "")

    @contextmanager
    def destroyed_on_error(self) -> Iterator[None]:
        """Within it, an error also destroys the node, which nobody has yet."""
        try:
            yield
        except BaseException:
            self.destroy_node()
            raise

    def create_publisher(self, *args: Any, **kwargs: Any) -> Any:
        """As Node's."""
        kwargs.setdefault("event_callbacks", PublisherEventCallbacks(use_default_callbacks=False))
        return super().create_publisher(*args, **kwargs)

    def create_lifecycle_publisher(self, *args: Any, **kwargs: Any) -> Any:
        """As LifecycleNode's, which passes over `create_publisher`."""
        made: Any = super()
        kwargs.setdefault("event_callbacks", PublisherEventCallbacks(use_default_callbacks=False))
        return made.create_lifecycle_publisher(*args, **kwargs)

    def create_subscription(self, *args: Any, **kwargs: Any) -> Any:
        """As Node's."""
        none = SubscriptionEventCallbacks(use_default_callbacks=False)
        kwargs.setdefault("event_callbacks", none)
        return super().create_subscription(*args, **kwargs)

    def connect_counting(
        self,
        end: Input,
        message_type: type,
        topic: str,
        qos: QoSProfile,
        on_lost: Callable[[int], None] | None,
        **kwargs: Any,
    ) -> None:
        """As `connect_input`; on_lost: takes how many messages more were lost, if ROS reports it.

        Not every middleware does.
        """
        attempts = (lambda event: on_lost(event.total_count_change)) if on_lost else None, None
        for message_lost in attempts:
            events = SubscriptionEventCallbacks(
                message_lost=message_lost, use_default_callbacks=False
            )
            with suppress(UnsupportedEventTypeError):
                self.connect_input(end, message_type, topic, qos, event_callbacks=events, **kwargs)
                return

    def create_service(self, *args: Any, **kwargs: Any) -> Any:
        """As Node's."""
        kwargs.setdefault("qos_profile", SERVICE_QOS)
        return super().create_service(*args, **kwargs)

    def _use_thresholds(self, thresholds: DiagnosticsParameters) -> None:
        self.thresholds = thresholds

    def _take_mixed_topics(self) -> list[str]:
        """Inputs with messages of several publishers by turns since the last call."""
        return []


class CameraInfoPublisher:
    """Publishes calibration when it changes, and beside each image while somebody subscribes.

    image_transport and image_pipeline match the two by their stamps.  On a latched topic late
    subscribers get it at once.
    """

    def __init__(self, publisher: Publisher[Any]) -> None:
        self._publisher, self._info = publisher, CameraInfo()

    def change(self, info: CameraInfo) -> None:
        """Publish another calibration, now and from now on."""
        self._info = info
        self._publisher.publish(info)

    def publish(self, header: Header) -> None:
        """Publish it with the header of an image."""
        if self._publisher.get_subscription_count():
            self._publisher.publish(with_header(self._info, header))


RESULT_DEPTH = 10
IMAGE_DEPTH = 5
# A second of frames at 20 Hz: a stage may be slow for a while before it loses one.
INPUT_DEPTH = 20
WARNING_PERIOD_S = 5.0
# Their messages are numbered: that shows also what was pushed out of a full queue.
NUMBERING_RMW = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")


class StageNode(ReportingNode):
    """A node around one stage; subclasses build stage, publishers and subscriptions in `_set_up`.

    Keyword arguments are those of rclpy.node.Node.  Raises CmpTactileError, with the node
    destroyed, where sensor description or parameters cannot be used.
    """

    default_name: str

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__(self.default_name, **node_kwargs)
        with self.destroyed_on_error():
            self.diagnostics = StageDiagnostics()
            own = declare_parameters(self, SensorParameters())
            self.sensor = load_sensor(own.sensor_description, own.sensor_name)
            self._set_up()
            self.start_reporting()
            self.warn_of_unknown_parameters()

    @abstractmethod
    def _set_up(self) -> None:
        """Declare parameters, build the stage, create publishers and subscriptions."""

    def add_publisher(
        self, message_type: type, topic: str, depth: int = RESULT_DEPTH, *, latched: bool = False
    ) -> Publisher[Any]:
        """A reliable publisher; latched: late subscribers get the last `depth` messages."""
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
        return self.create_publisher(
            message_type,
            topic,
            qos,
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
        watch = InputWatch(name, newest=newest)

        def begin_guarded(given: Given) -> Finish:
            self.diagnostics.frame_in()
            header = given.header
            if watch.take_message(stamp_ns(header.stamp), given.info) is Stamp.BACK:
                self._run_guarded(name, self._on_time_back, topic)
            begun: list[Any] = []
            self._run_guarded(name, lambda: begun.append(begin(given.value)))
            return lambda: self._run_guarded(name, callback, *begun, header) if begun else None

        policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        numbered = get_rmw_implementation_identifier() in NUMBERING_RMW
        watch.end = Input(begin_guarded, from_msg, needs_all)
        self.connect_counting(
            watch.end,
            message_type,
            topic,
            QoSProfile(depth=1 if newest else INPUT_DEPTH, reliability=policy),
            None if numbered else watch.add_lost,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self.diagnostics.inputs.append(watch)

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
        self.diagnostics.frame_out((now - stamp_ns(header.stamp)) * 1e-9)

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

    def _take_mixed_topics(self) -> list[str]:
        return [watch.topic for watch in self.diagnostics.inputs if watch.take_mixed()]

    def _use_thresholds(self, thresholds: DiagnosticsParameters) -> None:
        super()._use_thresholds(thresholds)
        self.diagnostics.thresholds = thresholds

    def _status(self) -> DiagnosticStatus:
        self._update_diagnostics()
        self.diagnostics.unpublished = unpublished(self)
        period = self.diagnostics.report()
        otherwise = self.diagnostics.note or "running"
        return self.status_of(self.sensor.ros_name, period.values, period.findings, otherwise)
