"""The command `cmp_tactile`: one entry for everything that is done from a shell."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import traceback
from collections.abc import Sequence

from cmp_tactile_bringup.commands import (
    calibrate,
    demo,
    gripper,
    info,
    live,
    pattern,
    process,
    record,
    replay,
    sensor,
    simulate,
)
from cmp_tactile_bringup.commands.error_line import error_line
from cmp_tactile_bringup.commands.graph_options import ASSIGNMENTS

__all__ = ["build_parser", "main"]

USER_ERROR = 1
INTERRUPTED = 128 + signal.SIGINT
TERMINATED = 128 + signal.SIGTERM

EPILOG = """\
exit codes:
  0    done
  1    something that you can mend: a wrong file, a limit that was missed
  2    a wrong option
  130  stopped by Ctrl-C, 143 by SIGTERM; those that these end (live, sensor, gripper,
       record, replay) have 0
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of the command and all its subcommands."""
    parser = argparse.ArgumentParser(
        prog="cmp_tactile",
        description="Vision-based tactile sensors with a continuous marker pattern.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")
    subcommands = parser.add_subparsers(dest="subcommand", required=True, metavar="COMMAND")
    modules = (demo, live, sensor, gripper, simulate, process, record, replay, calibrate, pattern)
    for module in (*modules, info):
        module.add_parser(subcommands, common)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = _parse(argv)
    # Leave by the same way as on Ctrl-C, so that what was started is ended too.
    earlier = signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    try:
        return _run(arguments)
    finally:
        signal.signal(signal.SIGTERM, earlier)


def _parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """The arguments; argparse takes no positional ones any more once an option came."""
    parser = build_parser()
    arguments, late = parser.parse_known_args(argv)
    if late and not (hasattr(arguments, ASSIGNMENTS) and all(":=" in word for word in late)):
        parser.error(f"unrecognized arguments: {' '.join(late)}")
    if late:
        getattr(arguments, ASSIGNMENTS).extend(late)
    return arguments


def _run(arguments: argparse.Namespace) -> int:
    try:
        return int(arguments.run(arguments))
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of the output has gone, as `| head` does; what is left has no use.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:  # noqa: BLE001  the edge: whatever it is, the user gets one line
        if arguments.debug:
            traceback.print_exc()
        hint = "" if arguments.debug else "; --debug shows where"
        print(error_line(error, hint), file=sys.stderr)
        return USER_ERROR


if __name__ == "__main__":
    sys.exit(main())
