"""Shows a recording: frames that are processed as they are played, or results that were stored."""

from __future__ import annotations

import threading
import time
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from cmp_tactile_driver.bags.reader import COMPRESSED_IMAGE, IMAGE, of_one_sensor
from cmp_tactile_driver.bags.recording import frames_within, is_bag, open_recording_of
from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_driver.bags.timeline import WHOLE, TimeSpan, timeline
from cmp_tactile_driver.sources.capture import Pacer
from cmp_tactile_processing.errors import CmpTactileError, Finding, FrameSourceError, Severity
from cmp_tactile_processing.force.advice import RECORDED_ADVICE, single_flags
from cmp_tactile_processing.image.encodings import COMPRESSED, BitDepth
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.ros.messages import reading
from cmp_tactile_processing.ros.messages.reading import stamp_ns
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_viewer.moving_scene import RecordedScene
from cmp_tactile_viewer.snapshot import (
    Audience,
    PassiveSource,
    Playback,
    Pose,
    ResultReader,
    ShownSensor,
    Snapshot,
    Touch,
)

if TYPE_CHECKING:
    from cmp_tactile_processing.pipeline import Pipeline

POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
# Of a simulated recording, and of a recorded simulated sensor, below the sensor's namespace.
NAMES = ("/truth/indenter_pose", "/indenter/pose")
SURFACE, FORCE_FIELD, GRID = (
    f"cmp_tactile_msgs/msg/{name}" for name in ("Surface", "ForceField", "Grid")
)
# Looks into the recording so far before a place, to find the frame before it; then farther.
BACK_S = 0.5
# Recordings up to this length begin again at their end, as long as nobody says otherwise.
LOOPED_S = 10.0
PREPARING = (
    "preparing the models of optics and gel for the first frame; where nothing was compiled yet, "
    "this takes about a minute"
)
# Frames of several sensors belong to one moment within this time.
SAME_MOMENT_S = 1e-6
# Sensors of which no poses are known stand side by side, so many widths of their gel apart.
SIDE_BY_SIDE = 1.5
# Messages of one frame come within so many others.
MOST_OPEN = 20


class IndenterPoses:
    """The poses of the only indenter in a bag; none where it has none, or several."""

    def __init__(self, storage: BagStorage) -> None:
        """The poses are read when the first of them is asked for."""
        self._storage = storage
        self._topics = [
            topic
            for topic, kind in storage.topics.items()
            if kind == POSE_STAMPED and topic.endswith(NAMES)
        ]

    def __bool__(self) -> bool:
        return len(self._topics) == 1

    def at(self, stamp_ns: int) -> Pose | None:
        """The pose at a moment, the last one before where that has none; None before the first."""
        stamps, poses = self._by_stamp
        index = bisect_right(stamps, stamp_ns)
        return poses[index - 1] if index else None

    @cached_property
    def _by_stamp(self) -> tuple[list[int], list[Pose]]:
        poses: dict[int, Pose] = {}
        # Damaged ones do not matter: the indenter is not what the recording is about.
        for message in self._storage.decoded(self._topics):
            p, q = message.pose.position, message.pose.orientation
            stamp = stamp_ns(message.header.stamp)
            poses[stamp] = Pose((p.x, p.y, p.z), (q.w, q.x, q.y, q.z))
        stamps = sorted(poses)
        return stamps, [poses[stamp] for stamp in stamps]


class Frames(Protocol):
    """The snapshots of a sensor in a recording, from anywhere in it.

    begin_ns: stamp of the first frame.  length_s: from there to the last message.  problem: what of
    it is not as it should be; empty for nothing.
    """

    begin_ns: int
    length_s: float
    problem: str

    def read(self, start_s: float) -> Iterator[tuple[float, Snapshot]]:
        """Snapshots and their times since the first frame, s, from a time on."""


class ProcessedFrames:
    """Camera frames, or surfaces, that go through the whole chain when they are shown."""

    def __init__(self, path: Path, sensor: SensorDescription, topic: str = "") -> None:
        """Raises FrameSourceError where there is nothing to read."""
        self._recording = open_recording_of(sensor, path, topic=topic)
        first = next(frames_within(self._recording, WHOLE))
        self.begin_ns = first.time_ns - round(first.time_s * NS_PER_S)
        self.problem = self._recording.gaps
        self.length_s = self._recording.duration
        self._sensor = sensor

    def read(self, start_s: float) -> Iterator[tuple[float, Snapshot]]:
        """As `Frames.read`; the trackers begin again, and the reference stays."""
        self._pipeline.reset()
        for frame in self._recording.frames(TimeSpan(start=start_s)):
            done = self._pipeline.process(frame.content, frame.stamp_ns)
            image = None if frame.is_surface else frame.image
            shown = Snapshot(frame.stamp_ns, image, done.left, done.right, done.surface, done.force)
            yield frame.time_s, shown

    @cached_property
    def _pipeline(self) -> Pipeline:
        """Made with the first frame that is shown: the page is there before the kernels are."""
        from cmp_tactile_processing.pipeline import Pipeline

        encoded = bool(self._recording.codec)
        return Pipeline(self._sensor, auto_reference="when_still", encoded=encoded)


