"""Numbers and texts as YAML files hold them, for files that people read."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

import yaml

__all__ = ["yaml_number", "yaml_numbers", "yaml_text"]

PLAIN_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*")
# Words that YAML 1.1 may read as booleans and PyYAML does not.
BOOLEAN_LETTERS = ("y", "n")


def yaml_number(value: float) -> str:
    """The shortest decimal that reads back as the same float, with the point YAML 1.1 asks for."""
    number = float(value)
    if math.isnan(number):
        return ".nan"
    if math.isinf(number):
        return ".inf" if number > 0 else "-.inf"
    mantissa, exponent, power = repr(number).partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}{exponent}{power}"


def yaml_numbers(values: Iterable[float]) -> str:
    """A list of floats in one line."""
    return f"[{', '.join(yaml_number(value) for value in values)}]"


def yaml_text(text: str) -> str:
    """A text as YAML reads it back: plain where it is a word that means nothing else."""
    plain = PLAIN_WORD.fullmatch(text) and text.lower() not in BOOLEAN_LETTERS
    if plain and yaml.safe_load(text) == text:
        return text
    quoted: str = yaml.safe_dump(text, default_style='"', width=math.inf, allow_unicode=True)
    return quoted.rstrip("\n")
