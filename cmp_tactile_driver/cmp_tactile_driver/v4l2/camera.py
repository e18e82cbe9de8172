"""One V4L2 capture device, open in one mode."""

from __future__ import annotations

import contextlib
import errno
from dataclasses import dataclass
from typing import Any

from linuxpy.video import device as v4l2

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.frames import size_text
from cmp_tactile_driver.v4l2.controls import CameraControls
from cmp_tactile_driver.v4l2.devices import VideoDevice
from cmp_tactile_driver.v4l2.kernel_errors import device_error
from cmp_tactile_driver.v4l2.modes import RATE_TOLERANCE, Mode, ModeRequest, choose_mode

__all__ = ["Buffer", "V4L2Camera"]


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

    def __init__(self, found: VideoDevice, request: ModeRequest, buffers: int) -> None:
        """Raises FrameSourceError where the device cannot be opened or cannot do what is asked."""
        self.found = found
        self._device = v4l2.Device(found.path)
        self._capture = v4l2.VideoCapture(self._device, size=buffers)
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
        time_ns = raw.timestamp.secs * 10**9 + raw.timestamp.usecs * 1000
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
            found = ", ".join(str(item.name) for item in self._device.info.buffers) or "none of it"
            msg = f"{self.found.path}: found a video device for {found}, expected VIDEO_CAPTURE"
            raise FrameSourceError(msg)

    def _apply(self, mode: Mode) -> tuple[int, float]:
        """Bytes per line and rate (Hz) that the camera took."""
        path, capture = self.found.path, self._capture
        capture.set_format(*mode.size, mode.pixel_format)
        got = capture.get_format()
        found = v4l2.human_pixel_format(got.pixel_format)
        if (got.width, got.height) != mode.size or found != mode.pixel_format:
            msg = (
                f"{path}: image size of the sensor description: the camera makes "
                f"{found} {size_text((got.width, got.height))} of it, "
                f"expected {mode.pixel_format} {size_text(mode.size)}"
            )
            raise FrameSourceError(msg)
        return got.bytes_per_line, self._apply_rate(capture, mode.rate)

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
            msg = f"{self.found.path}: frame_rate: the camera makes {found:g} Hz of {rate:g} Hz"
            raise FrameSourceError(msg)
        return found


def _is_unsupported(error: OSError) -> bool:
    return error.errno in (errno.ENOTTY, errno.EINVAL)
