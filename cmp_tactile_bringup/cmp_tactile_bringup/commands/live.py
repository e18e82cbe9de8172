"""`cmp_tactile live`: a simulated sensor in place of a camera, until Ctrl-C."""

from __future__ import annotations

import argparse
from typing import Any

from cmp_tactile_bringup.commands.argument_types import number_between
from cmp_tactile_bringup.commands.graph_options import add_graph_options, graph_options

__all__ = ["add_parser", "run"]

DESCRIPTION = """\
Start the nodes of one sensor in a component container with a simulated sensor in place of a camera.
Its indenter plays the scene until it is moved by hand:

  topic   NAMESPACE/indenter/target   geometry_msgs/PoseStamped, gel frame
  topic   NAMESPACE/indenter/load     geometry_msgs/WrenchStamped, gel frame, force.z < 0
  service NAMESPACE/indenter/reset    std_srvs/Trigger, back to the beginning

What is true of each frame comes on NAMESPACE/truth/... . Ctrl-C ends it. The same as
`ros2 launch cmp_tactile_bringup simulate.launch.py`, without needing launch.
"""


def add_parser(subcommands: Any, common: argparse.ArgumentParser) -> None:
    """Add this subcommand."""
    parser = subcommands.add_parser(
        "live",
        parents=[common],
        help="simulate a sensor in real time, to be pressed by hand",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "scene",
        nargs="?",
        default="grasp",
        help="scene file or name of a packaged scene (default: %(default)s)",
    )
    parser.add_argument(
        "--sensor", help="sensor description, file or packaged name, instead of the scene's own"
    )
    parser.add_argument(
        "--frame-rate",
        type=number_between(0.1, 1000, "Hz"),
        metavar="HZ",
        help="frames per second that are aimed at (20, or the scene's own if that is lower)",
    )
    parser.add_argument(
        "--max-speed",
        type=number_between(1e-5, 1.0, "m/s"),
        default=0.01,
        metavar="M/S",
        help="of the indenter towards a target (%(default)g)",
    )
    parser.add_argument(
        "--no-autoplay", action="store_true", help="hold still until a target or load comes"
    )
    parser.add_argument("--namespace", default="", help="instead of the sensor's name")
    add_graph_options(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the graph "simulate" in this process."""
    from cmp_tactile_bringup.container import executables

    values = {
        "scene": arguments.scene,
        "sensor": arguments.sensor,
        "frame_rate": arguments.frame_rate,
        "max_speed": arguments.max_speed,
        "autoplay": str(not arguments.no_autoplay).lower(),
        "namespace": arguments.namespace,
    }
    given = [f"{key}:={value}" for key, value in values.items() if value]
    return executables.standalone(["simulate", *given, "--watch", *graph_options(arguments)])
