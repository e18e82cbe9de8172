"""One V4L2 capture device: pixel formats, sizes and rates that it offers, open in one of them."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from linuxpy.video import device as v4l2

from cmp_tactile_driver.sources.frames import ImageSize, size_text
from cmp_tactile_driver.v4l2.controls import CameraControls
from cmp_tactile_driver.v4l2.devices import VideoDevice, device_error
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.measured import NS_PER_S

AUTO = "auto"
PREFERENCE = ("GREY", "YUYV", "BGR3", "RGB3", "MJPG", "JPEG")
"""Pixel formats that are read, by their four characters; the first are those without loss."""
# Cameras say 30 Hz and mean 29.97 Hz.
RATE_TOLERANCE = 0.01
PROGRESSIVE = (v4l2.Field.NONE, v4l2.Field.ANY)
BUFFERS = 4
"""Frames that the kernel keeps until they are read."""


@dataclass(frozen=True)
class Mode:
    """What is wanted, or what is chosen.

    pixel_format: four characters; what is wanted may be `auto`.  rate: Hz; 0 where the fastest is
    wanted, and where the camera does not say which it can do.
    """

    pixel_format: str
    size: ImageSize
    rate: float


@dataclass(frozen=True)
class _Rates:
    """Rates of a format at one size, as ranges of Hz; none where the camera does not say."""

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


def choose_mode(device: Any, request: Mode) -> Mode:
    """The mode of an open linuxpy Device that is closest to what is wanted.

    Raises FrameSourceError naming parameter, what was found and all that the camera can do.
    """
    formats = _formats(device, request.pixel_format)
    fitting = [item for item in formats if _fits(device, item, request.size)]
    if not fitting:
        offered = "; ".join(f"{item}: {_sizes_text(device, item)}" for item in formats)
        msg = (
            f"{device.filename}: image size of the sensor description: found "
            f"{size_text(request.size)}, expected a size that the camera offers: {offered}"
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
        f"{device.filename}: frame_rate: found {request.rate:g} Hz, expected a rate that the "
        f"camera offers at {size_text(request.size)}: {'; '.join(item.text for item in rates)}"
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
        msg = (
            f"{device.filename}: pixel_format: found {found}, expected a format that the camera "
            f"offers: {expected}"
        )
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


@dataclass(frozen=True)
class Buffer:
    """What the kernel gives of a frame.

    sequence: counts every frame, those that nobody read too.  monotonic_ns: None where the time
    is of no known clock.  exposure: the time is that of the start of exposure, not of the end of
    the frame.  damaged: the kernel says that data are missing.
    """

    data: bytes
    sequence: int
    monotonic_ns: int | None
    exposure: bool
    damaged: bool


class V4L2Camera:
    """An open camera; gives buffers between `start` and `stop`."""

    def __init__(self, found: VideoDevice, request: Mode) -> None:
        """Raises FrameSourceError where the device cannot be opened or cannot do what is asked."""
        self.found = found
        self._device = v4l2.Device(found.path)
        self._capture = v4l2.VideoCapture(self._device, size=BUFFERS)
        self._streaming = False
        try:
            self._open()
            self.controls = CameraControls(self._device)
            self.mode = choose_mode(self._device, request)
            self.bytes_per_line, self.rate = self._apply(self.mode)
            # Who has buffers has the device; another driver's are found out here already.
            self._capture.arm()
            self.stop()
        except OSError as error:
            self.close()
            raise device_error(found.path, "open", error) from None
        except BaseException:
            self.close()
            raise

    def start(self) -> None:
        """Let frames come.  Raises FrameSourceError."""
        try:
            # Another program may have had the device in the meantime.
            self.bytes_per_line, self.rate = self._apply(self.mode)
            self._capture.open()
        except OSError as error:
            self.stop()
            raise device_error(self.found.path, "start of the frames", error) from None
        self._streaming = True

    def stop(self) -> None:
        """Let no more come, and give their buffers back, so that others may use the device."""
        self._streaming = False
        capture, buffers = self._capture, self._capture.buffer
        if buffers is None:
            return
        # An unplugged device refuses all of this; its memory is to be given back even so.
        with contextlib.suppress(OSError):
            capture.stream_off()
        for mapped in buffers.buffers or ():
            mapped.close()
        buffers.buffers = None
        with contextlib.suppress(OSError):
            capture.free_buffers(v4l2.Memory.MMAP)
        capture.buffers = capture.buffer = None

    def poll(self, timeout: float) -> Buffer | None:
        """The next buffer, or None where none came in time.  Raises FrameSourceError."""
        if not self._streaming:
            self.start()
        try:
            frame = self._capture.buffer.frame_reader.read(timeout)
        except BlockingIOError:
            return None
        except OSError as error:
            raise device_error(self.found.path, "next frame", error) from None
        if frame is None:
            return None
        raw, flags = frame.buff, frame.buff.flags
        is_monotonic = flags & v4l2.BufferFlag.TIMESTAMP_MASK == v4l2.BufferFlag.TIMESTAMP_MONOTONIC
        time_ns = raw.timestamp.secs * NS_PER_S + raw.timestamp.usecs * 1000
        source = flags & v4l2.BufferFlag.TSTAMP_SRC_MASK
        return Buffer(
            data=frame.data,
            sequence=raw.sequence,
            monotonic_ns=time_ns if is_monotonic else None,
            exposure=source == v4l2.BufferFlag.TSTAMP_SRC_SOE,
            damaged=bool(flags & v4l2.BufferFlag.ERROR),
        )

    def close(self) -> None:
        """Give the device back; may be called more than once."""
        self.stop()
        with contextlib.suppress(OSError):
            self._device.close()

    def _open(self) -> None:
        self._device.open()
        wanted = v4l2.Capability.VIDEO_CAPTURE
        if wanted not in self._device.info.device_capabilities:
            found = ", ".join(str(item.name) for item in self._device.info.buffers) or "nothing"
            msg = f"{self.found.path}: found a video device for {found}, expected VIDEO_CAPTURE"
            raise FrameSourceError(msg)

    def _apply(self, mode: Mode) -> tuple[int, float]:
        """Bytes per line and rate (Hz) that the camera took."""
        path, capture = self.found.path, self._capture
        capture.set_format(*mode.size, mode.pixel_format)
        self._check_fields()
        got = capture.get_format()
        found = v4l2.human_pixel_format(got.pixel_format)
        if (got.width, got.height) != mode.size or found != mode.pixel_format:
            msg = (
                f"{path}: image size of the sensor description: found {found} "
                f"{size_text((got.width, got.height))} set by the camera, expected "
                f"{mode.pixel_format} {size_text(mode.size)}"
            )
            raise FrameSourceError(msg)
        return got.bytes_per_line, self._apply_rate(capture, mode.rate)

    def _check_fields(self) -> None:
        """Rows of two times in one picture would move markers by what the gel moves meanwhile."""
        format_ = v4l2.get_raw_format(self._device, v4l2.BufferType.VIDEO_CAPTURE)
        field = v4l2.Field(format_.fmt.pix.field)
        if field not in PROGRESSIVE:
            msg = (
                f"{self.found.path}: field order: found {field.name.lower()} set by the camera, "
                "expected none: each picture whole, not two fields of it one after the other"
            )
            raise FrameSourceError(msg)

    def _apply_rate(self, capture: Any, rate: float) -> float:
        try:
            if rate:
                capture.set_fps(rate)
            found = float(capture.get_fps())
        except (OSError, ZeroDivisionError) as error:
            if isinstance(error, OSError) and not _is_unsupported(error):
                raise
            return rate
        if rate and abs(found - rate) > RATE_TOLERANCE * rate:
            msg = (
                f"{self.found.path}: frame_rate: found {found:g} Hz set by the camera, expected "
                f"{rate:g} Hz"
            )
            raise FrameSourceError(msg)
        return found


def _is_unsupported(error: OSError) -> bool:
    return error.errno in (errno.ENOTTY, errno.EINVAL)
