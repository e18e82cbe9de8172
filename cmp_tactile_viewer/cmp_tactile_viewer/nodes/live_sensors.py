"""What runs on topics as a source of snapshots: subscribed to only while somebody looks."""

from __future__ import annotations

import math
import struct
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker

from cmp_tactile_msgs.msg import ForceField, GraspState, Grid, Surface
from cmp_tactile_processing.drawing import grasp_line
from cmp_tactile_processing.errors import CmpTactileError, Finding, Severity
from cmp_tactile_processing.image.encodings import BitDepth
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.ros.base_nodes import latched_qos
from cmp_tactile_processing.ros.messages.making import MARKER_TOPIC, gel_frame
from cmp_tactile_processing.ros.services import answer_of
from cmp_tactile_viewer.moving_scene import MovingScene
from cmp_tactile_viewer.nodes.controls import RecordingButton, RunningSensor, node_settings
from cmp_tactile_viewer.snapshot import (
    Action,
    Audience,
    Playback,
    Pose,
    ResultReader,
    Setting,
    Snapshot,
    Touch,
)

# Encapsulation and stamp, with which every message begins.
HEADER = struct.Struct("<4xiI")
# Frames that may be on their way through the stages at once; an image is a megabyte.
KEPT = 12
# The rate is that of so many frames.
RATE_FRAMES = 60
# Of camera images, which the page draws less often than surfaces, somewhat more than it draws.
RATE_HZ, IMAGE_HZ, HEALTH_HZ = 30.0, 15.0, 1.0
# Transforms of each frame that are kept: surfaces come later than the poses of their moment.
TRANSFORMS_KEPT, TRANSFORMS_DEPTH = 200, 100
# Fields of a snapshot that every one has; images and grids are not drawn so often.
MEASURED = ("surface", "force")
# A topic is silent after that time, and a node that has not reported for so long is left out.
SILENT_S, REPORT_AGE_S = 2.0, 5.0
AT_REST = "nothing may touch the gel"
# Label, service, hint, and the view without which a sensor has no such service.
TRIGGERS = (
    (
        "zero",
        "stereo_triangulator/set_reference",
        f"Set displacement and force to zero; {AT_REST}",
        "",
    ),
    *(
        (
            f"inspect {view} print",
            f"{view}_gridline_tracker/inspect_print",
            f"Look for flaws of the print; {AT_REST}",
            view,
        )
        for view in ("left", "right")
    ),
    (
        "reset indenter",
        "indenter/reset",
        "Play the scene of the simulated sensor from the start",
        "",
    ),
)


class Polled(CallbackGroup):
    """Of subscriptions that no executor waits for: to be woken costs more than the message."""

    def can_execute(self, _entity: object) -> bool:
        """Never."""
        return False

    def beginning_execution(self, _entity: object) -> bool:
        """Never."""
        return False

    def ending_execution(self, _entity: object) -> None:
        """Never begun."""


class PolledTopic:
    """The newest messages of a topic as bytes, by stamp: most are never looked at.

    name: as users know it.  field: what it gives.  kept: messages by stamp, ns, the newest last.
    last_s: when the newest came, by time.monotonic().  sent_ns: when it was sent, time.time_ns().
    """

    def __init__(self, name: str, message_type: Any, field: str) -> None:
        self.name, self.message_type, self.field = name, message_type, field
        self.kept: OrderedDict[int, bytes] = OrderedDict()
        self.stamps: deque[int] = deque(maxlen=RATE_FRAMES)
        self.last_s, self.sent_ns = time.monotonic(), 0
        self._subscription: Any = None

    def subscribe(self, node: Node, group: CallbackGroup) -> None:
        """Begin; again, nothing happens."""
        if self._subscription is not None:
            return
        self.kept.clear()
        self.stamps.clear()
        self.last_s = time.monotonic()
        self._subscription = node.create_subscription(
            self.message_type,
            self.name,
            lambda _: None,
            QoSProfile(depth=KEPT),
            callback_group=group,
            raw=True,
        )

    def unsubscribe(self, node: Node) -> None:
        """Until `subscribe`."""
        if self._subscription is not None:
            node.destroy_subscription(self._subscription)
            self._subscription = None

    def take(self) -> None:
        """All that came since."""
        if self._subscription is None:
            return
        handle = self._subscription.handle
        with handle:
            while (taken := handle.take_message(self.message_type, True)) is not None:
                self._keep(*taken)

    @property
    def newest(self) -> int:
        """Its last stamp; -1 before the first."""
        return next(reversed(self.kept), -1)

    @property
    def rate_hz(self) -> float:
        """Of the last messages; NaN where there is none yet."""
        span_ns = self.stamps[-1] - self.stamps[0] if self.stamps else 0
        return (len(self.stamps) - 1) * NS_PER_S / span_ns if span_ns > 0 else math.nan

    def _keep(self, data: bytes, info: Mapping[str, int]) -> None:
        seconds, nanoseconds = HEADER.unpack_from(data)
        stamp_ns = seconds * NS_PER_S + nanoseconds
        if stamp_ns < self.newest:
            # A recording begins again.
            self.stamps.clear()
        self.stamps.append(stamp_ns)
        self.kept[stamp_ns] = data
        self.kept.move_to_end(stamp_ns)
        self.last_s, self.sent_ns = time.monotonic(), info["source_timestamp"]
        while len(self.kept) > KEPT:
            self.kept.popitem(last=False)


