"""A grasp into a folder: one bag of both sensors with truth and measurements, and a video."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.bags.writer import LATCHED, BagWriter
from cmp_tactile_processing.cache.files import partial_folder
from cmp_tactile_processing.errors import ContactError, OutputError
from cmp_tactile_processing.force.advice import UNUSABLE
from cmp_tactile_processing.measured import ForceField
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.ros.messages import making
from cmp_tactile_processing.ros.messages.definitions import bag_messages, simulation_definition
from cmp_tactile_processing.sensor.yaml_file import read_yaml
from cmp_tactile_processing.sensor.yaml_text import dump_yaml
from cmp_tactile_simulation.grasp.body import OBJECT_FRAME, object_marker
from cmp_tactile_simulation.grasp.picture import GraspPainter, VideoWriter
from cmp_tactile_simulation.grasp.play import Grasp, GraspFrame
from cmp_tactile_simulation.grasp.scene import SIDES
from cmp_tactile_simulation.recording.truth import (
    POSE_STAMPED,
    FrameWriter,
    add_simulated_topic,
    pose_message,
    transform_message,
    write_simulated,
)

Array = NDArray[np.float64]

OBJECT_TOPIC, CONTROL_TOPIC, TF_TOPIC = "/object/pose", "/gripper/controls", "/tf"
JOINT_STATE, TF_MESSAGE = "sensor_msgs/msg/JointState", "tf2_msgs/msg/TFMessage"
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
WORLD_FRAME = "world"
TABLE_FILE, VIDEO_FILE = "wrenches.csv", "grasp.mp4"
AXES = ("fx", "fy", "fz", "mx", "my", "mz")
COLUMNS = (
    *("time_s", "phase", "side", "slip", "measured_slip", "flags", "usable"),
    *(f"{axis}_true" for axis in AXES),
    *AXES,
    *(f"{axis}_std" for axis in AXES),
)


@dataclass(frozen=True)
class GraspSummary:
    """What came of a grasp.

    error, most (3,) N: of the force of usable frames, RMS and largest, over both fingers.
    ended: why it ended before its scene did, such as that an object slid off a gel; or empty.
    """

    frames: int
    usable: int
    error: Array
    most: Array
    ended: str = ""


def record_grasp(grasp: Grasp, folder: Path, on_share: Callable[[float], None]) -> GraspSummary:
    """Play a grasp into a new folder.

    Where a gel cannot follow any more, the folder has all frames before.  Raises OutputError where
    the folder is there already or its disk is full, and what a grasp raises before its first frame.
    """
    with partial_folder(folder) as partial:
        if folder.exists():
            msg = f"{folder}: exists already, expected a new folder"
            raise OutputError(msg)
        found = _record(grasp, partial / folder.name, on_share)
        (partial / folder.name).replace(folder)
    return found


def _record(grasp: Grasp, folder: Path, on_share: Callable[[float], None]) -> GraspSummary:
    scene = grasp.scene
    count = scene.duration * scene.rate
    errors: list[Array] = []
    ended: list[str] = []
    usable = frames = 0
    with ExitStack() as stack:
        bag = _GraspBag(stack.enter_context(BagWriter(folder)), grasp)
        table = stack.enter_context((folder / TABLE_FILE).open("w", newline="", encoding="utf-8"))
        rows = csv.writer(table)
        rows.writerow(COLUMNS)
        video = stack.enter_context(VideoWriter(folder / VIDEO_FILE, scene.rate))
        painter = GraspPainter(scene)
        played = grasp.frames()
        while frame := _next_frame(played, ended):
            found = bag.append(frame)
            for side, field in found.items():
                rows.writerow(_row(frame, side, field, scene.rate))
                if not field.flags & UNUSABLE:
                    usable += 1
                    errors.append(field.wrench[:3] - frame.wrenches[side][:3])
            video.add(painter.draw(frame, {side: found[side].wrench for side in SIDES}))
            frames += 1
            on_share(min(1.0, frames / count))
        if not frames:
            raise ContactError(*ended)
    for side in SIDES:
        content = read_yaml(scene.files[side]).content
        text = dump_yaml({**content, "name": side})
        (folder / f"{side}.yaml").write_text(text, encoding="utf-8")
    shutil.copyfile(scene.file, folder / "scene.yaml")
    size = np.array(errors or [np.full(3, np.nan)])
    error, most = np.sqrt((size**2).mean(axis=0)), np.abs(size).max(axis=0)
    return GraspSummary(frames, usable, error, most, "".join(ended))


def _next_frame(played: Iterator[GraspFrame], ended: list[str]) -> GraspFrame | None:
    """None at the end; why it is one goes into `ended`, where a gel cannot follow."""
    try:
        return next(played, None)
    except ContactError as error:
        ended.append(str(error))
        return None


class _GraspBag:
    """Writes the frames of a grasp into a bag, with what the sensors' own chain makes of them."""

    def __init__(self, writer: BagWriter, grasp: Grasp) -> None:
        self._writer, self._make = writer, bag_messages()
        sensors = {side: replace(grasp.scene.described[side], name=side) for side in SIDES}
        self._frames = {side: FrameWriter(writer, sensor) for side, sensor in sensors.items()}
        self._chains = {side: Pipeline(sensor) for side, sensor in sensors.items()}
        self._gels = {side: making.gel_frame(sensor) for side, sensor in sensors.items()}
        topics = {OBJECT_TOPIC: POSE_STAMPED, CONTROL_TOPIC: JOINT_STATE, TF_TOPIC: TF_MESSAGE}
        for side in SIDES:
            topics |= {f"/{side}/force_field": making.FORCE_FIELD}
            topics |= {f"/{side}/wrench": WRENCH_STAMPED, f"/{side}/truth/wrench": WRENCH_STAMPED}
        self._topics = topics
        for topic, kind in topics.items():
            add_simulated_topic(writer, topic, kind)
        self._topics[making.MARKER_TOPIC] = making.MARKER
        definition = simulation_definition(making.MARKER)
        writer.add_topic(making.MARKER_TOPIC, making.MARKER, [LATCHED], definition)
        self._marker = object_marker(self._make, grasp.scene)

    def append(self, frame: GraspFrame) -> dict[str, ForceField]:
        """Write a frame; what was measured in it, by side."""
        found = {}
        for side in SIDES:
            seen, chain = frame.fingers[side], self._chains[side]
            self._frames[side].append(seen)
            if frame.index == 0:
                chain.set_reference([seen.image], seen.stamp_ns)
            found[side] = chain.process(seen.image, seen.stamp_ns).force
            header = self._make.header(frame.stamp_ns, self._gels[side])
            true = replace(seen.force, wrench=frame.wrenches[side])
            self._write(f"/{side}/force_field", frame, self._make.force_field(found[side], header))
            self._write(f"/{side}/wrench", frame, self._make.wrench_stamped(found[side], header))
            self._write(f"/{side}/truth/wrench", frame, self._make.wrench_stamped(true, header))
        self._write_world(frame)
        self._writer.flush()
        return found

    def _write_world(self, frame: GraspFrame) -> None:
        make, header = self._make, self._make.header(frame.stamp_ns, WORLD_FRAME)
        if frame.index == 0:
            self._write(making.MARKER_TOPIC, frame, self._marker)
        self._write(OBJECT_TOPIC, frame, pose_message(make, frame.held, header))
        poses = {OBJECT_FRAME: frame.held}
        poses |= {self._gels[side]: frame.fingertips[side] for side in SIDES}
        transforms = [transform_message(make, child, pose, header) for child, pose in poses.items()]
        self._write(TF_TOPIC, frame, make.new(TF_MESSAGE, transforms=transforms))
        nothing = np.zeros(0)
        controls = make.new(
            JOINT_STATE,
            header=header,
            name=list(frame.controls),
            position=np.array([*frame.controls.values()], np.float64),
            velocity=nothing,
            effort=nothing,
        )
        self._write(CONTROL_TOPIC, frame, controls)

    def _write(self, topic: str, frame: GraspFrame, message: object) -> None:
        write_simulated(self._writer, topic, self._topics[topic], frame.stamp_ns, message)


def _row(frame: GraspFrame, side: str, field: ForceField, rate: float) -> list[object]:
    true = frame.fingers[side].force.slip_state.name.lower()
    usable = int(not field.flags & UNUSABLE)
    values = np.concatenate([frame.wrenches[side], field.wrench, field.wrench_std])
    head = [f"{frame.index / rate:.4f}", frame.phase, side, true, field.slip_state.name.lower()]
    return [*head, int(field.flags), usable, *(f"{value:.6g}" for value in values)]
