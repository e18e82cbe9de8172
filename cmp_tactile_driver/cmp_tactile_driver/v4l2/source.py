"""Frames from a V4L2 camera, which may be unplugged and come back."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.sources import frames
from cmp_tactile_driver.sources.capture import BackOff
from cmp_tactile_driver.v4l2 import devices
from cmp_tactile_driver.v4l2.camera import Buffer, Mode, V4L2Camera
from cmp_tactile_driver.v4l2.controls import CameraControls, ControlValue
from cmp_tactile_processing.errors import FrameError, FrameSourceError
from cmp_tactile_processing.image.encodings import decode_jpeg, decode_raw
from cmp_tactile_processing.measured import NS_PER_S

RAW_ENCODINGS = {"GREY": "mono8", "YUYV": "yuyv", "BGR3": "bgr8", "RGB3": "rgb8"}
SEQUENCES = 2**32
# So many equal frames in a row are reported.
MOST_EQUAL = 10
# How long a damaged frame is reported.
MEMORY_S = 5.0
# Of a frame that has just come; a time beyond is no time of this frame.
MAX_AGE_NS = 2 * NS_PER_S
READ_TIMEOUT_S = 0.1
# In intervals of frames, how long none may come at the least.
SLOWEST = 3.0


def decode_buffer(
    data: bytes, mode: Mode, bytes_per_line: int, *, colour: bool
) -> NDArray[np.uint8]:
    """(H, W) uint8 grey, or with `colour`, and where the camera has it, (H, W, 3) BGR.

    Raises FrameError for a buffer that is cut off, damaged or no such image.
    """
    pixels = np.frombuffer(data, np.uint8)
    encoding = RAW_ENCODINGS.get(mode.pixel_format)
    if encoding is None:
        image = decode_jpeg(data, "data", size=mode.size, grey=not colour)
    else:
        image = decode_raw(mode.size, encoding, bytes_per_line, pixels, luminance=not colour)
    if image.ndim == 3 and not colour:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    return image


def next_frame(source: frames.SelfPacedSource, closing: threading.Event) -> frames.Frame:
    """The next frame of a source, however long it takes; FrameSourceError once it is closed."""
    while not closing.is_set():
        frame = source.poll(READ_TIMEOUT_S)
        if frame is not None:
            return frame
    msg = f"{source.name}: is closed"
    raise FrameSourceError(msg)


class V4L2Source:
    """A SelfPacedSource that opens its camera again, and sets its controls, after it was away.

    frame_rate: what the camera says; 0 where it does not.  Controls that were set are set again
    once frames come, as some cameras reset them then.  refused_controls: those that the camera
    keeps otherwise, in words.  when_settled: is called when that is known, from any thread.
    """

    def __init__(self, options: frames.SourceOptions) -> None:
        """Raises FrameSourceError where the camera is not there, or cannot do what is asked."""
        self._options = options
        self._request = Mode(options.camera.pixel_format, options.frame_size, options.frame_rate)
        # The camera is closed by the thread that polls, its controls are set by another.
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._camera: V4L2Camera | None = None
        self._wanted_controls: dict[str, ControlValue] = {}
        # Of these, those that somebody set; what streaming makes of them is looked at twice.
        self._asked_controls: dict[str, ControlValue] = {}
        self._settles = False
        self.when_settled: Callable[[], object] = int
        self.refused_controls = ""
        self._running = False
        self._lost = ""
        self._recent = ("", -MEMORY_S)
        self._bad_frames = self._dropped = self._reconnects = 0
        self._sequence: int | None = None
        self._repeated = frames.RepeatedPictures()
        times = options.camera
        self._back_off = BackOff(times.reconnect_delay)
        self._next_attempt = self._last_frame = 0.0
        self._stamp_kind = "unknown"
        self._camera = self._open(devices.find_device(options.camera.device))
        self._found = self._camera.found
        self._mode = self._camera.mode
        self.frame_rate = self._camera.rate

    @property
    def name(self) -> str:
        """The device, as it was found last."""
        return self._found.text

    @property
    def health(self) -> frames.SourceHealth:
        """Whether the camera is away, or gave damaged or equal frames of late; those it lost."""
        if self._lost:
            problem, is_recent = self._lost, True
        else:
            problem, when = self._recent
            is_recent = time.monotonic() - when < MEMORY_S
        return frames.SourceHealth(
            self._bad_frames,
            problem if is_recent else "",
            silent=bool(self._lost),
            dropped_frames=self._dropped,
        )

    @property
    def diagnostics(self) -> Mapping[str, object]:
        """Figures of the camera by name."""
        width, height = self._mode.size
        return {
            "device": self._found.path,
            "serial": self._found.serial or "none",
            "mode": f"{self._mode.pixel_format} {width} x {height}, {self._rate_text}",
            "connected": self._camera is not None,
            "refused controls": self.refused_controls or "none",
            "reconnects": self._reconnects,
            "stamps": self._stamp_kind,
        }

    @property
    def _rate_text(self) -> str:
        return f"{self.frame_rate:g} Hz" if self.frame_rate else "frames of unknown rate"

    def extend(self, node: Any) -> frames.NodeExtension:
        """The camera's controls as parameters of a node."""
        from cmp_tactile_driver.v4l2.control_parameters import ControlParameters

        return ControlParameters(node, self)

    def start(self) -> None:
        """Let frames come; those of a camera that is away, when it is back.

        Raises FrameSourceError where another program has it.
        """
        with self._lock:
            if self._camera is not None:
                try:
                    self._camera.start()
                except FrameSourceError as error:
                    if not error.may_come:
                        raise
                    self._lose(str(error))
                else:
                    self._begin_settling()
            self._running = True
            self._forget_sequence()

    def stop(self) -> None:
        """Let no more come; the device stays open."""
        with self._lock:
            self._running = False
            if self._camera is not None:
                self._camera.stop()

    def read(self) -> frames.Frame:
        """The next frame, however long the camera is away; FrameSourceError after `close`."""
        if not self._running:
            self.start()
        return next_frame(self, self._closing)

    def poll(self, timeout: float) -> frames.Frame | None:
        """The next good frame, or None where none came in time."""
        if self._camera is None:
            self._closing.wait(min(timeout, max(0.0, self._next_attempt - time.monotonic())))
            self._try_again()
            return None
        try:
            buffer = self._camera.poll(timeout)
        except devices.DEVICE_ERRORS as error:
            self._lose(devices.error_text(self.name, "next frame", error))
            return None
        if buffer is None:
            self._check_silence()
            return None
        return self._frame(buffer)

    def close(self) -> None:
        """Give the device back."""
        self._closing.set()
        with self._lock:
            if self._camera is not None:
                self._camera.close()
                self._camera = None

    def controls(self) -> CameraControls:
        """The controls of the camera; FrameSourceError while it is away."""
        if self._camera is None:
            raise FrameSourceError(self._lost or f"{self.name}: is closed")
        return self._camera.controls

    def set_controls(self, values: Mapping[str, ControlValue]) -> None:
        """Set all or none, also when the camera comes back.  Raises FrameSourceError."""
        with self._lock:
            self.controls().set(values)
            self._wanted_controls.update(values)
            self._asked_controls.update(values)

    def keep_controls(self) -> dict[str, ControlValue]:
        """The values of all controls, which the camera gets again when it comes back."""
        with self._lock:
            values = self.controls().values()
            self._wanted_controls = dict(values)
            return values

    def _begin_settling(self) -> None:
        self._settles = True
        self._settle_controls()

    def _settle_controls(self) -> None:
        """Set again what the camera reset when streaming began, and note what it keeps."""
        with self._lock:
            try:
                controls = self.controls()
                # Some forget them and still report them.
                failures = controls.restore(self._asked_controls, also_equal=True)
                kept = controls.kept_otherwise(self._asked_controls)
            except FrameSourceError:  # away again: the next frame will not come
                return
            self.refused_controls = "; ".join(dict.fromkeys([*failures, *kept]))
        if self.refused_controls:
            self._note(f"{self.name}: {self.refused_controls}")
        self.when_settled()

    def _open(self, found: devices.VideoDevice) -> V4L2Camera:
        return V4L2Camera(found, self._request)

    def _check_silence(self) -> None:
        limit = self._options.camera.frame_timeout
        if self.frame_rate:  # a slow camera is not a silent one
            limit = max(limit, SLOWEST / self.frame_rate)
        if time.monotonic() - self._last_frame > limit:
            reason = f"found no frame for {limit:g} s, expected {self._rate_text}"
            self._lose(f"{self.name}: {reason}")

    def _lose(self, reason: str) -> None:
        with self._lock:
            if self._camera is not None:
                self._camera.close()
                self._camera = None
        if self._lost:  # it came back, and gave no frame
            self._back_off.wait_longer()
        self._lost = reason
        self._next_attempt = time.monotonic() + self._back_off.delay

    def _try_again(self) -> None:
        if self._closing.is_set() or time.monotonic() < self._next_attempt:
            return
        camera = None
        try:
            found = devices.find_device(self._options.camera.device, self._found.serial)
            camera = self._open(found)
            failures = camera.controls.restore(self._wanted_controls)
            camera.start()
        except devices.DEVICE_ERRORS as error:
            if camera is not None:
                camera.close()
            self._back_off.wait_longer()
            reason = devices.error_text(self.name, "opened again", error)
            self._lost = f"{self._lost.partition('; ')[0]}; {reason}"
            self._next_attempt = time.monotonic() + self._back_off.delay
            return
        with self._lock:
            self._camera, self._found = camera, found
            self._mode, self.frame_rate = camera.mode, camera.rate
            self._reconnects += 1
            self._forget_sequence()
        if failures:
            self._note("; ".join(failures))
        self._begin_settling()

    def _forget_sequence(self) -> None:
        self._sequence = None
        self._last_frame = time.monotonic()

    def _note(self, problem: str) -> None:
        self._recent = (problem, time.monotonic())

    def _frame(self, buffer: Buffer) -> frames.Frame | None:
        camera = self._camera
        if camera is None:
            return None
        now_ns = time.monotonic_ns()
        self._last_frame = now_ns * 1e-9
        self._count_dropped(buffer.sequence)
        origin = f"{self._found.path} frame {buffer.sequence}"
        try:
            if buffer.damaged:
                msg = "data: found a buffer that the kernel marks as damaged, expected a whole one"
                raise FrameError(msg)  # noqa: TRY301 - one way for all damaged frames
            colour = self._options.camera.colour
            image = decode_buffer(buffer.data, camera.mode, camera.bytes_per_line, colour=colour)
        except FrameError as error:
            self._bad_frames += 1
            self._note(f"{origin}: {error}")
            return None
        self._count_equal(buffer.data, origin)
        # Only a good frame shows that the camera is well again.
        self._lost = ""
        self._back_off.reset()
        if self._settles:
            # Some reset their controls with the first frame only.
            self._settles = False
            self._settle_controls()
        return frames.Frame(image, origin, monotonic_ns=self._time_of(buffer, now_ns))

    def _count_dropped(self, sequence: int) -> None:
        if self._sequence is not None:
            missing = (sequence - self._sequence - 1) % SEQUENCES
            if 0 < missing < SEQUENCES // 2:
                self._dropped += missing
        self._sequence = sequence

    def _count_equal(self, data: bytes, origin: str) -> None:
        equal = self._repeated.add(np.frombuffer(data, np.uint8))
        if equal > MOST_EQUAL:
            self._note(f"{origin}: found the same image {equal} times: has the camera stopped?")

    def _time_of(self, buffer: Buffer, now_ns: int) -> int:
        time_ns = buffer.monotonic_ns
        offset_ns = round(self._options.camera.stamp_offset * 1e9)
        if time_ns is None or not 0 <= now_ns - time_ns < MAX_AGE_NS:
            self._stamp_kind = "arrival: the camera gives no time"
            return now_ns + offset_ns
        self._stamp_kind = "start of exposure" if buffer.exposure else "end of frame"
        return time_ns + offset_ns
