"""Errors that the package raises on purpose, and findings: what was survived, and is reported.

Any other error is a bug.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from itertools import islice
from math import inf
from typing import Any


def printable(text: str) -> str:
    """A text that people gave as one line: what would steer a terminal is shown as its escape."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def found_text(value: object) -> str:
    """A value as an error shows it: cut before it is written, whatever its size."""
    return shortened(_REPR.repr(value))


def shortened(text: str, length: int = 80) -> str:
    """A text of at most so many letters."""
    return text if len(text) <= length else text[: length - 3] + "..."


class _Repr(reprlib.Repr):
    """Of a mapping the first keys in their order."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlist = self.maxtuple = self.maxdict = 12
        self.maxlevel = 4
        self.maxstring = self.maxother = self.maxlong = 200

    def repr_str(self, x: str, level: int) -> str:  # noqa: ARG002  the base class has it
        return repr(x[: self.maxstring])

    def repr_dict(self, x: dict[Any, Any], level: int) -> str:
        if level <= 0:
            return "{...}"
        first = islice(x.items(), self.maxdict)
        items = [f"{self.repr1(k, level - 1)}: {self.repr1(v, level - 1)}" for k, v in first]
        return "{" + ", ".join(items) + "}"


_REPR = _Repr()


class Severity(IntEnum):
    """ERROR: the result, or a part of it, must not be used.  WARNING: it is worse than it could be.

    The values are the levels of diagnostic_msgs/DiagnosticStatus.
    """

    OK = 0
    WARNING = 1
    ERROR = 2


@dataclass(frozen=True)
class Finding:
    """Something that a user should know of data, a result or a node; nothing where text is empty.

    advice: what to do about it.  about: what it concerns, where the text does not say so.
    """

    severity: Severity
    text: str
    advice: str = ""
    about: str = ""

    @classmethod
    def graded(cls, text: str, advice: str, *, error: bool) -> Finding:
        """An error, or else a warning."""
        return cls(Severity.ERROR if error else Severity.WARNING, text, advice)


def warnings_of(*texts: str) -> tuple[Finding, ...]:
    """A warning for each text that is not empty."""
    return tuple(Finding(Severity.WARNING, text) for text in texts if text)


def errors_in(findings: Iterable[Finding]) -> list[Finding]:
    """Those that speak against using the result."""
    return [item for item in findings if item.severity is Severity.ERROR and item.text]


class CmpTactileError(Exception):
    """Base of all errors that a user can cause and repair."""


class InputError(CmpTactileError, ValueError):
    """A file, parameter or argument that cannot be used: names where, what was found and expected.

    Also arrays whose shapes do not belong together, and a rig that lacks what is asked of it.
    """


def error_text(error: object) -> str:
    """What an error says to a user; an InputError has a line for each value that is wrong."""
    lines = str(error).split("\n") if isinstance(error, InputError) else [str(error)]
    return "\n".join(map(printable, lines))


class FrameError(CmpTactileError):
    """A camera frame or view image of the wrong size or type, or which is damaged."""


class CalibrationError(CmpTactileError):
    """Frames from which nothing can be found: too few, of another rig, of a gel that moves."""


class FrameSourceError(CmpTactileError):
    """A folder, video, bag or camera that gives no frames.

    may_come: it may give some later, without anything changed, as a camera that is not plugged in.
    """

    def __init__(self, message: str, *, may_come: bool = False) -> None:
        super().__init__(message)
        self.may_come = may_come


class OutputError(CmpTactileError):
    """Results that cannot be written: their place, the disk, or what is there already."""


class ContactError(CmpTactileError):
    """A contact that cannot be: it starts inside the gel, leaves its patch, or asks too much."""


class NotConvergedError(CmpTactileError):
    """An equilibrium that was not found.  residual: m, infinite where the search was given up."""

    def __init__(self, message: str = "found no equilibrium", residual: float = inf) -> None:
        super().__init__(message)
        self.residual = residual


class RefusedValueError(ValueError):
    """A value of a file that is wrong: what is expected.

    key: of the value, below the part that is checked.  found: instead of what the file says.
    """

    def __init__(self, expected: str, *key: str | int, found: object = None) -> None:
        super().__init__(expected)
        self.expected, self.key, self.found = expected, key, found