class StoredResults:
    """What nodes or `cmp_tactile process` wrote into a bag, with the camera image where it has one.

    Messages that cannot be used are left out; `problem` keeps the last reason.
    """

    def __init__(
        self, path: Path, sensor: SensorDescription, storage: BagStorage | None = None
    ) -> None:
        """storage: the bag, where it is open already.

        Raises FrameSourceError for what is no bag, CmpTactileError for one of several sensors.
        """
        self._storage = storage or BagStorage(path)
        self._topics = _result_topics(path, self._storage.topics, sensor)
        self._reader = ResultReader(sensor, BitDepth(str(path)))
        messages = self._storage.index(list(self._topics))
        first = next((topic for topic, field in self._topics.items() if field == "frame"), "")
        self._timeline = timeline(messages, first)
        moments = (item.moment_ns for item in self._timeline.messages if item.topic == first)
        self.begin_ns = next(moments, messages[0].moment_ns if messages else 0)
        self.length_s = self._timeline.duration
        self.problem = self._storage.loss or self._timeline.gaps

    def read(self, start_s: float) -> Iterator[tuple[float, Snapshot]]:
        """As `Frames.read`."""
        open_ones: dict[int, tuple[float, Snapshot]] = {}
        for stored in self._storage.read(self._timeline.part(TimeSpan(start=start_s))):
            field = self._topics[stored.topic]
            try:
                message = stored.decode()
                stamp_ns = reading.stamp_ns(message.header.stamp)
                value = self._reader.value(field, message)
            except (CmpTactileError, ValueError) as error:
                self.problem = f"{stored.topic} at {stored.time_ns} ns: {error}"
                continue
            begun = stored.time_s, Snapshot(stamp_ns)
            time_s, snapshot = open_ones.pop(stamp_ns, begun)
            open_ones[stamp_ns] = time_s, replace(snapshot, **{field: value})
            if len(open_ones) > MOST_OPEN:
                yield open_ones.pop(next(iter(open_ones)))
        self.problem = self._storage.loss or self.problem
        yield from open_ones.values()


class JoinedFrames:
    """The snapshots of all sensors of a recording by name, those of one moment together.

    length_s: from the first frame of any to the last message.
    """

    def __init__(self, frames: Mapping[str, Frames]) -> None:
        begin_ns = min(item.begin_ns for item in frames.values())
        self._frames = frames
        self._late_s = {n: (item.begin_ns - begin_ns) / NS_PER_S for n, item in frames.items()}
        self.length_s = max(self._late_s[name] + item.length_s for name, item in frames.items())

    @property
    def problem(self) -> str:
        """What is not as it should be; empty for nothing."""
        return "; ".join(
            dict.fromkeys(item.problem for item in self._frames.values() if item.problem)
        )

    def read(self, start_s: float) -> Iterator[tuple[float, dict[str, Snapshot]]]:
        """Moments and their times since the first frame, s, from a time on."""
        begun, moment = 0.0, dict[str, Snapshot]()
        each = (self._read(name, start_s) for name in self._frames)
        for time_s, name, snapshot in merge(*each, key=itemgetter(0)):
            if moment and (time_s > begun + SAME_MOMENT_S or name in moment):
                yield begun, moment
                moment = {}
            begun = begun if moment else time_s
            moment[name] = snapshot
            if len(moment) == len(self._frames):
                yield begun, moment
                moment = {}
        if moment:
            yield begun, moment

    def _read(self, name: str, start_s: float) -> Iterator[tuple[float, str, Snapshot]]:
        late_s = self._late_s[name]
        for time_s, snapshot in self._frames[name].read(max(0.0, start_s - late_s)):
            yield time_s + late_s, name, snapshot


def _result_topics(path: Path, topics: dict[str, str], sensor: SensorDescription) -> dict[str, str]:
    """The field of a Snapshot that each topic fills; of one sensor where the bag has several."""
    found: dict[str, str] = {}
    for topic, kind in sorted(of_one_sensor(topics, sensor.ros_name).items()):
        name, truth = topic.rpartition("/")[2], "/truth/" in topic
        if truth:
            continue
        if kind == SURFACE and name == "surface":
            found[topic] = "surface"
        elif kind == FORCE_FIELD:
            found[topic] = "force"
        elif kind == GRID:
            found[topic] = topic.split("/")[-2]
        elif (
            kind in (IMAGE, COMPRESSED_IMAGE)
            and _is_frame(topic, sensor.ros_name)
            # Raw ones come first, and are better.
            and topic.removesuffix(COMPRESSED) not in found
        ):
            found[topic] = "frame"
    for field in ("surface", "force"):
        several = [topic for topic, other in found.items() if other == field]
        if len(several) > 1:
            msg = f"{path}: found results of several sensors: {', '.join(several)}; expected one"
            raise CmpTactileError(msg)
    return found


