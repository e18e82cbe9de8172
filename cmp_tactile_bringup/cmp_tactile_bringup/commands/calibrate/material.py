"""`cmp_tactile calibrate force` and `relaxation`: the gel's material from known loads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cmp_tactile_bringup.commands.calibrate import sources
from cmp_tactile_bringup.commands.options import Number, argument, misuse, option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cmp_tactile_bringup.calibration.gel_recording import GelMotion
    from cmp_tactile_bringup.commands.calibrate.outcome import CalibrationFiles
    from cmp_tactile_processing.calibration.material.loads import LoadSample, MaterialOutcome
    from cmp_tactile_processing.processes import OnProgress
    from cmp_tactile_processing.sensor.description import SensorDescription

OWN_SENSOR = f"{sources.SENSOR}; not needed if sensor.yaml is in the recording's folder"
KILOGRAMS = Number(1e-4, 100, "kg")
# Samples that are taken of a recording with a force sensor, and what a good six-axis one resolves.
MOST_SAMPLES, WRENCH_STD_N = 60, 0.01
WEIGHTS, FORCE_SENSOR = "weights", "force_sensor"


@dataclass(frozen=True, kw_only=True)
class Force(sources.Output, sources.WrenchSensor):
    """Find Young's modulus of the gel. The loads are weights on the gel, or presses that a
    reference force sensor (geometry_msgs/WrenchStamped) has recorded. Poisson's ratio, thickness
    and shading layer are taken from the description. The uncertainty of the modulus becomes part of
    the error bars of all forces.

    NEW.yaml (description of the sensor) is written only if the result is accepted.
    NEW_calibration/index.html, with reference and reading, is always written.

    weights.yaml:
      gravity: 9.81                        # optional, m/s^2; 9.80665 by default
      rest: [0, 0.2]                       # optional: nothing touches the gel, s
      loads:
        - {mass: 0.2, time: [0.4, 0.6]}    # kg; seconds of INPUT
        - {mass: 0.5, recording: bag_500g} # steady part of another recording
        - {mass: 0.5, std: 0.001, direction: [0, 0.17, -0.98], recording: tilted}
        - {force: [0.5, 0, -2], std: 0.02, time: [3, 4]}    # N on the gel, gel frame

    examples:
      cmp_tactile calibrate force my_bag --weights weights.yaml --sensor my_sensor.yaml
          --output weighed.yaml
      cmp_tactile calibrate force my_bag --wrench-topic /ft/wrench --wrench-rotation 180 0 0
          --sensor my_sensor.yaml --output weighed.yaml
    """

    input: Annotated[
        Path | None,
        argument(
            "INPUT",
            "a ROS 2 bag with images or surfaces, a folder of images, or a packaged scene",
        ),
    ] = None
    topic: Annotated[
        str,
        option(
            "image or surface topic, if the bag has several",
            metavar=sources.IMAGE_TOPIC,
        ),
    ] = ""
    sensor: Annotated[str, option(OWN_SENSOR)] = ""
    rest: Annotated[
        tuple[float, float] | None,
        option(
            "time in which nothing touches the gel, s from the recording's start (default: from "
            "the start until the gel moves)",
            Number(0, 1e6, "s"),
            metavar="FROM TO",
        ),
    ] = None
    frames: Annotated[
        int,
        option(
            "a load counts if the gel is still for N frames in a row", Number(1, 1000, kind=int)
        ),
    ] = 4
    weights: Annotated[Path | None, option("known loads and their times", metavar="FILE.yaml")] = (
        None
    )
    wrench_topic: Annotated[str, option("topic of the reference force sensor", metavar="TOPIC")] = (
        ""
    )
    every_frame: Annotated[
        bool,
        sources.force_sensor_option(
            "use frames in motion, too, not only those in which gel and force are still"
        ),
    ] = False
    poisson_std: Annotated[
        float,
        option(
            "standard deviation of the described Poisson's ratio, for the error bars; 0: it is "
            "exact",
            Number(0, 0.1),
        ),
    ] = 0.015

    def run(self) -> int:
        """Calibrate, report, and write what is accepted."""
        from cmp_tactile_bringup.commands.calibrate.outcome import CalibrationFiles
        from cmp_tactile_bringup.terminal import shown_stages
        from cmp_tactile_processing.calibration.material.calibrate import fit_material
        from cmp_tactile_processing.calibration.material.loads import check_views

        self._check_usage()
        sensor = _sensor(self)
        check_views(sensor)
        files = CalibrationFiles.of_sensor(self.output, ())
        files.check_free(overwrite=self.overwrite)
        samples = _samples(self, sensor)
        method = FORCE_SENSOR if self.wrench_topic else WEIGHTS
        with shown_stages() as on_stage:
            outcome = fit_material(sensor, samples, method, self.poisson_std, on_stage)
        return _conclude(outcome, files, self._source)

    @property
    def _source(self) -> str:
        """What the new modulus comes from, in words."""
        return f"{self.input}: {self.wrench_topic or self.weights}"

    def _check_usage(self) -> None:
        """End with the usage where arguments do not go together."""
        self.check_exclusive("weights", "wrench_topic")
        if self.weights is None and not self.wrench_topic:
            misuse("give one of --weights and --wrench-topic")
        if self.wrench_topic and self.input is None:
            misuse("--wrench-topic needs INPUT")
        if self.input is None and not self.sensor:
            misuse("without INPUT, --sensor is required")
        if self.rest and not self.rest[0] < self.rest[1]:
            misuse("--rest: FROM must be below TO")


def _sensor(arguments: Force) -> SensorDescription:
    from cmp_tactile_bringup.recordings.library import check_source, required_sensor
    from cmp_tactile_processing.sensor.description import load_sensor

    if arguments.input is None:
        return load_sensor(arguments.sensor)
    check_source(arguments.input, "a ROS 2 bag, a folder of images")
    return load_sensor(required_sensor(arguments.input, arguments.sensor))


def _samples(arguments: Force, sensor: SensorDescription) -> list[LoadSample]:
    from cmp_tactile_bringup.terminal import shown_stages

    with shown_stages() as on_stage:
        if arguments.weights is not None:
            return _weight_samples(arguments, arguments.weights, sensor, on_stage)
        return _sensor_samples(arguments, sensor, on_stage)


def _weight_samples(
    arguments: Force, weights: Path, sensor: SensorDescription, on_stage: OnProgress
) -> list[LoadSample]:
    from cmp_tactile_bringup.calibration.gel_recording import read_motion
    from cmp_tactile_bringup.calibration.loads import read_known_loads, samples_of_weights
    from cmp_tactile_bringup.terminal import print_findings

    loads, rest = read_known_loads(weights)
    motions = {}
    # INPUT first, as it is soon found to be missing.
    recordings = {load.recording for load in loads}
    for recording in sorted(recordings, key=lambda path: (path is not None, str(path))):
        source = recording or arguments.input
        if source is None:
            misuse("INPUT is required: a load in --weights has no `recording`")
        # Times of the file and of the options belong to INPUT.
        when = (arguments.rest or rest) if recording is None else None
        motions[recording] = motion = read_motion(source, sensor, arguments.topic, when, on_stage)
        print_findings(motion.findings)
    return samples_of_weights(loads, motions, arguments.frames)


def _sensor_samples(
    arguments: Force, sensor: SensorDescription, on_stage: OnProgress
) -> list[LoadSample]:
    from cmp_tactile_bringup.calibration.gel_recording import read_motion
    from cmp_tactile_bringup.calibration.loads import read_wrench
    from cmp_tactile_bringup.calibration.reference_sensor import (
        SensorSampling,
        drift_text,
        lag_s,
        samples_of_sensor,
        zeroed,
    )
    from cmp_tactile_bringup.recordings.library import recorded_source
    from cmp_tactile_bringup.terminal import print_findings
    from cmp_tactile_processing.errors import warnings_of

    assert arguments.input is not None  # noqa: S101  else there was the usage
    # First, as it is soon found to be missing.
    series = read_wrench(recorded_source(arguments.input, on_stage), arguments.wrench_topic)
    motion = read_motion(arguments.input, sensor, arguments.topic, arguments.rest, on_stage)
    lag, late = lag_s(motion, series, arguments.time_offset), ""
    if lag:
        arguments = replace(arguments, time_offset=arguments.time_offset + lag)
        late = (
            f"the force comes {abs(lag) * 1e3:.0f} ms {'late' if lag > 0 else 'early'}: "
            f"--time-offset {arguments.time_offset:.3g} is used"
        )
    zero = zeroed(motion, sources.force_at_frames(arguments, sensor, motion, series))
    print_findings((*motion.findings, *warnings_of(late, drift_text(motion, zero))))
    sampling = SensorSampling(
        steady=not arguments.every_frame,
        least_frames=arguments.frames,
        most=MOST_SAMPLES,
        std=WRENCH_STD_N,
    )
    return samples_of_sensor(motion, zero, sampling)


def _conclude(outcome: MaterialOutcome, files: CalibrationFiles, source: str) -> int:
    """Draw the report, print what was found, write what is accepted; returns the exit code."""
    from cmp_tactile_bringup.commands.calibrate.outcome import conclude
    from cmp_tactile_bringup.report.calibration import material_report

    def write() -> Sequence[Path]:
        record = outcome.record and replace(outcome.record, source=source)
        gel = replace(outcome.sensor.elastomer, calibration=record)
        return files.write(replace(outcome.sensor, elastomer=gel))

    return conclude(outcome, material_report(outcome), files.report, write)


@dataclass(frozen=True, kw_only=True)
class Relaxation(sources.Output, sources.WrenchSensor):
    """Find how much stiffness the gel loses while it is pressed, and how fast. The recording begins
    with the gel untouched and recovered. Then the load comes quickly and is held for several time
    constants. With --mass, a weight rests on the gel. With --wrench-topic, a force sensor measures
    the load; the gel may then be held at one depth. If the load is known, the stiffness of a quick
    press is found, too.

    NEW.yaml (description of the sensor) is written only if the result is accepted.
    NEW_calibration/index.html, with the record, is always written.

    examples:
      cmp_tactile calibrate relaxation my_bag --mass 0.5 --sensor weighed.yaml
          --output my_sensor.yaml
      cmp_tactile calibrate relaxation my_bag --wrench-topic /ft/wrench --sensor weighed.yaml
          --output my_sensor.yaml
    """

    input: Annotated[Path, argument("INPUT", "a ROS 2 bag with images or surfaces, or a scene")]
    topic: Annotated[
        str, option("image topic, if the bag has several", metavar=sources.IMAGE_TOPIC)
    ] = ""
    sensor: Annotated[str, option(OWN_SENSOR)] = ""
    mass: Annotated[float | None, option("mass of the weight on the gel", KILOGRAMS)] = None
    wrench_topic: Annotated[
        str | None, option("topic of the reference force sensor", metavar="TOPIC")
    ] = None

    def run(self) -> int:
        """Calibrate, report, and write what is accepted."""
        from cmp_tactile_bringup.commands.calibrate.outcome import CalibrationFiles, conclude
        from cmp_tactile_bringup.recordings.library import check_source, required_sensor
        from cmp_tactile_bringup.report.calibration import RelaxationRecord
        from cmp_tactile_bringup.terminal import shown_stages
        from cmp_tactile_processing.calibration.material.relaxation import fit_relaxation
        from cmp_tactile_processing.sensor.description import load_sensor

        self.check_exclusive("mass", "wrench_topic")
        check_source(self.input, "a ROS 2 bag, a folder of images")
        sensor = load_sensor(required_sensor(self.input, self.sensor))
        files = CalibrationFiles.of_sensor(self.output, ())
        files.check_free(overwrite=self.overwrite)
        with shown_stages() as on_stage:
            time_s, reading, reference = _record(self, sensor, on_stage)
        outcome = fit_relaxation(time_s, reading, reference)
        record = RelaxationRecord(sensor, outcome, time_s, reading, reference)
        return conclude(
            outcome, record.report, files.report, lambda: files.write(record.new_sensor)
        )


def _record(
    arguments: Relaxation, sensor: SensorDescription, on_stage: OnProgress
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64] | float | None]:
    """A press over time: s, reading and true force into the gel, (n,) N; NaN where not known."""
    from cmp_tactile_bringup.calibration.gel_recording import read_motion
    from cmp_tactile_bringup.calibration.loads import STANDARD_GRAVITY, read_wrench
    from cmp_tactile_bringup.calibration.reference_sensor import zeroed
    from cmp_tactile_bringup.recordings.library import recorded_source
    from cmp_tactile_bringup.terminal import print_findings

    series = None
    if arguments.wrench_topic:
        series = read_wrench(recorded_source(arguments.input, on_stage), arguments.wrench_topic)
    motion = read_motion(arguments.input, sensor, arguments.topic, None, on_stage)
    print_findings(motion.findings)
    reference: NDArray[np.float64] | float | None = None
    if arguments.mass:
        reference = arguments.mass * STANDARD_GRAVITY
    elif series is not None:
        on_gel = sources.force_at_frames(arguments, sensor, motion, series)
        reference = -zeroed(motion, on_gel).force[:, 2]
    return motion.time_s, _reading(motion, sensor, on_stage), reference


def _reading(
    motion: GelMotion, sensor: SensorDescription, on_stage: OnProgress
) -> NDArray[np.float64]:
    """Force into the gel as the elastic model alone shows it, (n,) N."""
    import numpy as np

    from cmp_tactile_processing.force.model import ForceModel

    model = ForceModel(sensor)
    reading = np.full(len(motion.stamp_ns), np.nan)
    for frame, displacement in enumerate(motion.displacement):
        on_stage("reading the force", frame / len(reading))
        reading[frame] = -model.reconstruct(displacement, motion.status[frame]).wrench[2]
    on_stage("reading the force", 1.0)
    return reading
