"""Keys that are pressed while a command runs."""

from __future__ import annotations

import os
import re
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

LEFT, RIGHT = "left", "right"
ARROWS = {"D": LEFT, "C": RIGHT}
# How soon the reading ends, s.
POLL_S = 0.1
# An arrow, a lone escape, or a letter; not the beginning of an arrow whose rest is to come.
_KEY = re.compile(r"\x1b[\[O][\d;]*([A-Za-z~])|\x1b(?![\[O]|\Z)|[^\x1b]")


def takes_keys(stream: TextIO | None) -> bool:
    """Whether somebody may press keys: it is a terminal, and this process is in its foreground."""
    try:
        return stream is not None and stream.isatty() and _is_foreground(stream.fileno())
    except (OSError, ValueError):  # closed
        return False


@contextmanager
def pressed_keys(on_key: Callable[[str], object], stream: TextIO | None = None) -> Iterator[None]:
    """While it lasts, `on_key` gets each key from a thread: a letter, or one of ARROWS.

    Nothing is read, and nothing set, where the stream (stdin) is no terminal, or that of others.
    At the end the terminal is as it was.  Ctrl-C goes on to be a signal.
    """
    stream = sys.stdin if stream is None else stream
    if not takes_keys(stream):
        yield
        return
    number = stream.fileno()
    before = termios.tcgetattr(number)
    ended = threading.Event()
    tty.setcbreak(number, termios.TCSANOW)
    reader = threading.Thread(target=_read, args=(number, on_key, ended), name="keys", daemon=True)
    reader.start()
    try:
        yield
    finally:
        ended.set()
        reader.join()
        _set(number, before)


def _read(number: int, on_key: Callable[[str], object], ended: threading.Event) -> None:
    text, ours = "", True
    while not ended.is_set():
        if not _is_foreground(number):  # stopped by Ctrl-Z, then sent to the background
            ours = ended.wait(POLL_S)
            continue
        if not ours:
            tty.setcbreak(number, termios.TCSANOW)
            ours = True
        if not select.select([number], [], [], POLL_S)[0]:
            continue
        try:
            read = os.read(number, 64)
        except OSError:
            return
        if not read:  # the terminal is gone
            return
        text += read.decode(errors="ignore")
        while key := _KEY.match(text):
            text = text[key.end() :]
            on_key(ARROWS.get(key[1], "") if key[1] else key[0])


def _is_foreground(number: int) -> bool:
    """Whether reading or setting the terminal does not stop this process."""
    try:
        return os.tcgetpgrp(number) == os.getpgrp()
    except OSError:
        return False


def _set(number: int, attributes: list[Any]) -> None:
    if _is_foreground(number):
        with suppress(termios.error):  # the terminal is gone
            termios.tcsetattr(number, termios.TCSANOW, attributes)
