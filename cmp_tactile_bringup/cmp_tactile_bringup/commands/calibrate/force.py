"""`cmp_tactile calibrate force`: the gel's material from known weights or a reference sensor."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cmp_tactile_bringup.commands.argument_types import number_between, whole_between
from cmp_tactile_bringup.commands.calibrate.arguments import add_output, add_timeout
from cmp_tactile_bringup.commands.calibrate.force_arguments import (
    add_gel_knowledge,
    add_wrench_sensor,
    check_gel_knowledge,
    material_options,
)

if TYPE_CHECKING:
    from cmp_tactile_bringup.calibration.gel_recording import GelMotion
    from cmp_tactile_bringup.calibration.wrench_recording import WrenchSeries
    from cmp_tactile_bringup.terminal.stages import Teller
    from cmp_tactile_processing.calibration.material.loads import LoadSample
    from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Find how stiff the gel is, Young's modulus and Poisson's ratio, from weights that are put on it or
from a reference force sensor (geometry_msgs/WrenchStamped) that was recorded beside it. Thickness
and shading layer are as the description has them, unless --fit names them. What was to be fitted
and the loads do not tell is held, its doubt stays in the error bar of every force, and it is named.

Writes NEW.yaml (description of the sensor) only where the result is accepted;
NEW_calibration/index.html shows reference against reading either way.
"""
EPILOG = """\
weights.yaml:
  gravity: 9.81                        # optional, m/s^2; 9.80665 by default
  rest: [0, 0.2]                       # optional: when nothing touches the gel, s from the start
  loads:
    - {mass: 0.2, time: [0.4, 0.6]}    # kg; seconds of INPUT
    - {mass: 0.5, recording: bag_500g} # steady part of another recording
    - {mass: 0.5, std: 0.001, direction: [0, 0.17, -0.98], recording: tilted}
    - {force: [0.5, 0, -2], std: 0.02, time: [3, 4]}    # N on the gel, gel frame

examples:
  cmp_tactile calibrate force my_bag --weights weights.yaml --sensor my_sensor.yaml \\
      --output weighed.yaml
  cmp_tactile calibrate force my_bag --wrench-topic /ft/wrench --wrench-rotation 180 0 0 \\
      --sensor my_sensor.yaml --output weighed.yaml
  cmp_tactile calibrate force --topic /my_sensor/image_raw --mass 0.2 0.5 --sensor my_sensor.yaml \\
      --output weighed.yaml
"""
STILL_FRAMES = 4
LIVE_FRAMES = 20
LIVE_S = 30.0
WEIGHTS, FORCE_SENSOR = "weights", "force_sensor"


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "force",
        parents=[common],
        help="the gel's material from weights or a reference force sensor",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_recording(parser)
    given = parser.add_mutually_exclusive_group(required=True)
    given.add_argument(
        "--weights", type=Path, metavar="FILE.yaml", help="known loads and when they were on"
    )
    given.add_argument("--wrench-topic", metavar="TOPIC", help="of the reference force sensor")
    given.add_argument(
        "--mass",
        nargs="+",
        type=number_between(1e-4, 100, "kg"),
        metavar="KG",
        help="weights that you put on a running sensor, one after another, when you are asked to",
    )
    add_output(parser, "description to write")
    add_wrench_sensor(parser)
    add_gel_knowledge(parser)
    parser.set_defaults(run=run, wrong_usage=parser.error)