def _is_frame(topic: str, namespace: str) -> bool:
    """Whether it is the topic of a camera, not of a view of it."""
    name = topic.removesuffix(COMPRESSED)
    parts = name.split("/")
    of_view = parts[-2:-1] in (["left"], ["right"]) and name != f"/{namespace}/image_raw"
    return parts[-1] == "image_raw" and not of_view


def _bag(path: Path) -> BagStorage | None:
    """None for a folder of images or a video."""
    return BagStorage(path) if is_bag(path) else None


def _frames(
    path: Path, storage: BagStorage | None, sensor: SensorDescription, topic: str
) -> Frames:
    """The stored results of a bag that has surfaces; else its frames, processed when shown.

    Forces alone are shown where the bag has no images; surfaces alone are processed.
    """
    if storage is not None:
        fields = set(_result_topics(path, storage.topics, sensor).values())
        if {"surface", "frame"} <= fields or ("force" in fields and "frame" not in fields):
            return StoredResults(path, sensor, storage)
    return ProcessedFrames(path, sensor, topic)


class RecordingSource(PassiveSource):
    """Plays a recording to the page, at its own pace or as its slider says."""

    playback: Playback

    def __init__(
        self,
        sensors: Sequence[ShownSensor],
        frames: JoinedFrames,
        indenter: IndenterPoses | None = None,
        scene: RecordedScene | None = None,
    ) -> None:
        loops = frames.length_s <= LOOPED_S
        playback = Playback(frames.length_s, loop=loops, preparing=True)
        super().__init__(tuple(sensors), playback)
        self.frames, self.indenter, self.scene = frames, indenter, scene
        self._newest: dict[str, Snapshot] = {}
        self._player = threading.Thread(target=self._play, name="recording", daemon=True)
        self._looked_at, self._ended = threading.Event(), threading.Event()
        self._touch = Touch()
        self._guard = threading.Lock()
        self._player.start()

    def touches(self) -> Mapping[str, Touch]:
        """The indenter where the recording has one."""
        return {self.sensors[0].name: self._touch} if self.indenter else {}

    def start(self, audience: Audience) -> None:
        """Go on from where it was."""
        self.audience = audience
        self._looked_at.set()

    def pause(self) -> None:
        """Stand still until somebody looks again."""
        with self._guard:
            # The last browser may leave while the page is closed, which must not wait for another.
            if not self._ended.is_set():
                self._looked_at.clear()

    def close(self) -> None:
        """End."""
        with self._guard:
            self._ended.set()
            self._looked_at.set()
        self._player.join()

    def _play(self) -> None:
        self._looked_at.wait()
        preparing = Finding(Severity.OK, PREPARING, about="recording")
        self._show_lines([preparing], preparing=True)
        while self._looked_at.wait() and not self._ended.is_set():
            if not self._play_on_or_report():
                return

    def _play_on_or_report(self) -> bool:
        try:
            self._play_on()
        except CmpTactileError as error:
            self._report(Severity.ERROR, str(error))
            return False
        return True

    def _play_on(self) -> None:
        """Play from the place that was asked for, until another one is or the recording ends."""
        playback, frames, audience = self.playback, self.frames, self.audience
        assert audience is not None  # noqa: S101  `start` came before
        start_s = playback.seek_s or 0.0
        playback.seek_s, playback.ended = None, False
        pacer = Pacer()
        sought = True
        shown = 0
        for time_s, moment in frames.read(start_s):
            if not sought and not self._may_go_on(playback):
                return
            if playback.playing and not sought:
                self._wait(pacer.delay((time_s - playback.position_s) / playback.speed))
            elif playback.steps > 0:
                playback.steps -= 1
            if playback.is_sought or self._ended.is_set():
                return
            sought = False
            playback.position_s = time_s
            shown += 1
            self._show(moment, audience)
        if not shown:
            self._report(Severity.WARNING, frames.problem or f"no frame from {start_s:.2f} s on")
        # One picture, or none, would be read again without a pause.
        loops = shown > 1 or (shown == 1 and start_s > 0.0)
        if loops and playback.loop and playback.playing and not self._ended.is_set():
            playback.seek_s = 0.0
            return
        # A place that is asked for from now on is shown, not played from.
        playback.ended, playback.playing = True, False
        while not self._ended.is_set() and not playback.is_sought:
            if playback.steps < 0:
                self._step_back(playback)
            time.sleep(0.05)

    def _wait(self, delay_s: float) -> None:
        """So long, or until another place is asked for."""
        due_s = time.monotonic() + delay_s
        while (left_s := due_s - time.monotonic()) > 0 and not self.playback.is_sought:
            if self._ended.wait(min(left_s, 0.1)):
                return

    def _show(self, moment: Mapping[str, Snapshot], audience: Audience) -> None:
        for name, snapshot in moment.items():
            if self.indenter:
                self._touch.pose = self.indenter.at(snapshot.stamp_ns)
            placed = self.scene.placed(name, snapshot) if self.scene else snapshot
            audience.show(name, placed)
        self._newest |= moment
        self._report_frames()

    def _may_go_on(self, playback: Playback) -> bool:
        """Wait while it is paused; False where another place is asked for."""
        while not playback.playing and playback.steps == 0 and not playback.is_sought:
            if self._ended.wait(0.02):
                return False
        self._looked_at.wait()
        if playback.steps < 0:
            self._step_back(playback)
        return not playback.is_sought and not self._ended.is_set()

    def _step_back(self, playback: Playback) -> None:
        """Ask for the last frame before the one on show."""
        playback.steps += 1
        back_s, before = BACK_S, None
        while before is None:
            begin = max(playback.position_s - back_s, 0.0)
            for time_s, _ in self.frames.read(begin):
                if time_s >= playback.position_s - 1e-6:
                    break
                before = time_s
            if not begin:
                break
            back_s *= 4
        playback.seek_s = before or 0.0

    def _report_frames(self) -> None:
        lines = [
            replace(line, about=f"{name}, {line.about}" if len(self.sensors) > 1 else line.about)
            for name, snapshot in self._newest.items()
            for line in snapshot_health(snapshot)
        ]
        if self.frames.problem:
            lines.append(Finding(Severity.WARNING, self.frames.problem, about="recording"))
        if lines:
            self._show_lines(lines)
        else:
            self._report(Severity.OK, "all markers as expected")

    def _report(self, severity: Severity, text: str) -> None:
        self._show_lines([Finding(severity, text, about="recording")])

    def _show_lines(self, lines: list[Finding], *, preparing: bool = False) -> None:
        self.playback.preparing = preparing
        if self.audience is not None:
            self.audience.show_health(lines)


