"""The command `cmp_tactile`: one entry for everything that is done from a shell."""

from __future__ import annotations

import errno
import io
import os
import signal
import stat
import sys
from typing import TYPE_CHECKING, Any, TextIO

from cmp_tactile_bringup.terminal.stop_signal import stopping_signals

# Nothing that takes time to load: `main` handles signals first.
if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import FrameType

    from cmp_tactile_bringup.commands.options import Command

USER_ERROR = 1
INTERRUPTED = 128 + signal.SIGINT
# After which an interruption that was dropped is repeated.
REPEAT_S = 0.05


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    with _Interruption(is_process=argv is None) as interruption:
        _repair_standard_streams()
        from cmp_tactile_bringup.commands import parse

        return _run(parse(sys.argv[1:] if argv is None else argv), interruption)


def _repair_standard_streams() -> None:
    """Open those that the shell closed (`>&-`), and let them print every character.

    What is opened next would take the place of a closed one, and be written into by libraries.
    What the terminal's encoding lacks, as in a path, is written by its number.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    sys.stdout = _repaired(sys.stdout or open(1, "w", closefd=False))  # noqa: SIM115
    sys.stderr = _repaired(sys.stderr or open(2, "w", closefd=False))  # noqa: SIM115


def _repaired(stream: TextIO) -> TextIO:
    if not isinstance(stream, io.TextIOWrapper):
        return stream
    raw = getattr(stream.buffer, "raw", stream.buffer)
    # For a closed terminal isatty() is false, but it still is a character device.
    if isinstance(raw, io.FileIO) and stat.S_ISCHR(os.fstat(raw.fileno()).st_mode):
        terminal = io.BufferedWriter(_Terminal(raw.fileno(), "w", closefd=False))
        stream = io.TextIOWrapper(
            terminal,
            stream.encoding,
            line_buffering=True,
            write_through=stream.write_through,
        )
    stream.reconfigure(errors="backslashreplace")
    return stream


class _Terminal(io.FileIO):
    """Lets the work go on where the terminal was closed, as after `disown`."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return len(data)


class _Interruption:
    """What SIGINT, SIGTERM and SIGHUP do to the command; a context manager.

    Until the subcommand begins, they end the process at once.  Then they leave it by an exception,
    so that what was started is ended too; that is raised again where Python drops it, in a
    finaliser, and stands before an error that it causes in what is being loaded.
    """

    def __init__(self, *, is_process: bool) -> None:
        """is_process: nothing comes after it, and a late signal changes nothing."""
        self.has_begun = False
        self.number = 0
        self._is_process = is_process
        self._earlier: dict[int, Any] = {}
        self._show_unraisable = sys.unraisablehook

    def __enter__(self) -> _Interruption:
        for number in stopping_signals():
            self._earlier[number] = signal.signal(number, self._on_signal)
        self._earlier[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._on_alarm)
        sys.unraisablehook = self._on_dropped
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._earlier.items():
            signal.signal(number, signal.SIG_IGN if self._is_process else handler)
        sys.unraisablehook = self._show_unraisable

    @property
    def exit_code(self) -> int:
        """That of the signal that came; 0 for none."""
        return self.number and 128 + self.number

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        if number == self.number == signal.SIGHUP:
            return  # a shell and the kernel send one each
        self.number = number
        if not self.has_begun:
            try:
                os.write(2, b"stopped\n")
            finally:
                os._exit(self.exit_code)
        self._on_alarm()

    def _on_alarm(self, *_: object) -> None:
        if self.number == signal.SIGINT:
            raise KeyboardInterrupt
        if self.number:
            sys.exit(self.exit_code)

    def _on_dropped(self, dropped: sys.UnraisableHookArgs) -> None:
        if self.number and issubclass(dropped.exc_type, (KeyboardInterrupt, SystemExit)):
            signal.setitimer(signal.ITIMER_REAL, REPEAT_S)
        else:
            self._show_unraisable(dropped)


def _run(subcommand: Command, interruption: _Interruption) -> int:
    try:
        interruption.has_begun = True
        return subcommand.run()
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return INTERRUPTED
    except SystemExit as ended:
        if interruption.number and ended.code == interruption.exit_code:
            print("stopped", file=sys.stderr)
        raise
    except BrokenPipeError:
        # The reader of the output has gone, as `| head` does; what is left has no use.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:  # noqa: BLE001  the edge: whatever it is, the user gets one line
        if interruption.number:
            print("stopped", file=sys.stderr)
            return interruption.exit_code
        from cmp_tactile_bringup.terminal.output import error_line

        if subcommand.debug:
            import traceback

            traceback.print_exc()
        hint = "" if subcommand.debug else "; --debug shows where"
        print(error_line(error, hint), file=sys.stderr)
        return USER_ERROR


if __name__ == "__main__":
    sys.exit(main())
