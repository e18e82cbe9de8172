"""The detectors that are compared, and how they are scored."""

from __future__ import annotations

import resource
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from statistics import median
from time import thread_time
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.tracker import GridTracker
from hard_frames.grid_score import (
    GridScore,
    displacement_errors,
    grid_of_corners,
    join_scores,
    score_grid,
)
from hard_frames.studio import PatternFrame

Image = NDArray[np.uint8]
Corners = NDArray[np.float64] | None

# cornerSubPix looks this share of a checker's side around a corner.
SUBPIX_SHARE = 0.35
SUBPIX_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 1e-3)
MRGINGHAM_LIMIT_S = 20.0


@dataclass(frozen=True)
class Detection:
    """What a detector found in one view, and the processor time that it took, s."""

    grid: Grid
    seconds: float


class Ours:
    """Our tracker with its tracking parameters changed; a cold one in every frame, or following."""

    def __init__(self, name: str, cold: bool = True, **tracking: Any) -> None:
        self.name, self._cold, self._tracking = name, cold, tracking
        self._trackers: dict[tuple[int, str], tuple[SensorDescription, GridTracker]] = {}

    @property
    def follows(self) -> bool:
        """Whether it goes on from the last frame."""
        return not self._cold

    @property
    def version(self) -> str:
        """Where it comes from."""
        return "this repository"

    def able(self, sensor: SensorDescription) -> bool:  # noqa: ARG002
        """Whether it can look for such a grid."""
        return True

    def detect(self, sensor: SensorDescription, view: str, image: Image, truth: Grid) -> Detection:  # noqa: ARG002
        """Track one view; the truth is not used."""
        return self.track(sensor, view, image)

    def track(self, sensor: SensorDescription, view: str, image: Image) -> Detection:
        """Track one view."""
        tracker = self.tracker(sensor, view)
        if self._cold:
            tracker.reset()
        began = thread_time()
        grid = tracker.track(image)
        return Detection(grid, thread_time() - began)

    def reset(self) -> None:
        """Forget earlier frames."""
        for _, tracker in self._trackers.values():
            tracker.reset()

    def tracker(self, sensor: SensorDescription, view: str) -> GridTracker:
        """The tracker of that sensor's view, compiled."""
        key = id(sensor), view
        if key not in self._trackers:
            rig = replace(sensor, tracking=replace(sensor.tracking, **self._tracking))
            tracker = GridTracker(rig, view)
            roi = sensor.views[view].roi
            tracker.track(np.full((roi.height, roi.width), 128, np.uint8))
            # The sensor is kept so that its id stays its own.
            self._trackers[key] = sensor, tracker
        return self._trackers[key][1]


class Peer:
    """A detector that knows only the size of the grid and gives corners in any order."""

    def __init__(
        self,
        name: str,
        version: str,
        find: Callable[[SensorDescription, Image, Grid], tuple[Corners, float]],
        able: Callable[[SensorDescription], bool] = lambda sensor: True,  # noqa: ARG005
    ) -> None:
        self.name, self.version, self._find, self.able = name, version, find, able

    def detect(self, sensor: SensorDescription, view: str, image: Image, truth: Grid) -> Detection:  # noqa: ARG002
        """Find corners; the truth gives them numbers, in the peer's favour."""
        corners, seconds = self._find(sensor, image, truth)
        return Detection(grid_of_corners(sensor.pattern.shape, corners, truth), seconds)


def _classic(sensor: SensorDescription, image: Image, truth: Grid) -> tuple[Corners, float]:
    """OpenCV's classic detector, with corners refined in a window that suits the checkers."""
    half, size = _subpix_window(truth), (sensor.pattern.cols, sensor.pattern.rows)
    began = thread_time()
    found, corners = cv2.findChessboardCorners(image, size)
    if found:
        cv2.cornerSubPix(image, corners, (half, half), (-1, -1), SUBPIX_STOP)
    seconds = thread_time() - began
    return (corners.reshape(-1, 2).astype(np.float64) if found else None), seconds


def _subpix_window(truth: Grid) -> int:
    """Half of the window of cornerSubPix, px: one that suits the smallest checkers."""
    sides = [np.linalg.norm(np.diff(truth.corners, axis=axis), axis=-1) for axis in (0, 1)]
    return max(2, int(SUBPIX_SHARE * min(np.nanmin(side) for side in sides)))


def _sector(sensor: SensorDescription, image: Image, truth: Grid) -> tuple[Corners, float]:  # noqa: ARG001
    size = sensor.pattern.cols, sensor.pattern.rows
    began = thread_time()
    found, corners = cv2.findChessboardCornersSB(image, size)
    seconds = thread_time() - began
    return (corners.reshape(-1, 2).astype(np.float64) if found else None), seconds


def _mrgingham(sensor: SensorDescription, image: Image, truth: Grid) -> tuple[Corners, float]:  # noqa: ARG001
    """mrgingham's command on an image file; its time without that of starting on a tiny one."""
    output, seconds = _run_mrgingham(image, sensor.pattern.rows)
    seconds = max(seconds - _mrgingham_start(), 0.0)
    rows = [line.split()[1:3] for line in output.splitlines() if not line.startswith("#")]
    if not rows or "-" in rows[0]:
        return None, seconds
    return np.array(rows, dtype=np.float64), seconds


