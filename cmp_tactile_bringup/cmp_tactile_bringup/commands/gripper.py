"""`cmp_tactile gripper`: the sensors of two fingers, until Ctrl-C."""

from __future__ import annotations

import argparse
from typing import Any

from cmp_tactile_bringup.commands.graph_options import add_graph_parser

__all__ = ["add_parser"]

DESCRIPTION = """\
Start the sensors of a left and a right finger in one component container. Each has a source of its
own: simulated (the default), replay or v4l2 (a camera):

  cmp_tactile gripper left_source:=v4l2 left_device:=/dev/video0 left_sensor:=left.yaml \\
                      right_source:=v4l2 right_device:=/dev/video2 right_sensor:=right.yaml

Two replays begin at the same time.

Ctrl-C ends it. The same as `ros2 launch cmp_tactile_bringup gripper.launch.py`, without needing
launch; --show-args lists the arguments.
"""


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    add_graph_parser(subcommands, common, "gripper", "run the sensors of two fingers", DESCRIPTION)
