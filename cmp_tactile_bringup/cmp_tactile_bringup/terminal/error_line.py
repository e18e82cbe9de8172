"""An error as the one line that a user reads."""

from __future__ import annotations

from cmp_tactile_processing.errors import CmpTactileError, printable

__all__ = ["error_line"]


def error_line(error: Exception, hint: str = "") -> str:
    """The line; hint: appended where the error is not one that a user is expected to cause."""
    if isinstance(error, CmpTactileError):
        return printable(f"error: {error}")
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return printable(f"error: {where}{error.strerror or error}")
    return printable(f"error: {type(error).__name__}: {error}{hint}")
