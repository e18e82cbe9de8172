"""Pixel format, size and rate: what a camera offers, and what is chosen of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from linuxpy.video import device as v4l2

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.frames import ImageSize, size_text

__all__ = ["AUTO", "PREFERENCE", "Mode", "ModeRequest", "choose_mode"]

AUTO = "auto"
PREFERENCE = ("GREY", "YUYV", "BGR3", "RGB3", "MJPG", "JPEG")
"""Pixel formats that are read, by their four characters; the first are those without loss."""
# Cameras say 30 Hz and mean 29.97 Hz.
RATE_TOLERANCE = 0.01


@dataclass(frozen=True)
class ModeRequest:
    """What is wanted.  pixel_format: four characters or `auto`.  rate: Hz, 0 for the fastest."""

    pixel_format: str
    size: ImageSize
    rate: float


@dataclass(frozen=True)
class Mode:
    """What is chosen.  rate: Hz, 0 where the camera does not tell which it can do."""

    pixel_format: str
    size: ImageSize
    rate: float


@dataclass(frozen=True)
class _Rates:
    """Rates of a format at one size, as ranges of Hz; none where the camera does not tell."""

    pixel_format: str
    ranges: tuple[tuple[float, float], ...]

    @property
    def fastest(self) -> float:
        return max((high for _, high in self.ranges), default=0.0)

    @property
    def text(self) -> str:
        ordered = sorted(self.ranges)
        rates = [f"{a:g}" if a == b else f"{a:g} to {b:g}" for a, b in ordered]
        return f"{self.pixel_format}: {', '.join(rates)} Hz"

    def allow(self, rate: float) -> bool:
        slack = RATE_TOLERANCE * rate
        return not self.ranges or any(a - slack <= rate <= b + slack for a, b in self.ranges)


def choose_mode(device: Any, request: ModeRequest) -> Mode:
    """The mode of an open linuxpy Device that is closest to what is wanted.

    Raises FrameSourceError naming parameter, what was found and all that the camera can do.
    """
    formats = _formats(device, request.pixel_format)
    fitting = [item for item in formats if _fits(device, item, request.size)]
    if not fitting:
        offered = "; ".join(f"{item}: {_sizes_text(device, item)}" for item in formats)
        msg = (
            f"{device.filename}: image size of the sensor description: "
            f"found {size_text(request.size)}, expected one that the camera can do: {offered}"
        )
        raise FrameSourceError(msg)
    rates = [_rates(device, item, request.size) for item in fitting]
    if not request.rate:
        best = max(rates, key=lambda item: item.fastest)
        return Mode(best.pixel_format, request.size, best.fastest)
    for item in rates:
        if item.allow(request.rate):
            return Mode(item.pixel_format, request.size, request.rate)
    msg = (
        f"{device.filename}: frame_rate: found {request.rate:g} Hz, expected what the camera can "
        f"do at {size_text(request.size)}: {'; '.join(item.text for item in rates)}"
    )
    raise FrameSourceError(msg)


def _formats(device: Any, wanted: str) -> Sequence[str]:
    """Those that are both offered and allowed, best first."""
    listed = device.info.buffer_formats(v4l2.BufferType.VIDEO_CAPTURE)
    offered = [v4l2.human_pixel_format(item.pixel_format) for item in listed]
    allowed = [item for item in PREFERENCE if wanted in (AUTO, item)]
    formats = [item for item in allowed if item in offered]
    if not formats:
        found = ", ".join(PREFERENCE) if wanted == AUTO else wanted
        expected = ", ".join(offered) or "none"
        msg = f"{device.filename}: pixel_format: found {found}, the camera offers {expected}"
        raise FrameSourceError(msg)
    return formats


def _code(pixel_format: str) -> int:
    return int(v4l2.raw.v4l2_fourcc(*pixel_format))


def _sizes(device: Any, pixel_format: str) -> list[Any]:
    return list(v4l2.iter_read_frame_sizes(device, _code(pixel_format)))


def _fits(device: Any, pixel_format: str, size: ImageSize) -> bool:
    sizes = _sizes(device, pixel_format)
    # A camera that lists none may still be asked.
    return not sizes or any(_has(item, size) for item in sizes)


def _has(item: Any, size: ImageSize) -> bool:
    info = item.info
    if item.type == v4l2.FrameSizeType.DISCRETE:
        return (info.width, info.height) == size
    limits = (
        (info.min_width, info.max_width, info.step_width),
        (info.min_height, info.max_height, info.step_height),
    )
    return all(
        low <= side <= high and (side - low) % max(step, 1) == 0
        for side, (low, high, step) in zip(size, limits, strict=True)
    )


def _sizes_text(device: Any, pixel_format: str) -> str:
    return ", ".join(_size_text(item) for item in _sizes(device, pixel_format))


def _size_text(item: Any) -> str:
    info = item.info
    if item.type == v4l2.FrameSizeType.DISCRETE:
        return f"{info.width} x {info.height}"
    return (
        f"{info.min_width} x {info.min_height} to {info.max_width} x {info.max_height} "
        f"in steps of {info.step_width} x {info.step_height}"
    )


def _rates(device: Any, pixel_format: str, size: ImageSize) -> _Rates:
    try:
        listed = list(v4l2.iter_read_frame_intervals(device, _code(pixel_format), *size))
    except ZeroDivisionError:  # an interval of 0 s: the camera does not know
        listed = []
    ends = [sorted((float(item.min_fps), float(item.max_fps))) for item in listed]
    return _Rates(pixel_format, tuple((low, high) for low, high in ends if high > 0))