def snapshot_health(snapshot: Snapshot) -> Iterator[Finding]:
    """What a snapshot itself says is the matter: faults of the views, flags of the force."""
    for grid, view in ((snapshot.left, "left view"), (snapshot.right, "right view")):
        if grid is not None and grid.reason:
            fault = f" ({grid.fault.value})" if grid.fault.value else ""
            yield Finding(Severity.WARNING, f"{grid.reason}{fault}", about=view)
    if snapshot.force is not None:
        for flag in single_flags(snapshot.force.flags):
            yield Finding(Severity.WARNING, RECORDED_ADVICE[flag], about="force")


def open_source(path: Path, *sensors: SensorDescription, topic: str = "") -> RecordingSource:
    """A source that plays a bag, a results file, a folder of images or a video.

    sensors: of a bag with topics of several, those that are shown, by their namespaces.
    Raises CmpTactileError for what cannot be read.
    """
    storage = _bag(path)
    if len(sensors) > 1:
        _check_several(path, storage, [sensor.ros_name for sensor in sensors])
    apart_m = SIDE_BY_SIDE * max(sensor.elastomer.size[0] for sensor in sensors)
    shown = [
        ShownSensor(sensor.ros_name, sensor, Pose((number * apart_m, 0.0, 0.0)))
        for number, sensor in enumerate(sensors)
    ]
    frames = {item.name: _frames(path, storage, item.description, topic) for item in shown}
    scene = RecordedScene(storage, shown) if storage and len(shown) > 1 else None
    indenter = IndenterPoses(storage) if storage else None
    return RecordingSource(shown, JoinedFrames(frames), indenter, scene)


def _check_several(path: Path, storage: BagStorage | None, names: Sequence[str]) -> None:
    """Raise FrameSourceError unless each of these sensors has topics of its own."""
    topics = storage.topics if storage else ()
    found = sorted({topic.strip("/").partition("/")[0] for topic in topics})
    if len(set(names)) < len(names) or not set(names) <= set(found):
        msg = (
            f"{path}: found sensors named {', '.join(names)}, expected different names, each the "
            f"namespace of topics in a bag; namespaces: {', '.join(found) or 'none'}"
        )
        raise FrameSourceError(msg)
