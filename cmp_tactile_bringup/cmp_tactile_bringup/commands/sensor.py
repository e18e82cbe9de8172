"""`cmp_tactile sensor`: a camera into the nodes of one sensor, until Ctrl-C."""

from __future__ import annotations

import argparse
from typing import Any

from cmp_tactile_bringup.commands.graph_options import add_graph_parser

__all__ = ["add_parser"]

DESCRIPTION = """\
Start a camera and the nodes of its sensor in a component container:

  cmp_tactile sensor sensor:=my_sensor.yaml device:=/dev/video0

Ctrl-C ends it. The same as `ros2 launch cmp_tactile_bringup sensor.launch.py`, without needing
launch; --show-args lists the arguments.
"""


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    add_graph_parser(subcommands, common, "sensor", "run a sensor with a camera", DESCRIPTION)
