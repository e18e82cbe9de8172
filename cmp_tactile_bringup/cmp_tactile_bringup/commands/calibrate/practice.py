"""`cmp_tactile calibrate practice`: simulated images to calibrate from, without a sensor."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.commands.argument_types import whole_between

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Make a set of simulated images of a rig that was built not quite as described: gel and mirrors are
turned by 1 degree and shifted by 0.5 mm, the focal length is 1 % off, each in an unknown direction.

  DIR/sensor.yaml   the description to start from
  DIR/board/        images of a board, taken before the gel was mounted
  DIR/rest/         frames of the gel at rest
  DIR/contact/      a recording of a contact, with what is true of it
  DIR/truth/        the rig as it is: not to be looked at until the end
"""
EPILOG = """\
example:
  cmp_tactile calibrate practice --output practice
"""
MAX_SEED = 2**31 - 1


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "practice",
        parents=[common],
        help="simulated images to practise on, without a sensor",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to write")
    parser.add_argument(
        "--sensor",
        default="sample_rig",
        help="the description that the rig was built by, file or packaged name "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--seed",
        type=whole_between(0, MAX_SEED),
        metavar="N",
        help="makes the same set again (default: another one each time)",
    )
    parser.add_argument(
        "--images",
        type=whole_between(3, 200),
        default=20,
        metavar="N",
        help="of the board (default: %(default)s)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier practice set")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Make the set and say what is in it."""
    import secrets

    from cmp_tactile_bringup.calibration.practice_set import PracticeSet, make_practice_set
    from cmp_tactile_bringup.terminal.stages import shown_stages
    from cmp_tactile_processing.sensor.library import load_sensor

    seed = secrets.randbelow(MAX_SEED) if arguments.seed is None else arguments.seed
    practice = PracticeSet(load_sensor(arguments.sensor), seed, arguments.images)
    folder = arguments.output.expanduser()
    with shown_stages() as tell:
        make_practice_set(practice, folder, tell, overwrite=arguments.overwrite)
    target = practice.target
    board = f"--board {target.cols}x{target.rows} --square {target.square:g}"
    print(f"Practice set in {folder}: docs/tutorials/calibrate.md goes through it.")
    print(f"  cmp_tactile calibrate check {folder}/contact --sensor {folder}/sensor.yaml")
    print(
        f"  cmp_tactile calibrate board {folder}/board --sensor {folder}/sensor.yaml {board} "
        "--output board.yaml"
    )
    print(f"  cmp_tactile calibrate gel {folder}/rest --sensor board.yaml --output my_sensor.yaml")
    print(f"  cmp_tactile calibrate check {folder}/contact --sensor my_sensor.yaml")
    return 0
