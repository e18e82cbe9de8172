"""Frames that a calibration is made from: of a recording, or of a camera that runs.

As in ROS's camera_calibration, a running camera's frame is kept where the board's place, size and
skew in the image differ enough from those of all frames kept so far.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.recordings.library import (
    check_source,
    recorded_source,
)
from cmp_tactile_driver.bags.images import decode_file
from cmp_tactile_driver.bags.recording import frames_within, open_recording_of
from cmp_tactile_driver.bags.timeline import TimeSpan
from cmp_tactile_processing.cache.files import expanded_path
from cmp_tactile_processing.calibration.board.target import BoardSighting, BoardTarget
from cmp_tactile_processing.errors import Finding, warnings_of
from cmp_tactile_processing.geometry.split import to_grey
from cmp_tactile_processing.sensor.description import SensorDescription

Frame = NDArray[np.uint8]

# Sum of the differences in x, y, size and skew, each from 0 to 1; camera_calibration's figure.
LEAST_DIFFERENCE = 0.2
# Between two frames in a row, px: motion blur of less does no harm.
STILL_PX = 1.0
# So much of each of the ranges is to be covered: camera_calibration's figures.
WANTED_RANGE = {"x": 0.7, "y": 0.7, "size": 0.4, "skew": 0.5}
ADVICE = {
    "x": "move it left and right",
    "y": "move it up and down",
    "size": "bring it nearer and farther",
    "skew": "tilt it more, about both axes",
}


@dataclass(frozen=True)
class RecordedFrames:
    """images (H, W) or (H, W, 3) with their stamps.  findings: why some were left out."""

    images: list[Frame]
    stamps_ns: list[int]
    findings: tuple[Finding, ...] = ()


def read_frames(
    source: Path,
    sensor: SensorDescription,
    topic: str = "",
    count: int | None = None,
    start_s: float = 0.0,
) -> RecordedFrames:
    """Frames of a sensor's size of a bag or a folder of images.

    topic: as of `open_recording_of`.  count: at most so many frames, None for all.  start_s: leave
    out what is earlier.
    Raises FrameSourceError where there is no such source, or no frame of it can be used.
    """
    check_source(source, "a ROS 2 bag, a folder of images")
    path = recorded_source(source)
    recording = open_recording_of(sensor, path, topic=topic, surfaces=False)
    chosen = list(islice(frames_within(recording, TimeSpan(start=start_s)), count))
    return RecordedFrames(
        [frame.image for frame in chosen],
        [frame.stamp_ns for frame in chosen],
        warnings_of(recording.health.summary),
    )


def read_images(files: Sequence[Path]) -> list[Frame]:
    """Grey images (H, W) of files; FrameError for one that cannot be read."""
    return [to_grey(decode_file(expanded_path(file))) for file in files]


class Choice(str, Enum):
    """What became of a frame, in words for whoever holds the board."""

    KEPT = "kept"
    NOT_SEEN = "board not seen"
    MOVING = "hold it still"
    ALIKE = "like a frame before: move or tilt it"


@dataclass(frozen=True)
class BoardView:
    """Where a board is in an image: middle, size and skew, each from 0 to 1."""

    x: float
    y: float
    size: float
    skew: float

    @classmethod
    def from_sighting(cls, sighting: BoardSighting, target: BoardTarget) -> BoardView | None:
        """From the corners seen; None where they lie on one line."""
        corners = _outer_corners(sighting, target)
        if corners is None:
            return None
        width, height = sighting.size
        area = abs(cv2.contourArea(corners.astype(np.float32)))
        border = np.sqrt(area)
        middle = corners.mean(axis=0)
        before, after = corners[0] - corners[1], corners[2] - corners[1]
        cosine = before @ after / (np.linalg.norm(before) * np.linalg.norm(after))
        angle = np.arccos(np.clip(cosine, -1, 1))
        share = [
            np.clip((middle[axis] - border / 2) / max(side - border, 1), 0, 1)
            for axis, side in enumerate((width, height))
        ]
        return cls(
            x=float(share[0]),
            y=float(share[1]),
            size=float(np.sqrt(area / (width * height))),
            skew=float(min(1.0, 2 * abs(np.pi / 2 - angle))),
        )

    @property
    def values(self) -> NDArray[np.float64]:
        """(4,): x, y, size, skew."""
        return np.array([self.x, self.y, self.size, self.skew])


class BoardCapture:
    """Chooses frames.  target: the board that is shown."""

    def __init__(self, target: BoardTarget) -> None:
        self._target = target
        self._kept: list[BoardView] = []
        self._last: Mapping[str, BoardSighting] = {}

    def consider(self, sightings: Mapping[str, BoardSighting | None]) -> Choice:
        """What to do with a frame, by what its views show of the board; None: it is not there."""
        seen = {view: item for view, item in sightings.items() if item is not None}
        last, self._last = self._last, seen
        if len(seen) < len(sightings):
            return Choice.NOT_SEEN
        if not all(view in last and _still(item, last[view]) for view, item in seen.items()):
            return Choice.MOVING
        found = BoardView.from_sighting(next(iter(seen.values())), self._target)
        if found is None:
            return Choice.NOT_SEEN
        differences = [np.abs(found.values - kept.values).sum() for kept in self._kept]
        if differences and min(differences) < LEAST_DIFFERENCE:
            return Choice.ALIKE
        self._kept.append(found)
        return Choice.KEPT

    @property
    def missing(self) -> str:
        """What the frames kept so far do not cover, as advice; empty where nothing is missing."""
        values = np.array([view.values for view in self._kept]).reshape(-1, len(WANTED_RANGE))
        spans = np.ptp(values, axis=0) if len(values) else np.zeros(len(WANTED_RANGE))
        # A board held square is nothing to be shown: only how far it was tilted counts.
        spans[3] = values[:, 3].max(initial=0.0)
        wanted = zip(WANTED_RANGE.items(), spans, strict=True)
        return ", ".join(ADVICE[name] for (name, span), reached in wanted if reached < span)


def _still(now: BoardSighting, before: BoardSighting) -> bool:
    _, at_now, at_before = np.intersect1d(now.number, before.number, return_indices=True)
    if not len(at_now):
        return False
    moved = np.linalg.norm(now.pixels[at_now] - before.pixels[at_before], axis=1)
    return float(np.median(moved)) < STILL_PX


def _outer_corners(sighting: BoardSighting, target: BoardTarget) -> NDArray[np.float64] | None:
    """Where the board's outer corners (4, 2) px are, in order around it."""
    points = target.points[:, :2]
    places, _ = cv2.findHomography(points[sighting.number], sighting.pixels)
    if places is None:
        return None
    last = target.count - 1
    outer = points[[0, target.cols - 1, last, last - target.cols + 1]]
    corners = cv2.perspectiveTransform(outer[None], places)[0]
    return np.asarray(corners, np.float64) if np.isfinite(corners).all() else None