def _run_mrgingham(image: Image, side: int) -> tuple[str, float]:
    """Its output on an image file, and the processor time that its process took, s."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "view.png"
        cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 0])
        command = ["mrgingham", "--gridn", str(side), "--jobs", "1", str(path)]
        began = children_time()
        try:
            output = subprocess.run(
                command, capture_output=True, text=True, timeout=MRGINGHAM_LIMIT_S, check=False
            ).stdout
        except subprocess.TimeoutExpired:
            output = ""
        return output, children_time() - began


def children_time() -> float:
    """Processor time of ended child processes so far, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@cache
def _mrgingham_start() -> float:
    tiny = np.full((16, 16), 128, np.uint8)
    return min(_run_mrgingham(tiny, 4)[1] for _ in range(5))


def peers() -> list[Peer]:
    """All peers that are installed."""
    found = [
        Peer("OpenCV classic + cornerSubPix", f"OpenCV {cv2.__version__}", _classic),
        Peer("OpenCV sector based (SB)", f"OpenCV {cv2.__version__}", _sector),
    ]
    if shutil.which("mrgingham"):

        def square(sensor: SensorDescription) -> bool:
            return sensor.pattern.rows == sensor.pattern.cols

        found.append(Peer("mrgingham (command)", "as installed", _mrgingham, square))
    return found


def ours() -> list[Ours]:
    """Our detectors, from scratch in every frame."""
    return [
        Ours("cmp_tactile", follow=False),
        Ours("contour stitching", follow=False, detector="contour_stitching"),
    ]


class Detector(Protocol):
    """What is compared."""

    name: str

    def able(self, sensor: SensorDescription) -> bool:
        """Whether it can look for such a grid."""

    def detect(self, sensor: SensorDescription, view: str, image: Image, truth: Grid) -> Detection:
        """What it finds in one view."""


@dataclass(frozen=True)
class Result:
    """Scores and times of a detector over frames; times of each view, s."""

    score: GridScore
    seconds: tuple[float, ...]

    @property
    def milliseconds(self) -> float:
        """Median time of a view."""
        return 1e3 * median(self.seconds) if self.seconds else float("nan")


def run_frames(detector: Detector, frames: Sequence[PatternFrame]) -> Result:
    """Both views of each frame, one after the other."""
    scores, seconds = [], []
    for frame in frames:
        if not detector.able(frame.sensor):
            continue
        for view, truth in frame.truth.items():
            found = detector.detect(frame.sensor, view, view_image(frame, view), truth)
            scores.append(score_grid(found.grid, truth, frame.visible[view], frame.far[view]))
            seconds.append(found.seconds)
    return Result(join_scores(scores), tuple(seconds))


def run_sequence(detector: Ours, frames: Sequence[PatternFrame]) -> list[Result]:
    """Frames in their order, followed from the first one on; a result for each frame."""
    detector.reset()
    return [run_frames(detector, [frame]) for frame in frames]


def run_pair(detector: Detector, first: PatternFrame, second: PatternFrame) -> NDArray[np.float64]:
    """Errors of the displacement from the first to the second frame, px, of both views.

    cmp_tactile inspects the print in the first frame.
    """
    errors = [np.empty(0)]
    for view, truth in first.truth.items():
        with _inspected(detector, first, view):
            grids = [
                (detector.detect(frame.sensor, view, view_image(frame, view), at).grid, at)
                for frame, at in ((first, truth), (second, second.truth[view]))
            ]
        visible = first.visible[view] & second.visible[view]
        errors.append(displacement_errors(grids[0], grids[1], visible))
    return np.concatenate(errors)


def run_inspected(detector: Ours, rest: PatternFrame, frame: PatternFrame) -> GridScore:
    """Both views of a frame, once the print was inspected at rest."""
    scores = []
    for view, truth in frame.truth.items():
        with _inspected(detector, rest, view):
            grid = detector.detect(frame.sensor, view, view_image(frame, view), truth).grid
        scores.append(score_grid(grid, truth, frame.visible[view], frame.far[view]))
    return join_scores(scores)


@contextmanager
def _inspected(detector: Detector, rest: PatternFrame, view: str) -> Iterator[None]:
    """A detector that knows the print as it is at rest, if it is ours."""
    tracker = detector.tracker(rest.sensor, view) if isinstance(detector, Ours) else None
    if tracker is not None:
        tracker.inspect_print([view_image(rest, view)])
    yield
    if tracker is not None:
        tracker.use_print_defects(None)


def view_image(frame: PatternFrame, view: str) -> Image:
    """A view (H, W) of a frame.  Raises InputError where the truth does not say where it is."""
    placement = frame.truth[view].placement
    if placement is None:
        msg = f"{frame.name}: the truth does not say where the {view} view lies"
        raise InputError(msg)
    return split_frame(frame.image, placement)
