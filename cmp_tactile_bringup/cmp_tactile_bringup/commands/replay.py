"""`cmp_tactile replay`: a recording into the nodes of one sensor, until Ctrl-C."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.commands.argument_types import number_between
from cmp_tactile_bringup.commands.graph_options import add_graph_options, graph_options

__all__ = ["add_parser", "run"]


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "replay",
        parents=[common],
        help="play a recording into the nodes, for RViz and your own nodes",
        description="Start the nodes of one sensor in a component container and play a bag or a "
        "folder of images into them. Ctrl-C ends it. The same as `ros2 launch cmp_tactile_bringup "
        "replay.launch.py`, without needing launch. To replay several sensors at once, give each "
        "a name (name:=left_finger): namespace and tf frames are made from it.",
    )
    parser.add_argument(
        "input", help="bag, folder of images, or name of a packaged scene, such as grasp"
    )
    parser.add_argument(
        "--sensor",
        help="sensor description, file or packaged name; simulated recordings know their own",
    )
    parser.add_argument(
        "--rate", type=number_between(0.01, 100), default=1.0, help="speed, 1 as recorded"
    )
    parser.add_argument("--loop", action="store_true", help="begin again at the end")
    parser.add_argument("--topic", default="", help="image topic of a bag that has several")
    parser.add_argument("--namespace", default="", help="instead of the sensor's name")
    parser.add_argument(
        "--no-clock", action="store_true", help="leave /clock to the replay of another sensor"
    )
    add_graph_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the graph "replay" in this process."""
    from cmp_tactile_bringup import standalone
    from cmp_tactile_bringup.recording import check_source, required_sensor

    source = Path(arguments.input)
    check_source(source, "a ROS 2 bag, a folder of images")
    values = {
        "input": str(source.expanduser()),
        "sensor": required_sensor(source, arguments.sensor),
        "rate": str(arguments.rate),
        "loop": str(arguments.loop).lower(),
        "topic": arguments.topic,
        "namespace": arguments.namespace,
        "publish_clock": str(not arguments.no_clock).lower(),
    }
    given = [f"{name}:={value}" for name, value in values.items() if value]
    return standalone.main(["replay", *given, *graph_options(arguments)])
