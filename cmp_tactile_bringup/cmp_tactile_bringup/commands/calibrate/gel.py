"""`cmp_tactile calibrate gel`: mirrors and gel from frames of the gel at rest."""

from __future__ import annotations

import argparse
from typing import Any

from cmp_tactile_bringup.commands.calibrate.arguments import (
    add_frames,
    add_output,
    check_source_given,
)

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Find where mirrors and gel are from frames of the gel at rest: its own pattern, whose pitch and
surface are known, is the target. Nothing may touch the gel. Focal lengths are found too where the
frames tell them; what they do not tell is held, and named.

Writes NEW.yaml (description of the sensor), NEW_left.yaml and NEW_right.yaml (camera_info of ROS)
only where the result is accepted; NEW_calibration/index.html shows the residuals either way.
"""
EPILOG = """\
examples:
  cmp_tactile calibrate gel rest --sensor board.yaml --output my_sensor.yaml
  cmp_tactile calibrate gel --topic /my_sensor/image_raw --sensor board.yaml --output my_sensor.yaml
"""
FRAMES = 20


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "gel",
        parents=[common],
        help="mirrors and gel from frames of the gel at rest",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_frames(parser, count=FRAMES, sensor_required=True)
    add_output(parser, "description to write, with the camera_info files beside it")
    parser.set_defaults(run=run, wrong_usage=parser.error)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, report, and write what is accepted."""
    from cmp_tactile_bringup.calibration.files import CalibrationFiles
    from cmp_tactile_bringup.commands.calibrate.outcome import conclude, view_pictures, warn
    from cmp_tactile_bringup.commands.calibrate.source import frames_of, prepare_tracker
    from cmp_tactile_bringup.terminal.stages import shown_count, shown_stages
    from cmp_tactile_processing.calibration.gel.calibrate import calibrate_gel
    from cmp_tactile_processing.sensor.library import load_sensor

    check_source_given(arguments)
    sensor = load_sensor(arguments.sensor)
    files = CalibrationFiles.of_sensor(arguments.output, tuple(sensor.views))
    files.check_free(overwrite=arguments.overwrite)
    with shown_stages() as tell:
        frames = frames_of(arguments, sensor, tell)
        prepare_tracker(sensor, tell)
    with shown_count() as count:
        outcome = calibrate_gel(sensor, frames.images, on_progress=count)
    warn(frames.problem)
    return conclude(outcome, files, view_pictures(sensor, frames.images[0]), sensor.name)