def _add_recording(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "input",
        nargs="?",
        type=Path,
        metavar="INPUT",
        help="a ROS 2 bag with images or surfaces, a folder of images, or a packaged scene",
    )
    parser.add_argument(
        "--topic",
        default="",
        metavar="/NS/image_raw",
        help="image or surface topic of a bag that has several; without INPUT, image topic of a "
        "running sensor",
    )
    parser.add_argument(
        "--sensor",
        help="description to start from: its file, or the name of a packaged one; simulated "
        "recordings know their own",
    )
    parser.add_argument(
        "--rest",
        nargs=2,
        type=number_between(0, 1e6, "s"),
        metavar=("FROM", "TO"),
        help="when nothing touches the gel, s from the recording's start (default: from the start "
        "until the gel moves)",
    )
    parser.add_argument(
        "--frames",
        type=whole_between(1, 1000),
        default=STILL_FRAMES,
        metavar="N",
        help="in a row in which the gel must be still to count (default: %(default)s)",
    )
    parser.add_argument(
        "--duration",
        type=number_between(1, 3600, "s"),
        default=LIVE_S,
        metavar="SECONDS",
        help="of running sensors, to be recorded (default: %(default)g)",
    )
    add_timeout(parser)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, report, and write what is accepted."""
    from cmp_tactile_bringup.calibration.files import CalibrationFiles
    from cmp_tactile_bringup.commands.calibrate.force_outcome import conclude_material
    from cmp_tactile_bringup.terminal.stages import shown_count
    from cmp_tactile_processing.calibration.material.calibrate import fit_material

    _check_usage(arguments)
    sensor = _sensor(arguments)
    options = material_options(arguments)
    files = CalibrationFiles.of_sensor(arguments.output, ())
    files.check_free(overwrite=arguments.overwrite)
    samples = _samples(arguments, sensor)
    method = FORCE_SENSOR if arguments.wrench_topic else WEIGHTS
    with shown_count() as count:
        outcome = fit_material(sensor, samples, method, options, on_progress=count)
    return conclude_material(outcome, files, sensor.name)


def _check_usage(arguments: argparse.Namespace) -> None:
    """End with the usage where arguments do not go together."""
    if arguments.mass:
        if arguments.input is not None or not arguments.topic:
            arguments.wrong_usage("--mass needs the --topic of a running sensor, and no INPUT")
        if not sys.stdin.isatty():
            arguments.wrong_usage("--mass asks on the terminal, and stdin is none; see --weights")
    if arguments.wrench_topic and arguments.input is None and not arguments.topic:
        arguments.wrong_usage("--wrench-topic needs INPUT, or the --topic of a running sensor")
    if arguments.input is None and not arguments.sensor:
        arguments.wrong_usage("--sensor is required without INPUT")
    check_gel_knowledge(arguments)
    if arguments.rest and not arguments.rest[0] < arguments.rest[1]:
        arguments.wrong_usage("--rest: FROM must be below TO")


def _sensor(arguments: argparse.Namespace) -> SensorDescription:
    from cmp_tactile_bringup.recordings.library import check_source, required_sensor
    from cmp_tactile_processing.sensor.library import load_sensor

    if arguments.input is None:
        return load_sensor(arguments.sensor)
    check_source(arguments.input, "a ROS 2 bag, a folder of images")
    return load_sensor(required_sensor(arguments.input, arguments.sensor))


def _samples(arguments: argparse.Namespace, sensor: SensorDescription) -> list[LoadSample]:
    from cmp_tactile_bringup.terminal.stages import shown_stages

    if arguments.mass:
        return _live_samples(arguments, sensor)
    with shown_stages() as tell:
        if arguments.weights is not None:
            return _weight_samples(arguments, sensor, tell)
        return _sensor_samples(arguments, sensor, tell)


def _weight_samples(
    arguments: argparse.Namespace, sensor: SensorDescription, tell: Teller
) -> list[LoadSample]:
    from cmp_tactile_bringup.calibration.gel_recording import read_motion
    from cmp_tactile_bringup.calibration.loads import read_known_loads, samples_of_weights
    from cmp_tactile_bringup.commands.calibrate.outcome import warn

    loads, rest = read_known_loads(arguments.weights)
    if arguments.input is None and any(load.recording is None for load in loads):
        arguments.wrong_usage("INPUT is required: a load of --weights has no recording of its own")
    motions = {}
    for recording in dict.fromkeys(load.recording for load in loads):
        source = recording or arguments.input
        # Times of the file and of the options belong to INPUT.
        when = (arguments.rest or rest) if recording is None else None
        motions[recording] = motion = read_motion(source, sensor, arguments.topic, when, tell)
        for doubt in motion.doubts:
            warn(doubt)
    return samples_of_weights(loads, motions, arguments.frames)


def _sensor_samples(
    arguments: argparse.Namespace, sensor: SensorDescription, tell: Teller
) -> list[LoadSample]:
    from cmp_tactile_bringup.calibration.loads import samples_of_sensor
    from cmp_tactile_bringup.commands.calibrate.force_arguments import sampling, wrench_at_frames
    from cmp_tactile_bringup.commands.calibrate.outcome import warn

    motion, series = _motion_and_wrench(arguments, sensor, tell)
    for doubt in motion.doubts:
        warn(doubt)
    on_gel = wrench_at_frames(arguments, sensor, motion, series)
    return samples_of_sensor(motion, on_gel, sampling(arguments))


def _motion_and_wrench(
    arguments: argparse.Namespace, sensor: SensorDescription, tell: Teller
) -> tuple[GelMotion, WrenchSeries]:
    """Of the recording, or of the running sensors where there is none."""
    from cmp_tactile_bringup.calibration.gel_recording import read_motion
    from cmp_tactile_bringup.calibration.wrench_recording import read_wrench
    from cmp_tactile_bringup.recordings.library import recorded_source

    topic, wrench_topic = arguments.topic, arguments.wrench_topic
    if arguments.input is not None:
        # First, as it is soon found to be missing.
        series = read_wrench(recorded_source(arguments.input, tell), wrench_topic)
        return read_motion(arguments.input, sensor, topic, arguments.rest, tell), series
    from cmp_tactile_bringup.calibration.live import LiveReference

    print(f"Recording {arguments.duration:g} s: leave the gel alone for a second, then load it.")
    with LiveReference(sensor, topic, wrench_topic, arguments.timeout) as live:
        return live.record(arguments.duration, tell)


def _live_samples(arguments: argparse.Namespace, sensor: SensorDescription) -> list[LoadSample]:
    from cmp_tactile_bringup.calibration.live import LiveFrames, Weighing
    from cmp_tactile_bringup.commands.calibrate.source import prepare_tracker
    from cmp_tactile_bringup.terminal.stages import shown_stages

    with shown_stages() as tell:
        prepare_tracker(sensor, tell)
    size = (sensor.image.width, sensor.image.height)
    weights = sensor.tracking.grey_weights
    with LiveFrames(arguments.topic, size, arguments.timeout, weights) as live:
        count = max(arguments.frames, LIVE_FRAMES)
        return Weighing(sensor, iter(live), count, input, print).samples(arguments.mass)
