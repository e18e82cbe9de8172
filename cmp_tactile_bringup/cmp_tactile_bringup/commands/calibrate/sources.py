"""What the calibrations read: their options, frames, and the wrenches of a reference sensor."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cmp_tactile_bringup.commands.options import Command, Number, argument, misuse, option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from scipy.spatial.transform import Rotation

    from cmp_tactile_bringup.calibration.frames import RecordedFrames
    from cmp_tactile_bringup.calibration.gel_recording import GelMotion
    from cmp_tactile_bringup.calibration.loads import WrenchSeries
    from cmp_tactile_processing.processes import OnProgress
    from cmp_tactile_processing.sensor.description import SensorDescription

IMAGE_TOPIC = "/NS/image_raw"
LIVE = (
    "image topic: without INPUT, of a running sensor; else of a bag that has several (LEFT,RIGHT "
    "for two cameras)"
)
SENSOR = "description to start from: a file or a packaged name"
# Frames of a live camera unless --frames names another number.
LIVE_FRAMES = 20
force_sensor_option = partial(option, group="Reference force sensor")


@dataclass(frozen=True, kw_only=True)
class Output(Command):
    """Options of where results are written."""

    output: Annotated[
        Path, option("description to write; other files are written beside it", metavar="NEW.yaml")
    ]
    overwrite: Annotated[bool, option("replace existing results")] = False


@dataclass(frozen=True, kw_only=True)
class LiveInput(Command):
    """Option of a live topic."""

    timeout: Annotated[
        float, option("how long to wait for a frame of a live topic", Number(0.1, 3600, "s"))
    ] = 10.0


@dataclass(frozen=True, kw_only=True)
class FrameInput(LiveInput):
    """Options of frames, recorded or live."""

    input: Annotated[
        Path | None,
        argument("INPUT", "a ROS 2 bag, a folder of images, or a packaged scene, such as grasp"),
    ] = None
    topic: Annotated[str, option(LIVE, metavar=IMAGE_TOPIC)] = ""
    sensor: Annotated[str, option(SENSOR)] = ""
    frames: Annotated[int | None, option("use at most N frames", Number(1, 100_000, kind=int))] = (
        None
    )
    start: Annotated[
        float, option("leave out the first seconds of a recording", Number(0, 1e6, "s"))
    ] = 0.0

    def check_source(self) -> None:
        """End with the usage unless there is an input or a topic."""
        if self.input is None and not self.topic:
            misuse("INPUT or --topic is required")


@dataclass(frozen=True, kw_only=True)
class WrenchSensor(Command):
    """Options of where the reference force sensor is, and how its clock differs."""

    input: Annotated[
        Path | None, argument("INPUT", "a ROS 2 bag with images or surfaces, or a scene")
    ] = None
    wrench_rotation: Annotated[
        tuple[float, float, float] | None,
        force_sensor_option(
            "rotation from the gel frame's axes to the sensor's, degrees about the gel's x, then "
            "y, then z axis (default: from /tf_static of the bag, else none)",
            Number(-360, 360, "degrees"),
            metavar="X Y Z",
        ),
    ] = None
    wrench_reaction: Annotated[
        bool, force_sensor_option("it measures the opposite force: that of the gel on the object")
    ] = False
    time_offset: Annotated[
        float,
        force_sensor_option("how far its clock is ahead of the camera's", Number(-1e10, 1e10, "s")),
    ] = 0.0


def frames_of(
    arguments: FrameInput, sensor: SensorDescription, on_stage: OnProgress
) -> RecordedFrames:
    """Frames of the input, or of the live topic where there is none."""
    from itertools import islice

    from cmp_tactile_bringup.calibration.frames import RecordedFrames, read_frames

    topic = arguments.topic
    if arguments.input is not None:
        on_stage("reading frames", 0.0)
        frames = read_frames(arguments.input, sensor, topic, arguments.frames, arguments.start)
        on_stage("reading frames", 1.0)
        return frames
    from cmp_tactile_bringup.calibration.live import LiveFrames

    count = arguments.frames or LIVE_FRAMES
    images: list[NDArray[np.uint8]] = []
    with LiveFrames(topic, sensor, arguments.timeout) as live:
        on_stage(f"frames of {topic}", 0.0)
        for image in islice(live, count):
            images.append(image)
            on_stage(f"frames of {topic}", len(images) / count)
    return RecordedFrames(images, list(range(len(images))))


def _rotation_to_gel(
    arguments: WrenchSensor, sensor: SensorDescription, series: WrenchSeries
) -> Rotation:
    """As the options have it, or else the bag's fixed transforms, or else the gel's own axes."""
    from scipy.spatial.transform import Rotation

    from cmp_tactile_bringup.calibration.loads import fixed_rotation
    from cmp_tactile_bringup.recordings.library import recorded_source

    if arguments.wrench_rotation is not None:
        return Rotation.from_euler("xyz", arguments.wrench_rotation, degrees=True)
    gel_frame = f"{sensor.ros_name}_gel_frame"
    if arguments.input is not None and series.frame_id:
        rotation = fixed_rotation(recorded_source(arguments.input), gel_frame, series.frame_id)
        if rotation is not None:
            print(
                f"Force sensor: the pose of its frame {series.frame_id} is taken from /tf_static."
            )
            return rotation
    print(
        "Force sensor: its axes are assumed to be the gel frame's; if not, give --wrench-rotation."
    )
    return Rotation.identity()


def force_at_frames(
    arguments: WrenchSensor,
    sensor: SensorDescription,
    motion: GelMotion,
    series: WrenchSeries,
) -> NDArray[np.float64]:
    """Force on the gel at the frames, (n, 3) N, gel frame; NaN if unknown.

    Raises FrameSourceError where force and frames have no time in common.
    """
    import numpy as np

    from cmp_tactile_bringup.calibration.loads import at_frames

    force = at_frames(series, motion.stamp_ns, arguments.time_offset)
    on_gel = _rotation_to_gel(arguments, sensor, series).apply(force)
    return np.asarray(-on_gel if arguments.wrench_reaction else on_gel)
