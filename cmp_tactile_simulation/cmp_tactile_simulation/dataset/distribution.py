"""Numbers that a recipe gives or lets draw, and how they are drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cmp_tactile_processing.errors import RefusedValueError
from cmp_tactile_processing.sensor.yaml_file import Check, did_you_mean, meant

# A normal distribution is cut here, in deviations, so that a limit can be checked before any draw.
CUT = 3.0
FIXED, CHOICE = "fixed", "choice"
# Names in a recipe, with what their two numbers are.
KINDS = {"uniform": "[low, high]", "log_uniform": "[low, high]", "normal": "[mean, std]"}


@dataclass(frozen=True)
class Distribution:
    """Where a number is drawn from.  kind: of KINDS, FIXED (one value) or CHOICE (some values)."""

    kind: str
    values: tuple[float, ...]

    @property
    def support(self) -> tuple[float, float]:
        """The least and the largest number that can be drawn."""
        if self.kind == "normal":
            mean, std = self.values
            return mean - CUT * std, mean + CUT * std
        return min(self.values), max(self.values)

    def draw(self, rng: np.random.Generator) -> float:
        """The next number."""
        if self.kind == FIXED:
            return self.values[0]
        if self.kind == CHOICE:
            return float(rng.choice(self.values))
        first, second = self.values
        if self.kind == "uniform":
            return float(rng.uniform(first, second))
        if self.kind == "log_uniform":
            return math.exp(rng.uniform(math.log(first), math.log(second)))
        deviation = rng.standard_normal()
        while abs(deviation) > CUT:
            deviation = rng.standard_normal()
        return float(first + second * deviation)


def distribution_of(given: Any) -> Distribution:
    """What a recipe says of a number: the number itself, or {uniform: [low, high]} and the like.

    Raises RefusedValueError for an unknown distribution, and for numbers that it cannot have.
    """
    names = (*KINDS, CHOICE)
    if _is_number(given):
        return Distribution(FIXED, (float(given),))
    if not isinstance(given, Mapping) or len(given) != 1:
        raise RefusedValueError(f"a number, or one of {', '.join(names)} with its numbers")
    ((kind, numbers),) = given.items()
    if kind not in names:
        near = did_you_mean(str(kind), names)
        raise RefusedValueError(f"one of {', '.join(names)}{near}", kind, found=kind)
    expected = KINDS.get(kind, "a list of one or more numbers")
    if not isinstance(numbers, Sequence) or not numbers or not all(map(_is_number, numbers)):
        raise RefusedValueError(expected, kind)
    values = tuple(map(float, numbers))
    if kind == CHOICE:
        return Distribution(kind, values)
    if len(values) != 2:
        raise RefusedValueError(expected, kind)
    first, second = values
    if kind == "normal" and second < 0:
        raise RefusedValueError("[mean, std] with a std of at least 0", kind)
    if kind != "normal" and first > second:
        raise RefusedValueError("[low, high] with low <= high", kind)
    if kind == "log_uniform" and first <= 0:
        raise RefusedValueError("[low, high] with 0 < low", kind)
    return Distribution(kind, values)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@dataclass(frozen=True)
class Within:
    """Of an annotated Distribution: all that it can give lies within low..high."""

    low: float
    high: float
    unit: str = ""

    def check(self, given: Any) -> Distribution:
        """The distribution; RefusedValueError with the limit."""
        found = distribution_of(given)
        low, high = found.support
        if low < self.low or high > self.high:
            hint = meant((low, high), self.unit, self.low, self.high)
            span = f"numbers from {self.low:g} to {self.high:g} {self.unit}".rstrip()
            raise RefusedValueError(span + hint, found=_shown(low, high))
        return found

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        return Check(self.check, Any).__get_pydantic_core_schema__(source, handler)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> Any:
        number = {"type": "number", "minimum": self.low, "maximum": self.high}
        numbers = {"type": "array", "items": {"type": "number"}, "minItems": 1}
        drawn = {
            "type": "object",
            "properties": dict.fromkeys((*KINDS, CHOICE), numbers),
            "additionalProperties": False,
            "minProperties": 1,
            "maxProperties": 1,
        }
        return {"anyOf": [number, drawn], "unit": self.unit}


def _shown(low: float, high: float) -> str:
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
