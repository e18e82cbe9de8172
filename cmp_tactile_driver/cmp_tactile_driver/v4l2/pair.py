"""Frames from two V4L2 cameras, joined by time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from cmp_tactile_driver.sources.frames import (
    VIEWS,
    Frame,
    NodeExtension,
    SourceHealth,
    SourceOptions,
    join_views,
)
from cmp_tactile_driver.v4l2.controls import CameraControls, ControlValue
from cmp_tactile_driver.v4l2.source import V4L2Source, next_frame
from cmp_tactile_processing.errors import FrameSourceError

SEPARATOR = ","


def open_cameras(options: SourceOptions) -> V4L2Source | CameraPair:
    """One camera, or two where `device` names two with a comma between; errors as V4L2Source."""
    if SEPARATOR in options.camera.device:
        return CameraPair(options)
    return V4L2Source(options)


class CameraPair:
    """A SelfPacedSource of two cameras, each of which gives the roi of one view.

    Frames are a pair where their times differ by `pair_tolerance` at most; the earlier one of two
    others is dropped, and counted.  The time of a pair is the mean.  Both cameras have the same
    controls, which are set alike.
    """

    def __init__(self, options: SourceOptions) -> None:
        """Raises FrameSourceError where the description has no two views, or frames cannot be
        joined; else as V4L2Source.
        """
        devices = [name.strip() for name in options.camera.device.split(SEPARATOR)]
        views = options.sensor.views
        if (
            len(devices) != len(VIEWS)
            or set(views) != set(VIEWS)
            or len({*devices, ""}) <= len(VIEWS)
        ):
            msg = (
                f"device: found {options.camera.device!r} for {len(views)} views, expected one "
                "camera, or two different ones for the views left and right, with a comma between"
            )
            raise FrameSourceError(msg)
        self._tolerance_ns = round(options.camera.pair_tolerance * 1e9)
        self._sensor = options.sensor
        self._waiting: list[Frame | None] = [None, None]
        self._unpaired, self._apart, self._running = 0, "", False
        self._closing = threading.Event()
        self._sources: list[V4L2Source] = []
        try:
            for device, roi in zip(devices, (views[name].roi for name in VIEWS), strict=True):
                image = replace(options.sensor.image, width=roi.width, height=roi.height)
                sensor = replace(options.sensor, image=image)
                camera = replace(options.camera, device=device)
                self._sources.append(V4L2Source(replace(options, sensor=sensor, camera=camera)))
        except BaseException:
            self.close()
            raise

    @property
    def name(self) -> str:
        """Both devices, as they were found last."""
        return " and ".join(source.name for source in self._sources)

    @property
    def frame_rate(self) -> float:
        """That of the slower camera; 0 where one does not say."""
        return min(source.frame_rate for source in self._sources)

    @property
    def health(self) -> SourceHealth:
        """What either could not give; a frame without a partner counts as dropped."""
        unpaired = SourceHealth(dropped_frames=self._unpaired)
        health = sum((source.health for source in self._sources), unpaired)
        return replace(health, problem=health.problem or self._apart)

    @property
    def diagnostics(self) -> Mapping[str, object]:
        """Figures of both cameras, and how many frames found no partner."""
        both = zip(VIEWS, self._sources, strict=True)
        figures = {f"{v} {key}": value for v, s in both for key, value in s.diagnostics.items()}
        return {**figures, "frames without partner": self._unpaired}

    def extend(self, node: Any) -> NodeExtension:
        """The controls of both cameras as parameters of a node."""
        from cmp_tactile_driver.v4l2.control_parameters import ControlParameters

        return ControlParameters(node, self)

    def start(self) -> None:
        """Let frames come.  Raises FrameSourceError where another program has a camera."""
        try:
            for source in self._sources:
                source.start()
        except BaseException:
            # One alone would keep its buffers, and refuse the next start.
            self.stop()
            raise
        self._running = True

    def stop(self) -> None:
        """Let no more come; those that wait are forgotten."""
        self._running = False
        for source in self._sources:
            source.stop()
        self._waiting = [None, None]

    def read(self) -> Frame:
        """The next pair, however long a camera is away; FrameSourceError after `close`."""
        if not self._running:
            self.start()
        return next_frame(self, self._closing)

    def poll(self, timeout: float) -> Frame | None:
        """The next pair as one frame, or None where none came in time."""
        end = time.monotonic() + timeout
        while True:
            for number, source in enumerate(self._sources):
                if self._waiting[number] is None:
                    self._waiting[number] = source.poll(max(end - time.monotonic(), 0.0))
            frame = self._paired()
            if frame is not None or time.monotonic() >= end:
                return frame

    def close(self) -> None:
        """Give both devices back."""
        self._closing.set()
        for source in self._sources:
            source.close()

    def controls(self) -> CameraControls:
        """The controls of the left camera; FrameSourceError while it is away."""
        return self._sources[0].controls()

    def set_controls(self, values: Mapping[str, ControlValue]) -> None:
        """Set those of both cameras.  Raises FrameSourceError."""
        for source in self._sources:
            source.set_controls(values)

    def keep_controls(self) -> dict[str, ControlValue]:
        """The values of the left camera; each gets its own again when it comes back."""
        left, _ = (source.keep_controls() for source in self._sources)
        return left

    @property
    def refused_controls(self) -> str:
        """Those that a camera keeps otherwise."""
        return "; ".join(filter(None, (source.refused_controls for source in self._sources)))

    @property
    def when_settled(self) -> Callable[[], object]:
        """As of one camera."""
        return self._sources[0].when_settled

    @when_settled.setter
    def when_settled(self, call: Callable[[], object]) -> None:
        for source in self._sources:
            source.when_settled = call

    def _paired(self) -> Frame | None:
        left, right = self._waiting
        if left is None or right is None:
            return None
        times = [frame.monotonic_ns or 0 for frame in (left, right)]
        apart_ns = times[1] - times[0]
        if abs(apart_ns) > self._tolerance_ns:
            self._waiting[int(apart_ns < 0)] = None
            self._unpaired += 1
            allowed_ms = self._tolerance_ns * 1e-6
            self._apart = (
                f"{self.name}: found frames that are {abs(apart_ns) * 1e-6:.1f} ms apart, "
                f"expected at most {allowed_ms:g} ms (pair_tolerance)"
            )
            return None
        self._waiting, self._apart = [None, None], ""
        joined = join_views(self._sensor, (left.image, right.image), self.name)
        origin = f"{left.origin}, {right.origin}"
        return Frame(joined, origin, monotonic_ns=times[0] + apart_ns // 2)
