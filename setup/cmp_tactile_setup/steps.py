"""Steps of the set-up: what the user sees of them, their records, and what stops them."""

from __future__ import annotations

import hashlib
import json
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

_SIGN_OF_LIFE_S = 15.0
_LAST_LINES = 5


class SetupError(Exception):
    """Something that the user has to put right; its text says what and how."""


def say(text: str) -> None:
    """Print one line of the set-up."""
    print(f"set-up: {text}", flush=True)


def run_step(
    title: str, command: Sequence[str], log: Path, env: Mapping[str, str], cwd: Path
) -> bool:
    """Run a command with its output in `log`, showing the title and the time; True if it succeeds.

    An interruption (Ctrl-C) ends the command, too.
    """
    with started_command(command, log, env, cwd) as process:
        return wait_for_step(title, process)


def failure(title: str, log: Path) -> SetupError:
    """The error of a step that failed, with the last lines of its log."""
    lines = log.read_text(errors="replace").splitlines()[-_LAST_LINES:]
    return SetupError("\n".join([f"{title} failed (log: {log})", *lines]))


@contextmanager
def started_command(
    command: Sequence[str], log: Path, env: Mapping[str, str], cwd: Path
) -> Iterator[subprocess.Popen[bytes]]:
    """A command that runs with its output in `log`; it is ended where the block is left early."""
    log.parent.mkdir(parents=True, exist_ok=True)
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
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait()


def wait_for_step(title: str, process: subprocess.Popen[bytes]) -> bool:
    """Show the title and the time until the process ends; True if it succeeds."""
    started = time.monotonic()
    say(f"{title} ...")
    while True:
        with suppress(subprocess.TimeoutExpired):
            process.wait(_SIGN_OF_LIFE_S)
        elapsed = f"{time.monotonic() - started:.0f} s"
        if process.returncode is not None:
            break
        say(f"{title} ... {elapsed}")
    say(f"{title}: {'FAILED' if process.returncode else 'done'} in {elapsed}")
    return process.returncode == 0


def read_record(path: Path) -> dict[str, Any]:
    """The record, or an empty one if there is none or it cannot be read."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def write_record(path: Path, record: dict[str, Any]) -> None:
    """Write the record in one step, so that an interruption leaves no half of it."""
    replace_file(path, json.dumps(record, indent=1, sort_keys=True))


def replace_file(path: Path, text: str) -> None:
    """Write a file in one step, so that an interruption leaves the old or the new one."""
    temporary = path.with_name(f"{path.name}.new")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)


def digest(contents: Iterable[Path], names: Iterable[Path], root: Path) -> str:
    """Hash of the contents of some files and of the names alone of others, relative to root."""
    total = hashlib.sha256()
    for path in sorted(contents):
        total.update(path.relative_to(root).as_posix().encode() + b"\0")
        total.update(hashlib.sha256(path.read_bytes()).digest())
    for path in sorted(names):
        total.update(path.relative_to(root).as_posix().encode() + b"\0")
    return total.hexdigest()
