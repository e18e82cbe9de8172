"""Types of the subcommands' arguments, which argparse checks before any work begins."""

from __future__ import annotations

import re
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable
from typing import NoReturn

from cmp_tactile_processing.sensor.yaml_section import did_you_mean

__all__ = ["CommandParser", "number_between", "whole_between"]

WRONG_CHOICE = re.compile(r"invalid choice: '([^']*)' \(choose from (.*)\)")


class CommandParser(ArgumentParser):
    """An ArgumentParser that asks what a misspelt choice, as a subcommand, is to be."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        wrong = WRONG_CHOICE.search(message)
        if wrong is not None:
            message += did_you_mean(wrong[1], re.findall(r"[^', ]+", wrong[2]))
        super().error(message)


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
