"""How the gel moves in a recording, and where it stands still: from frames or a surface topic."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.recordings.library import check_source, recorded_source
from cmp_tactile_driver.bags.recording import open_recording_of
from cmp_tactile_driver.bags.timeline import passed_ns, running_ns
from cmp_tactile_processing.errors import (
    CalibrationError,
    Finding,
    FrameSourceError,
    warnings_of,
)
from cmp_tactile_processing.measured import Markers3D, Surface
from cmp_tactile_processing.pipeline import MarkerCamera
from cmp_tactile_processing.processes import OnProgress, no_progress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.surface.stillness import (
    RestParameters,
    largest_motion,
    motion_limit,
    rest_shape,
    why_touched,
)

# A reference sensor's reading changes by more than this while a load is put on: relative, and N.
FORCE_CHANGE, LEAST_FORCE_CHANGE = 0.02, 0.02
# More frames at rest make the reference no better than the markers of one loaded frame are.
MOST_REST_FRAMES = 50


def leading_frames(position: NDArray[np.float64], most: int) -> range:
    """The first frames, at most so many, up to where the gel begins to move."""
    limit = motion_limit(position)
    count = 1
    while count < min(len(position), most):
        if largest_motion(position[0], position[count]) > limit:
            break
        count += 1
    return range(count)


def steady_stretches(
    position: NDArray[np.float64], least: int, force: NDArray[np.float64] | None = None
) -> list[range]:
    """Ranges of at least so many frames in a row that all lie where the first of them does.

    force (n, 3) N: of a reference sensor at these frames; where it changes by more than 2 % and
    20 mN a stretch ends, too.
    """
    limit = motion_limit(position)
    found: list[range] = []
    start = 0
    for frame in range(1, len(position) + 1):
        if frame < len(position) and _goes_on(position, force, (start, frame), limit):
            continue
        if frame - start >= least:
            found.append(range(start, frame))
        start = frame
    return found


def _goes_on(
    position: NDArray[np.float64],
    force: NDArray[np.float64] | None,
    frames: tuple[int, int],
    limit: float,
) -> bool:
    first, this = frames
    if largest_motion(position[first], position[this]) > limit:
        return False
    if force is None:
        return True
    change = float(np.linalg.norm(force[this] - force[first]))
    return change <= FORCE_CHANGE * float(np.linalg.norm(force[first])) + LEAST_FORCE_CHANGE


@dataclass(frozen=True)
class GelMotion:
    """Markers of n frames, displaced from where they are at rest.

    source: what messages call the recording.  stamp_ns (n,) of the camera frames, which rise.
    displacement (n, rows, cols, 3) m, gel frame; status (n, rows, cols).
    rest: range of the frames that gave the reference, empty for a surface topic, which has its own.
    """

    source: str
    stamp_ns: NDArray[np.int64]
    displacement: NDArray[np.float64]
    status: NDArray[np.uint8]
    rest: range = range(0)
    findings: tuple[Finding, ...] = ()

    @property
    def time_s(self) -> NDArray[np.float64]:
        """Times from the first frame on as a replay counts them, (n,) s."""
        return np.array(passed_ns(self.stamp_ns.tolist())) * 1e-9


def read_motion(
    source: Path,
    sensor: SensorDescription,
    topic: str = "",
    rest_s: tuple[float, float] | None = None,
    report: OnProgress = no_progress,
) -> GelMotion:
    """The motion in a bag, a folder of images or a packaged scene.

    topic: of images or of cmp_tactile_msgs/Surface; empty for the only image topic or, without
    one, the only surface topic.  rest_s: seconds from the first frame in which nothing touches the
    gel; by default all frames from the first on until the gel moves.  report: called with
    what is done and its share.
    Raises FrameSourceError where nothing of it can be used.
    """
    check_source(source, "a ROS 2 bag, a folder of images")
    path = recorded_source(source, report)
    doing = f"reading {source}"
    report(doing, 0.0)
    motion = _read(path, topic, sensor, rest_s)
    report(doing, 1.0)
    return motion


def _read(
    path: Path, topic: str, sensor: SensorDescription, rest_s: tuple[float, float] | None
) -> GelMotion:
    recording = open_recording_of(sensor, path, topic=topic)
    camera = None
    stamps: list[int] = []
    markers: list[Markers3D] = []
    for frame in recording.frames():
        if isinstance(frame.content, Surface):
            markers.append(frame.content)
        else:
            camera = camera or MarkerCamera(sensor)
            markers.append(camera.measure(frame.content)[1])
        stamps.append(frame.time_ns)
    mismatch = recording.calibration_mismatch(sensor)
    findings = warnings_of(recording.health.summary, mismatch, recording.gaps)
    stamp_ns = np.array(running_ns(stamps), np.int64)
    surfaces = [item for item in markers if isinstance(item, Surface)]
    if surfaces and rest_s is None:
        return _moved(str(path), stamp_ns, surfaces, range(0), findings)
    time_s = np.array(passed_ns(stamps)) * 1e-9
    rest = _rest_frames(str(path), time_s, np.stack([item.position for item in markers]), rest_s)
    return displaced(str(path), sensor, (stamp_ns, markers), rest, findings)


def displaced(
    source: str,
    sensor: SensorDescription,
    frames: tuple[NDArray[np.int64], list[Markers3D]],
    rest: range,
    findings: tuple[Finding, ...] = (),
) -> GelMotion:
    """Displacements of frames, by stamps in ns and markers, against those at rest among them.

    Raises FrameSourceError where the frames at rest cannot serve as a reference.
    """
    stamps, markers = frames
    which = f"{source}: frames {rest.start} to {rest.stop - 1}"
    try:
        reference = Reference.average(markers[rest.start : rest.stop], 1)
    except CalibrationError as error:
        msg = f"{which}: {error}"
        raise FrameSourceError(msg) from None
    shape = rest_shape(sensor.pattern.corners(), reference.position)
    touched = why_touched(shape, RestParameters())
    if touched:
        findings += warnings_of(f"{which} are used as the gel at rest, but {touched}")
    surfaces = [reference.surface(item) for item in markers]
    return _moved(source, stamps, surfaces, rest, findings)


def _moved(
    source: str,
    stamps: NDArray[np.int64],
    surfaces: list[Surface],
    rest: range,
    findings: tuple[Finding, ...],
) -> GelMotion:
    return GelMotion(
        source=source,
        stamp_ns=stamps,
        displacement=np.stack([item.displacement for item in surfaces]),
        status=np.stack([item.status for item in surfaces]),
        rest=rest,
        findings=findings,
    )


def _rest_frames(
    source: str,
    time_s: NDArray[np.float64],
    position: NDArray[np.float64],
    rest_s: tuple[float, float] | None,
) -> range:
    """The frames at rest: those of the time given, or the first ones up to where the gel moves."""
    if rest_s is None:
        return leading_frames(position, MOST_REST_FRAMES)
    chosen = np.flatnonzero((time_s >= rest_s[0]) & (time_s <= rest_s[1]))
    if not chosen.size:
        msg = (
            f"{source}: rest: found no frame from {rest_s[0]:g} to {rest_s[1]:g} s, expected "
            f"times from 0 to {time_s[-1]:.2f} s"
        )
        raise FrameSourceError(msg)
    return range(int(chosen[0]), int(chosen[-1]) + 1)
