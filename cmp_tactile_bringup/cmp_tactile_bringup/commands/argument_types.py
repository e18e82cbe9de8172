"""Types of the subcommands' arguments, which argparse checks before any work begins."""

from __future__ import annotations

from argparse import ArgumentTypeError
from collections.abc import Callable

__all__ = ["number_between", "whole_between"]


def number_between(low: float, high: float, unit: str = "") -> Callable[[str], float]:
    """A number from low to high, both included; anything else is refused with the range."""
    expected = f"a number from {low:g} to {high:g} {unit}".rstrip()

    def convert(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            msg = f"found {text!r}, expected {expected}"
            raise ArgumentTypeError(msg)
        return value

    return convert


def whole_between(low: int, high: int) -> Callable[[str], int]:
    """A whole number from low to high, both included; anything else is refused with the range."""

    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            msg = f"found {text!r}, expected a whole number from {low} to {high}"
            raise ArgumentTypeError(msg)
        return value

    return convert
