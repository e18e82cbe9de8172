"""`cmp_tactile calibrate relaxation`: how the gel gives way while it is held."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cmp_tactile_bringup.commands.argument_types import number_between
from cmp_tactile_bringup.commands.calibrate.arguments import add_output
from cmp_tactile_bringup.commands.calibrate.force_arguments import add_wrench_sensor

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cmp_tactile_bringup.calibration.gel_recording import GelMotion
    from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Find how much of its stiffness the gel loses while it is pressed, and how fast, from a recording
that begins with the gel untouched and recovered; then it is loaded within a moment, and held for
some time constants. With --mass a weight rests on it and the gel creeps; with --wrench-topic a
force sensor tells the load, also while the gel is held at one depth. Where the load is known, the
stiffness of a quick press comes out, too.

Writes NEW.yaml (description of the sensor) only where the result is accepted;
NEW_calibration/index.html shows the record either way.
"""
EPILOG = """\
examples:
  cmp_tactile calibrate relaxation my_bag --mass 0.5 --sensor weighed.yaml --output my_sensor.yaml
  cmp_tactile calibrate relaxation my_bag --wrench-topic /ft/wrench --sensor weighed.yaml \\
      --output my_sensor.yaml
"""


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "relaxation",
        parents=[common],
        help="how the gel gives way while it is held",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "input", type=Path, metavar="INPUT", help="a ROS 2 bag with images or surfaces, or a scene"
    )
    parser.add_argument(
        "--topic", default="", metavar="/NS/image_raw", help="of a bag that has several"
    )
    parser.add_argument(
        "--sensor",
        help="description to start from: its file, or the name of a packaged one; simulated "
        "recordings know their own",
    )
    load = parser.add_mutually_exclusive_group()
    load.add_argument(
        "--mass",
        type=number_between(1e-4, 100, "kg"),
        metavar="KG",
        help="of the weight that rests on the gel",
    )
    load.add_argument("--wrench-topic", metavar="TOPIC", help="of a reference force sensor")
    add_output(parser, "description to write")
    add_wrench_sensor(parser, samples=False)
    parser.set_defaults(run=run, wrong_usage=parser.error)


@dataclass(frozen=True)
class _Record:
    """A press over time: reading and true force into the gel, (n,) N; NaN where not known."""

    time_s: NDArray[np.float64]
    reading: NDArray[np.float64]
    reference: NDArray[np.float64] | float | None


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, report, and write what is accepted."""
    from cmp_tactile_bringup.calibration.files import CalibrationFiles
    from cmp_tactile_bringup.commands.calibrate.outcome import estimates_table, tell_end
    from cmp_tactile_bringup.recordings.library import check_source, required_sensor
    from cmp_tactile_bringup.report.calibration.relaxation_page import (
        RelaxationReport,
        write_relaxation_report,
    )
    from cmp_tactile_bringup.terminal.stages import shown_stages
    from cmp_tactile_bringup.terminal.tables import output_console
    from cmp_tactile_processing.calibration.material.relaxation import fit_relaxation
    from cmp_tactile_processing.sensor.library import load_sensor

    check_source(arguments.input, "a ROS 2 bag, a folder of images")
    sensor = load_sensor(required_sensor(arguments.input, arguments.sensor))
    files = CalibrationFiles.of_sensor(arguments.output, ())
    files.check_free(overwrite=arguments.overwrite)
    with shown_stages() as tell:
        record = _record(arguments, sensor, tell)
    outcome = fit_relaxation(record.time_s, record.reading, record.reference)
    report = RelaxationReport(sensor, outcome, record.time_s, record.reading, record.reference)
    page = write_relaxation_report(report, files.report)
    console = output_console()
    console.print(estimates_table(report.estimates))
    return tell_end(console, outcome, page, lambda: files.write_sensor(report.new_sensor))


def _record(arguments: argparse.Namespace, sensor: SensorDescription, tell: Any) -> _Record:
    from cmp_tactile_bringup.calibration.gel_recording import read_motion
    from cmp_tactile_bringup.calibration.loads import STANDARD_GRAVITY, zeroed
    from cmp_tactile_bringup.calibration.wrench_recording import read_wrench
    from cmp_tactile_bringup.commands.calibrate.force_arguments import wrench_at_frames
    from cmp_tactile_bringup.commands.calibrate.outcome import warn
    from cmp_tactile_bringup.recordings.library import recorded_source

    series = None
    if arguments.wrench_topic:
        series = read_wrench(recorded_source(arguments.input, tell), arguments.wrench_topic)
    motion = read_motion(arguments.input, sensor, arguments.topic, None, tell)
    for doubt in motion.doubts:
        warn(doubt)
    reference: NDArray[np.float64] | float | None = None
    if arguments.mass:
        reference = arguments.mass * STANDARD_GRAVITY
    elif series is not None:
        on_gel = wrench_at_frames(arguments, sensor, motion, series)
        reference = -zeroed(on_gel, motion.rest)[:, 2]
    return _Record(motion.time_s, _reading(motion, sensor, tell), reference)


def _reading(motion: GelMotion, sensor: SensorDescription, tell: Any) -> NDArray[np.float64]:
    """Force into the gel as the elastic model alone shows it, (n,) N."""
    import numpy as np

    from cmp_tactile_processing.force.model import ForceModel

    model = ForceModel(sensor)
    reading = np.full(len(motion.stamp_ns), np.nan)
    for frame, displacement in enumerate(motion.displacement):
        tell("reading the force", frame / len(reading))
        reading[frame] = -model.reconstruct(displacement, motion.status[frame]).wrench[2]
    tell("reading the force", 1.0)
    return reading
