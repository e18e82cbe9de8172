"""What the subcommands that start a graph have in common: its arguments and parameters."""

from __future__ import annotations

import argparse
from typing import Any

__all__ = ["ASSIGNMENTS", "add_graph_options", "add_graph_parser", "graph_options"]

# Where they are kept.
ASSIGNMENTS = "assignments"


def add_graph_options(parser: argparse.ArgumentParser) -> None:
    """Add NAME:=VALUE, --set and --show-args."""
    parser.add_argument(
        ASSIGNMENTS,
        nargs="*",
        metavar="NAME:=VALUE",
        help="arguments as of the launch file, such as record:=my_bag; see --show-args",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="COMPONENT.PARAMETER=VALUE",
        help="set a parameter of a component; may be repeated",
    )
    parser.add_argument("--show-args", action="store_true", help="list all arguments and end")


def graph_options(arguments: argparse.Namespace) -> list[str]:
    """What was given of them, as `standalone` takes it."""
    settings = [word for assignment in arguments.set for word in ("--set", assignment)]
    show = ["--show-args"] if arguments.show_args else []
    return [*getattr(arguments, ASSIGNMENTS), *settings, *show]


def add_graph_parser(
    subcommands: Any, common: argparse.ArgumentParser, graph: str, summary: str, description: str
) -> None:
    """Add a subcommand of the graph's name that starts it as its launch file does."""
    parser = subcommands.add_parser(
        graph,
        parents=[common],
        help=summary,
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_graph_options(parser)

    def run(arguments: argparse.Namespace) -> int:
        from cmp_tactile_bringup.container import executables

        # Of real sensors: another machine may want the results.
        return executables.standalone([graph, *graph_options(arguments)], local=False)

    parser.set_defaults(run=run)
