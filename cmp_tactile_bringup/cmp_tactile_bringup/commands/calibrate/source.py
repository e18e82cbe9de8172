"""Frames that the calibrations work on, taken as the arguments say, with progress."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cmp_tactile_bringup.calibration.frames import RecordedFrames
    from cmp_tactile_bringup.terminal.stages import Teller
    from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["frames_of", "prepare_tracker"]

PREPARING = "preparing tracker and rays (compiled once per version)"
# Frames of a live camera where not told otherwise.
LIVE_FRAMES = 20


def frames_of(
    arguments: argparse.Namespace, sensor: SensorDescription, tell: Teller
) -> RecordedFrames:
    """Frames of the input, or of the live topic where there is no input; errors as those."""
    from cmp_tactile_bringup.calibration.frames import (
        FrameSelection,
        RecordedFrames,
        read_frames,
        take_frames,
    )

    size = (sensor.image.width, sensor.image.height)
    if arguments.input is not None:
        tell("reading frames", 0.0)
        selection = FrameSelection(arguments.frames, arguments.start, arguments.topic)
        frames = read_frames(Path(arguments.input), selection, size)
        tell("reading frames", 1.0)
        return frames
    from cmp_tactile_bringup.calibration.live import LiveFrames

    count = arguments.frames or LIVE_FRAMES
    what = f"frames of {arguments.topic}"
    weights = sensor.tracking.grey_weights
    with LiveFrames(arguments.topic, size, arguments.timeout, weights) as live:
        tell(what, 0.0)
        images = take_frames(iter(live), count, lambda done: tell(what, done / count))
    return RecordedFrames(images, list(range(len(images))))


def prepare_tracker(sensor: SensorDescription, tell: Teller) -> None:
    """Compile what tracks and triangulates where that has not been done before, and say so."""
    from cmp_tactile_processing.prepare import prepare_tracking

    tell(PREPARING, 0.0)
    prepare_tracking(sensor)
    tell(PREPARING, 1.0)
