"""Arguments that the calibrations share: where frames come from, where results go."""

from __future__ import annotations

import argparse
from pathlib import Path

from cmp_tactile_bringup.commands.argument_types import number_between, whole_between

__all__ = ["LIVE", "add_frames", "add_output", "check_source_given"]

LIVE = "live from this topic where no INPUT is given; image topic of a bag that has several"
MAX_FRAMES = 100_000


def add_frames(
    parser: argparse.ArgumentParser, *, count: int | None, sensor_required: bool
) -> None:
    """INPUT or --topic, the sensor, and which frames.  count: default of --frames."""
    parser.add_argument(
        "input",
        nargs="?",
        type=Path,
        metavar="INPUT",
        help="a ROS 2 bag, a folder of images, or a packaged scene, such as grasp",
    )
    parser.add_argument("--topic", default="", metavar="/NS/image_raw", help=LIVE)
    parser.add_argument(
        "--sensor",
        required=sensor_required,
        help="description to start from: its file, or the name of a packaged one",
    )
    parser.add_argument(
        "--frames",
        type=whole_between(1, MAX_FRAMES),
        default=count,
        metavar="N",
        help="use at most N frames " + (f"(default: {count})" if count else "(default: all)"),
    )
    parser.add_argument(
        "--start",
        type=number_between(0, 1e6, "s"),
        default=0.0,
        metavar="SECONDS",
        help="leave out the beginning of a recording (default: %(default)g)",
    )
    add_timeout(parser)


def add_timeout(parser: argparse.ArgumentParser) -> None:
    """--timeout of a live topic."""
    parser.add_argument(
        "--timeout",
        type=number_between(0.1, 3600, "s"),
        default=10.0,
        metavar="SECONDS",
        help="how long to wait for a frame of a live topic (default: %(default)g)",
    )


def add_output(parser: argparse.ArgumentParser, what: str) -> None:
    """--output and --overwrite."""
    parser.add_argument("--output", type=Path, required=True, metavar="NEW.yaml", help=what)
    parser.add_argument(
        "--overwrite", action="store_true", help="replace results that are there already"
    )


def check_source_given(arguments: argparse.Namespace) -> None:
    """End with the usage unless there is an input or a topic."""
    if arguments.input is None and not arguments.topic:
        arguments.wrong_usage("INPUT or --topic is required")
