"""`cmp_tactile replay`: a recording into the nodes of one sensor, until Ctrl-C."""

from __future__ import annotations

import argparse
import os
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
        description="Start the nodes of one sensor in a component container and play bags, "
        "videos or folders of images into them. Ctrl-C ends it. The same as `ros2 launch "
        "cmp_tactile_bringup replay.launch.py`, without needing launch. Two fingers are replayed "
        "by `cmp_tactile gripper left_source:=replay right_source:=replay ...`, which begins both "
        "at once.",
    )
    parser.add_argument(
        "inputs",
        nargs="+",
        metavar="INPUT",
        help="bag, folder of images, image, video, or name of a packaged scene, such as grasp; "
        "several are played one after the other",
    )
    parser.add_argument(
        "--sensor",
        help="sensor description, file or packaged name; simulated recordings know their own",
    )
    parser.add_argument(
        "--rate",
        type=number_between(0.01, 100),
        default=1.0,
        metavar="SPEED",
        help="1, the default, is as recorded",
    )
    seconds = number_between(0, 1e6, "s")
    parser.add_argument("--start", type=seconds, default=0.0, metavar="S", help="begin there")
    parser.add_argument(
        "--end", type=seconds, default=0.0, metavar="S", help="end there (default: with the last)"
    )
    parser.add_argument("--loop", action="store_true", help="begin again at the end")
    parser.add_argument(
        "--paused", action="store_true", help="begin paused, until replay/pause is called"
    )
    parser.add_argument(
        "--topic", default="", metavar="NAME", help="image topic of a bag that has several"
    )
    parser.add_argument(
        "--namespace", default="", metavar="NAME", help="instead of the sensor's name"
    )
    parser.add_argument(
        "--no-clock", action="store_true", help="leave /clock to the replay of another sensor"
    )
    add_graph_options(parser)
    parser.set_defaults(run=run, usage_error=parser.error)


def run(arguments: argparse.Namespace) -> int:
    """Run the graph "replay" in this process."""
    from cmp_tactile_bringup.container import executables
    from cmp_tactile_bringup.recordings.library import RecordingError, check_source, required_sensor

    sources = [Path(word) for word in arguments.inputs if ":=" not in word]
    assignments = [word for word in arguments.inputs if ":=" in word]
    if not sources:
        arguments.usage_error("found no INPUT")
    for source in sources:
        check_source(source)
        if os.pathsep in str(source):
            msg = f"{source}: found {os.pathsep!r} in it, expected a path without"
            raise RecordingError(msg)
    values = {
        "input": os.pathsep.join(str(source.expanduser()) for source in sources),
        "sensor": required_sensor(sources[0], arguments.sensor, *sources[1:]),
        "start": f"{arguments.start:g}" if arguments.start else "",
        "end": f"{arguments.end:g}" if arguments.end else "",
        "paused": str(arguments.paused).lower(),
        "rate": str(arguments.rate),
        "loop": str(arguments.loop).lower(),
        "topic": arguments.topic,
        "namespace": arguments.namespace,
        "publish_clock": str(not arguments.no_clock).lower(),
    }
    given = [f"{name}:={value}" for name, value in values.items() if value]
    return executables.standalone(
        ["replay", *given, *assignments, "--watch", *graph_options(arguments)]
    )
