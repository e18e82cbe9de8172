"""Recordings of sensors that measure their markers themselves, through force and slip to files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.offline.jobs import Job, Options
from cmp_tactile_bringup.offline.outputs import (
    WRENCH_STAMPED,
    NamedMessage,
    result_files,
    whole_results,
)
from cmp_tactile_bringup.recordings import results
from cmp_tactile_driver.bags.reader import RecordedFrame
from cmp_tactile_driver.sources.markers import MarkerRecording
from cmp_tactile_driver.sources.tac3d import Tac3dRecording
from cmp_tactile_processing.errors import Finding
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.measured import NS_PER_S, Surface
from cmp_tactile_processing.pipeline import PipelineResult
from cmp_tactile_processing.ros.messages import making
from cmp_tactile_processing.ros.messages.definitions import bag_messages
from cmp_tactile_processing.sensor.description import (
    SensorDescription,
    write_sensor_description,
)

Array = NDArray[np.float64]

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
REFERENCE = "markers at rest, as the sensor reports them"


@dataclass(frozen=True)
class Imported:
    """agreement: of our forces and the sensor's own; None where it says nothing of a force.

    findings: why forces may not be trusted.
    """

    agreement: Agreement | None
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class Agreement:
    """How two forces over time agree, along x, y and z.

    correlation (3,): NaN where one of the two does not change.  scale: of ours that comes nearest
    to theirs, all axes together.  left (3,) N: root mean square of the difference then.
    """

    correlation: Array
    scale: float
    left: Array


def plan_import(recording: MarkerRecording, folder: Path, *, overwrite: bool) -> Job:
    """What is to be written of a recording."""
    options = Options(reference=REFERENCE)
    return Job(recording.name, recording.name, str(folder), recording.name, options, overwrite)


def write_import(recording: MarkerRecording, sensor: SensorDescription, job: Job) -> Imported:
    """Write NAME.mcap, NAME_wrench.csv and NAME.yaml; each is there whole or not at all.

    Raises OutputError where they are there and the job does not replace them.
    """
    ours, flags = [], results.ForceFlags()
    with whole_results(job) as folder:
        with result_files(folder, job, sensor) as append:
            for number, (frame, result) in enumerate(_frames(recording, sensor)):
                own = _own_messages(recording, number, making.gel_frame(sensor))
                append(frame, result, more=own)
                ours.append(result.force.wrench[:3])
                flags.add(result.force)
        write_sensor_description(folder / f"{job.name}.yaml", sensor)
    found = None
    if isinstance(recording, Tac3dRecording):
        found = agreement(np.array(ours), recording.wrench[:, :3])
    return Imported(found, tuple(flags.findings))


def _frames(
    recording: MarkerRecording, sensor: SensorDescription
) -> Iterator[tuple[RecordedFrame, PipelineResult]]:
    """Each frame, and our force field of it."""
    stage, shape, rest = ForceStage(sensor), sensor.pattern.shape, recording.reference
    stamps = recording.stamp_ns.tolist()
    for stamp, moved in zip(stamps, recording.displacement, strict=True):
        surface = Surface.from_positions(shape, rest, rest + moved)
        time_s = (stamp - stamps[0]) / NS_PER_S
        force = stage.process(surface, stamp)
        result = PipelineResult(None, None, surface, force)
        yield RecordedFrame(time_s, stamp, stamp, "", surface), result


def _own_messages(
    recording: MarkerRecording, number: int, gel_frame: str
) -> Iterator[NamedMessage]:
    """What the sensor itself says of the force in a frame."""
    if not isinstance(recording, Tac3dRecording):
        return
    make = bag_messages()
    header = make.header(int(recording.stamp_ns[number]), gel_frame)
    wrench = make.wrench(recording.wrench[number])
    yield "tac3d/wrench", WRENCH_STAMPED, make.new(WRENCH_STAMPED, header=header, wrench=wrench)
    force = recording.force[number]
    cloud = make.cloud(header, recording.reference, force, ("fx", "fy", "fz"))
    yield "tac3d/force_points", POINT_CLOUD, cloud


def agreement(ours: Array, theirs: Array) -> Agreement | None:
    """Of forces (n, 3) N; None where there are fewer than two frames with both."""
    known = np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1)
    ours, theirs = ours[known], theirs[known]
    if len(ours) < 2 or not ours.any():
        return None
    scale = float(np.vdot(ours, theirs) / np.vdot(ours, ours))
    left = np.sqrt(np.mean((scale * ours - theirs) ** 2, axis=0))
    with np.errstate(invalid="ignore"):
        pairs = zip(ours.T, theirs.T, strict=True)
        correlation = [np.corrcoef(one, other)[0, 1] for one, other in pairs]
    return Agreement(np.array(correlation), scale, left)
