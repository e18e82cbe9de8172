"""The command `cmp_tactile`: one entry for everything that is done from a shell."""

from __future__ import annotations

import io
import os
import signal
import sys
from typing import TYPE_CHECKING

from cmp_tactile_processing.processes import Interruption, ignore_signals

# Nothing that takes time to load: `main` handles signals first.
if TYPE_CHECKING:
    from collections.abc import Sequence

USER_ERROR = 1
INTERRUPTED = 128 + signal.SIGINT


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code.

    A signal leaves it by an exception, so that what was started is ended, too.
    """
    interruption = Interruption()
    # From a shell that does not know the width; rich would print nothing.
    if os.environ.get("COLUMNS") in {"", "0"}:
        del os.environ["COLUMNS"]
    try:
        with interruption:
            for stream in (sys.stdout, sys.stderr):
                if isinstance(stream, io.TextIOWrapper):
                    # What the terminal's encoding lacks, as in a path, is written by its number.
                    stream.reconfigure(errors="backslashreplace")
            return _run(sys.argv[1:] if argv is None else argv, interruption)
    except KeyboardInterrupt as interrupt:
        import ctypes

        # Never freed: a compiler that was left half way may crash as it is (numba/llvmlite 350).
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(interrupt))
        print("stopped", file=sys.stderr)
        return interruption.exit_code or INTERRUPTED
    finally:
        if argv is None:
            ignore_signals()


def _run(words: Sequence[str], interruption: Interruption) -> int:
    debug = False
    try:
        from cmp_tactile_bringup.commands import parse

        subcommand = parse(words)
        debug = subcommand.debug
        return subcommand.run()
    except BrokenPipeError:
        # The reader of the output has gone, as `| head` does; what is left has no use.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except BaseException as error:
        if interruption.number or isinstance(error, KeyboardInterrupt):
            # Also what it caused: typer makes an exit of it, a library in Rust a panic.
            raise KeyboardInterrupt from None
        if isinstance(error, SystemExit):
            raise
        from cmp_tactile_bringup.terminal import error_reason

        if debug:
            import traceback

            traceback.print_exc()
        hint = "" if debug else "; --debug shows where"
        print(f"error: {error_reason(error, hint)}", file=sys.stderr)
        return USER_ERROR


if __name__ == "__main__":
    sys.exit(main())
