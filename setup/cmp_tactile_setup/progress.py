"""What the user sees of the set-up: one line per step, with its duration."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

_POLL_S = 0.2
_SIGN_OF_LIFE_S = 30.0


def say(text: str) -> None:
    """Print one line of the set-up."""
    print(f"set-up: {text}", flush=True)


def run_step(
    title: str, command: Sequence[str], log: Path, env: Mapping[str, str], cwd: Path
) -> bool:
    """Run a command with its output in `log`, showing the title and the time; True if it succeeds.

    An interruption (Ctrl-C) ends the command, too.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    started = time.monotonic()
    terminal = sys.stdout.isatty()
    next_sign = _SIGN_OF_LIFE_S
    if not terminal:
        say(f"{title} ...")
    with log.open("wb") as output:
        process = subprocess.Popen(
            command,
            stdout=output,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env=dict(env),
            cwd=cwd,
        )
        try:
            while process.poll() is None:
                elapsed = time.monotonic() - started
                if terminal:
                    print(f"\rset-up: {title} ... {elapsed:.0f} s", end="", flush=True)
                elif elapsed > next_sign:
                    say(f"{title} ... {elapsed:.0f} s")
                    next_sign += _SIGN_OF_LIFE_S
                time.sleep(_POLL_S)
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait()
    if terminal:
        print("\r\033[K", end="")
    outcome = "done" if process.returncode == 0 else "FAILED"
    say(f"{title}: {outcome} in {time.monotonic() - started:.0f} s")
    return process.returncode == 0
