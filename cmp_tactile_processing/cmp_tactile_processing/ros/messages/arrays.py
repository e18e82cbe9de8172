"""Arrays of messages: float64 in the core, float32 on the wire, checked when they are read."""

from __future__ import annotations

import array
import math
from enum import IntEnum
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.measured.grid import Status

__all__ = [
    "byte_array",
    "check_consistent",
    "check_seen",
    "float_array",
    "known_float_array",
    "read_array",
    "read_codes",
    "read_deviations",
    "read_points",
    "read_status",
]


# A plain number: NumPy looks for long what an enumeration's member may be.
MISSING = int(Status.MISSING)


def float_array(values: NDArray[Any]) -> array.array[float]:
    """Values as float32, in the type that messages take whole."""
    out = array.array("f")
    out.frombytes(np.ascontiguousarray(values, dtype=np.float32).tobytes())
    return out


def known_float_array(values: NDArray[Any] | None) -> array.array[float]:
    """As float_array; empty where nothing is known."""
    return array.array("f") if values is None else float_array(values)


def byte_array(values: NDArray[Any]) -> array.array[int]:
    """Values as uint8, in the type that messages take whole."""
    out = array.array("B")
    out.frombytes(np.ascontiguousarray(values, dtype=np.uint8).tobytes())
    return out


def read_array(msg: Any, name: str, dtype: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """Field `name` in the given shape; GeometryError for another number of values."""
    values = np.frombuffer(getattr(msg, name), dtype=dtype)
    if values.size != math.prod(shape):
        sides = " x ".join(str(side) for side in shape)
        text = f"{name}: found {values.size} values, expected {math.prod(shape)} ({sides})"
        raise GeometryError(text)
    return values.reshape(shape)


def read_points(msg: Any, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """A float32 field as float64."""
    return read_array(msg, name, np.float32, shape).astype(np.float64)


def read_status(msg: Any, name: str, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """A field of status codes; GeometryError for an unknown one."""
    return read_codes(msg, name, shape, Status)


def read_codes(
    msg: Any, name: str, shape: tuple[int, ...], known: type[IntEnum]
) -> NDArray[np.uint8]:
    """A field of codes of an enumeration; GeometryError for an unknown one."""
    codes = read_array(msg, name, np.uint8, shape)
    if codes.size and int(codes.max()) > _last_code(known):
        names = ", ".join(f"{item.value} ({item.name.lower()})" for item in known)
        text = f"{name}: found code {codes.max()}, expected one of {names}"
        raise GeometryError(text)
    return codes.copy()


def read_deviations(msg: Any, name: str, shape: tuple[int, ...]) -> NDArray[np.float64] | None:
    """Standard deviations; None where the sender knew none and left the array empty."""
    if not len(getattr(msg, name)):
        return None
    deviations = read_points(msg, name, shape)
    if (deviations < 0).any():
        text = f"{name}: found {deviations[deviations < 0][0]:g}, expected 0 or more, or NaN"
        raise GeometryError(text)
    return deviations


def check_seen(name: str, points: NDArray[np.float64], status: NDArray[np.uint8]) -> None:
    """Raise GeometryError where a point that is not missing has no coordinates."""
    bad = (status != MISSING) & ~_in_all(np.isfinite(points))
    if bad.any():
        count = np.count_nonzero(bad)
        text = f"{name}: found NaN or inf at {count} points whose status is not 0, expected numbers"
        raise GeometryError(text)


def check_consistent(name: str, points: NDArray[np.float64], status: NDArray[np.uint8]) -> None:
    """Raise GeometryError where status and coordinates tell different stories."""
    check_seen(name, points, status)
    bad = (status == MISSING) & ~_in_all(np.isnan(points))
    if bad.any():
        count = np.count_nonzero(bad)
        text = f"{name}: found numbers at {count} points whose status is 0 (missing), expected NaN"
        raise GeometryError(text)


def _in_all(told: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """What holds for all components (..., k): ten times as quick as all(axis=-1) of so few."""
    whole = told[..., 0]
    for component in range(1, told.shape[-1]):
        whole = whole & told[..., component]
    return whole


@cache
def _last_code(known: type[IntEnum]) -> int:
    return int(max(known))