class _Watched:
    """The topics of one sensor."""

    def __init__(
        self, node: Node, sensor: RunningSensor, problem: Callable[[str, str], None]
    ) -> None:
        self._node, self.sensor, self._problem = node, sensor, problem
        depth = BitDepth(f"{sensor.namespace}/image_raw", node.get_logger().info)
        self._reader = ResultReader(sensor.shown.description, depth)
        self.name, self.views = sensor.shown.name, tuple(self._reader.placements)
        # From the end of the chain to its beginning: the last one that speaks gives the stamps.
        kinds: dict[str, tuple[Any, str]] = {
            "force_field": (ForceField, "force"),
            "surface": (Surface, "surface"),
            **{f"{view}/grid": (Grid, view) for view in self.views},
            "image_raw": (Image, "frame"),
        }
        self.topics = []
        for short, (kind, field) in kinds.items():
            name = f"{sensor.namespace}/{short}"
            self.topics.append(PolledTopic(name, kind, field))
        # Small, and of every frame: for rate and latency.
        wrench = f"{sensor.namespace}/wrench"
        self._wrench = PolledTopic(wrench, WrenchStamped, "wrench")
        self._group = Polled()
        self._shown: tuple[str, int] | None = None
        self._image_s, self._imaged_ns = 0.0, -1

    def subscribe(self) -> None:
        """Also again: nothing happens then."""
        for topic in (*self.topics, self._wrench):
            topic.subscribe(self._node, self._group)

    def unsubscribe(self) -> None:
        for topic in (*self.topics, self._wrench):
            topic.unsubscribe(self._node)
        self._shown, self._imaged_ns = None, -1

    def newest(self) -> Snapshot | None:
        """The newest frame that went as far as any does; None where it is on show already."""
        for topic in (*self.topics, self._wrench):
            topic.take()
        now_s = time.monotonic()
        speaking = [item for item in self.topics if item.kept and now_s - item.last_s < SILENT_S]
        last = next(iter(speaking), None)
        # A frame whose force comes late is shown without, and once more with it.
        if last is None or (last.name, last.newest) == self._shown:
            return None
        stamp_ns = last.newest
        self._shown = (last.name, stamp_ns)
        values = {
            topic.field: self._value(topic, topic.kept[stamp_ns])
            for topic in self.topics
            if topic.field in MEASURED and stamp_ns in topic.kept
        }
        if now_s - self._image_s >= 1 / IMAGE_HZ:
            self._image_s = now_s
            values |= self._image([item for item in speaking if item.field not in MEASURED])
        rate_hz = self._wrench.rate_hz if self._wrench.kept else last.rate_hz
        return Snapshot(stamp_ns, latency_s=self._latency_s(), rate_hz=rate_hz, **values)

    def _image(self, topics: Sequence[PolledTopic]) -> dict[str, Any]:
        """Image and grids of the newest frame of which all have come.

        An image is large and may come later than the force of its frame.
        """
        stamps = reversed(topics[0].kept) if topics else ()
        newest = (stamp for stamp in stamps if all(stamp in item.kept for item in topics))
        stamp_ns = next(newest, None)
        if stamp_ns is None or stamp_ns == self._imaged_ns:
            return {}
        self._imaged_ns = stamp_ns
        return {item.field: self._value(item, item.kept[stamp_ns]) for item in topics}

    def _latency_s(self) -> float:
        """From the stamp of the newest wrench until it was sent, on the clock of the stamps."""
        if not self._wrench.kept:
            return math.nan
        ago_ns = time.time_ns() - self._wrench.sent_ns
        return (self._node.get_clock().now().nanoseconds - ago_ns - self._wrench.newest) * 1e-9

    def _value(self, topic: PolledTopic, data: bytes) -> Any:
        """What a message says; None, and a line of health, where it cannot be used."""
        try:
            message = deserialize_message(data, topic.message_type)
            return self._reader.value(topic.field, message)
        except CmpTactileError as error:
            self._problem(topic.name, str(error))
            return None

    def silence(self) -> Iterator[Finding]:
        """A line for the first topic of the chain on which nothing comes."""
        now_s = time.monotonic()
        for topic in reversed(self.topics):
            if now_s - topic.last_s < SILENT_S:
                continue
            published = self._node.count_publishers(topic.name)
            why = "it has a publisher, but no message comes" if published else "nothing published"
            text = f"waiting for {topic.name}: {why}; is the sensor running?"
            yield Finding(Severity.WARNING, text, about="topic")
            return


