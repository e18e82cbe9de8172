"""Documents whose last part is made from the code."""

from __future__ import annotations

from pathlib import Path

__all__ = ["with_generated_section"]


def with_generated_section(path: Path, marker: str, section: str) -> str:
    """The text of the file with everything after its marker line replaced by the section.

    Raises ValueError where the file has no such line.
    """
    preamble, found, _ = path.read_text(encoding="utf-8").partition(marker)
    if not found:
        msg = f"{path}: found no line {marker!r}, expected it where the generated part begins"
        raise ValueError(msg)
    return f"{preamble}{marker}\n\n{section}"
