"""Frames of a bag as if a camera gave them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from cmp_tactile_driver.bags.calibration_check import calibration_mismatch
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_driver.bags.recorded_message import RecordedFrame
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.files import DEFAULT_FRAME_RATE
from cmp_tactile_driver.sources.frames import Frame, SourceHealth, SourceOptions

__all__ = ["RecordedSource"]

# Frames whose times tell the rate.
SAMPLE = 20


class RecordedSource:
    """A FrameSource that reads the images of a bag; their stamps are forgotten."""

    def __init__(self, options: SourceOptions) -> None:
        """The source `bag` of the driver.

        Raises FrameSourceError for what is no bag, has no images of the sensor's size, or was
        recorded with another camera.
        """
        self._bag = BagReader(Path(options.input).expanduser(), expected_size=options.frame_size)
        self._loop = options.loop
        self._past_bad_frames = 0
        mismatch = calibration_mismatch(self._bag.calibration(), options.sensor)
        if mismatch:
            msg = f"{self.name}: {mismatch}"
            raise FrameSourceError(msg)
        self._frame_rate = options.frame_rate or self._recorded_rate()
        self._frames: Iterator[RecordedFrame] = self._bag.frames()

    @property
    def name(self) -> str:
        """The bag."""
        return self._bag.name

    @property
    def frame_rate(self) -> float:
        """What is asked for, or as recorded."""
        return self._frame_rate

    @property
    def health(self) -> SourceHealth:
        """Frames that could not be used, in all passes."""
        health = self._bag.health
        return SourceHealth(self._past_bad_frames + health.bad_frames, health.problem)

    def read(self) -> Frame | None:
        """The next good frame, or None at the end; FrameSourceError where none is good."""
        frame = next(self._frames, None)
        if frame is None and self._loop:
            self._past_bad_frames += self._bag.health.bad_frames
            self._frames = self._bag.frames()
            frame = next(self._frames, None)
        if frame is None:
            return None
        return Frame(frame.image, f"{self.name} at {frame.time_ns} ns")

    def close(self) -> None:
        """Forget where it was; the bag is open only while it is read."""
        self._frames = iter(())

    def _recorded_rate(self) -> float:
        times = [frame.time_ns for frame in islice(self._bag.frames(), SAMPLE)]
        interval_s = float(np.median(np.diff(times))) * 1e-9 if len(times) > 1 else 0.0
        return min(1 / interval_s, 1000.0) if interval_s > 0 else DEFAULT_FRAME_RATE