class LiveSensors:
    """A `Source` of sensors that run; its node has to be spun on another thread than the page's."""

    playback: Playback | None = None

    def __init__(
        self,
        node: Node,
        sensors: Sequence[RunningSensor],
        rate_hz: float = RATE_HZ,
        grasp: str = "",
        scene_frame: str = "",
    ) -> None:
        """rate_hz: snapshots a second at most.  grasp: topic of a GraspState; empty for none.

        scene_frame: in which tf has poses; empty for none.
        """
        self._node, self._grasp_topic = node, grasp
        self._grasp: tuple[float, Any] | None = None
        self._scene = MovingScene(scene_frame, TRANSFORMS_KEPT)
        self._audience: Audience | None = None
        self._is_looked_at = False
        self.sensors = tuple(sensor.shown for sensor in sensors)
        self._watched = [_Watched(node, sensor, self._note_problem) for sensor in sensors]
        self._reports: dict[str, tuple[float, DiagnosticStatus]] = {}
        self._problems: dict[str, tuple[float, str]] = {}
        self._others: list[Any] = []
        self._targets: dict[str, Any] = {}
        self._touches = {item.name: self._touch_of(item) for item in self._watched}
        self._recordings = {item.name: RecordingButton(node, item.sensor) for item in self._watched}
        # Steady: a paused simulation clock must not stop them.
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._timers = [
            node.create_timer(1 / rate_hz, self._show, clock=clock, autostart=False),
            node.create_timer(1 / HEALTH_HZ, self._show_health, clock=clock, autostart=False),
        ]
        # What the page asks for is done on the executor's thread.
        self._turn = node.create_guard_condition(self._turned)

    def actions(self) -> Mapping[str, tuple[Action, ...]]:
        """Services of the nodes, and a recording."""
        return {
            item.name: (
                *(
                    Action(label, hint, partial(self._call, f"{item.sensor.namespace}/{service}"))
                    for label, service, hint, view in TRIGGERS
                    if not view or view in item.views
                ),
                Action(
                    "record",
                    "Start or stop a recording",
                    self._recordings[item.name].press,
                    self._recordings[item.name].state,
                ),
            )
            for item in self._watched
        }

    def settings(self, sensor: str) -> tuple[Setting, ...]:
        """Parameters of the sensor's nodes; CmpTactileError where none answers."""
        item = next(item for item in self._watched if item.name == sensor)
        return node_settings(self._node, item.sensor.namespace, item.views)

    def touches(self) -> Mapping[str, Touch]:
        """The indenter of each; that of a real sensor has no pose."""
        return self._touches

    def start(self, audience: Audience) -> None:
        """Subscribe."""
        self._audience = audience
        self._look(True)

    def pause(self) -> None:
        """Unsubscribe: the nodes then make no messages for the page."""
        self._look(False)

    def close(self) -> None:
        """End the recordings."""
        for recording in self._recordings.values():
            recording.close()

    def _look(self, looked_at: bool) -> None:
        self._is_looked_at = looked_at
        with suppress(InvalidHandle):  # the last browser may leave after the node has gone
            self._turn.trigger()

    def _turned(self) -> None:
        for item in self._watched:
            item.unsubscribe()
        for subscription in self._others:
            self._node.destroy_subscription(subscription)
        self._others.clear()
        for timer in self._timers:
            timer.cancel()
        if not self._is_looked_at:
            return
        for item in self._watched:
            item.subscribe()
            self._others.append(
                self._node.create_subscription(
                    PoseStamped,
                    f"{item.sensor.namespace}/indenter/pose",
                    partial(self._on_pose, self._touches[item.name]),
                    1,
                )
            )
        self._others.append(
            self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_report, 100)
        )
        if self._grasp_topic:
            self._others.append(
                self._node.create_subscription(GraspState, self._grasp_topic, self._on_grasp, 1)
            )
        if self._scene.frame:
            self._watch_scene()
        for timer in self._timers:
            timer.reset()

    def _watch_scene(self) -> None:
        create, transforms = self._node.create_subscription, self._scene.take_transforms
        latched = latched_qos(TRANSFORMS_DEPTH)
        self._others += [
            create(TFMessage, "/tf", transforms, TRANSFORMS_DEPTH),
            create(TFMessage, "/tf_static", transforms, latched),
            create(Marker, MARKER_TOPIC, self._scene.take_marker, latched_qos()),
        ]

    def _show(self) -> None:
        if self._audience is None:
            return
        for item in self._watched:
            snapshot = item.newest()
            if snapshot is not None:
                placed = self._scene.placed(snapshot, item.sensor.shown.description)
                self._audience.show(item.name, placed)

    def _note_problem(self, topic: str, text: str) -> None:
        self._problems[topic] = (time.monotonic(), text)

    def _on_report(self, message: DiagnosticArray) -> None:
        now_s = time.monotonic()
        for status in message.status:
            name = f"/{status.name.lstrip('/')}"
            if any(name.startswith(f"{item.sensor.namespace}/") for item in self._watched):
                self._reports[name] = (now_s, status)

    def _show_health(self) -> None:
        if self._audience is None:
            return
        now_s = time.monotonic()
        lines = list(self._held(now_s))
        lines += [line for item in self._watched for line in item.silence()]
        lines += [
            Finding(Severity.WARNING, text, about=topic)
            for topic, (time_s, text) in self._problems.items()
            if now_s - time_s < REPORT_AGE_S
        ]
        lines += self._reported(now_s)
        self._audience.show_health(lines)

    def _on_grasp(self, message: GraspState) -> None:
        self._grasp = time.monotonic(), message

    def _held(self, now_s: float) -> Iterator[Finding]:
        """A line about the grasp, while its state comes."""
        if self._grasp is not None and now_s - self._grasp[0] < SILENT_S:
            state = self._grasp[1]
            severity = Severity.OK if state.usable else Severity.WARNING
            text = grasp_line(state) if state.usable else "the forces of both fingers are not known"
            yield Finding(severity, text, about="grasp")

    def _reported(self, now_s: float) -> Iterator[Finding]:
        """What the nodes report of late; those without trouble are only counted."""
        well = 0
        for name, (time_s, status) in self._reports.items():
            if now_s - time_s >= REPORT_AGE_S:
                continue
            severity = Severity(min(int.from_bytes(status.level, "little"), Severity.ERROR))
            if severity is Severity.OK:
                well += 1
            else:
                yield Finding(severity, status.message, about=name)
        if well:
            yield Finding(Severity.OK, f"{well} reports without problems", about="diagnostics")

    def _touch_of(self, item: _Watched) -> Touch:
        # A publisher that is made when somebody drags would lose the first targets.
        target = self._node.create_publisher(
            PoseStamped, f"{item.sensor.namespace}/indenter/target", 10
        )
        frame = gel_frame(item.sensor.shown.description)

        def move(pose: Pose) -> None:
            message = PoseStamped()
            message.header.frame_id = frame
            message.header.stamp = self._node.get_clock().now().to_msg()
            place, turn = message.pose.position, message.pose.orientation
            place.x, place.y, place.z = pose.position
            turn.w, turn.x, turn.y, turn.z = pose.orientation
            target.publish(message)

        return Touch(move)

    def _on_pose(self, touch: Touch, message: PoseStamped) -> None:
        place, turn = message.pose.position, message.pose.orientation
        touch.pose = Pose((place.x, place.y, place.z), (turn.w, turn.x, turn.y, turn.z))

    def _call(self, service: str) -> str:
        answer = answer_of(self._node, Trigger, service, Trigger.Request())
        if not answer.success:
            raise CmpTactileError(answer.message)
        return str(answer.message) or "done"
