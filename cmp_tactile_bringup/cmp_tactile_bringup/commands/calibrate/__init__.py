"""`cmp_tactile calibrate`: camera, mirrors and gel of a sensor, and how stiff its gel is."""

from __future__ import annotations

import argparse
from typing import Any

from cmp_tactile_bringup.commands.calibrate import board as calibrate_board
from cmp_tactile_bringup.commands.calibrate import check as calibrate_check
from cmp_tactile_bringup.commands.calibrate import force as calibrate_force
from cmp_tactile_bringup.commands.calibrate import gel as calibrate_gel
from cmp_tactile_bringup.commands.calibrate import practice as calibrate_practice
from cmp_tactile_bringup.commands.calibrate import relaxation as calibrate_relaxation

__all__ = ["add_parser"]

DESCRIPTION = """\
Find out where camera, mirrors and gel of a sensor really are, and how stiff the gel is.

  board     camera and mirrors from images of a board, before the gel is mounted
  gel       mirrors and gel from frames of the gel at rest, whenever it was mounted anew
  force     the gel's moduli from known weights, or from a force sensor beside it
  relaxation
            how the gel gives way while it is held
  check     whether a description still fits a recording
  practice  a set of simulated frames to try all that on, without a sensor

docs/tutorials/calibrate.md goes through all of it, docs/tutorials/weigh.md through `force`.
"""


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand with those below it."""
    parser = subcommands.add_parser(
        "calibrate",
        help="calibrate a sensor, or check its calibration",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    below = parser.add_subparsers(dest="calibration", required=True, metavar="WHAT")
    for module in (
        calibrate_board,
        calibrate_gel,
        calibrate_force,
        calibrate_relaxation,
        calibrate_check,
        calibrate_practice,
    ):
        module.add_parser(below, common)
