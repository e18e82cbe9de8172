"""Runs detectors over frames and scores them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import ClassVar, Protocol

import numpy as np
from extraction_detectors import Detection, Image, Ours
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.hard_frames.case import PatternFrame
from cmp_tactile_simulation.hard_frames.grid_score import (
    GridScore,
    displacement_errors,
    join_scores,
    score_grid,
)


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


@dataclass(frozen=True)
class Row:
    """A line of a table."""

    COLUMNS: ClassVar[tuple[str, ...]] = (
        "kind", "detector", "views", "complete", "far", "visible %", "far %", "wrong", "invented",
        "RMSE", "max", "virtual", "measured", "predicted", "p99", "ms",
    )  # fmt: skip

    kind: str
    detector: str
    result: Result

    def texts(self) -> list[str]:
        """What is printed of it."""
        score = self.result.score
        return [
            self.kind,
            self.detector,
            f"{score.grids}",
            f"{score.complete}",
            f"{score.complete_far}",
            f"{100 * score.found_visible / max(score.visible, 1):.2f}",
            f"{100 * score.found_far / max(score.far, 1):.2f}",
            f"{score.wrong}",
            f"{score.invented}",
            f"{score.corner_rmse:.4f}",
            f"{score.corner_max:.3f}",
            f"{score.virtual_rms:.4f}",
            f"{score.measured_rms:.4f}",
            f"{score.predicted_rms:.4f}",
            f"{score.virtual_p99:.3f}",
            f"{self.result.milliseconds:.1f}",
        ]


def run_frames(detector: Detector, frames: Sequence[PatternFrame]) -> Result:
    """Both views of each frame, one after the other."""
    scores, seconds = [], []
    for frame in frames:
        if not detector.able(frame.sensor):
            continue
        for view, truth in frame.truth.items():
            found = detector.detect(frame.sensor, view, _view(frame, view), truth)
            scores.append(score_grid(found.grid, truth, frame.visible[view], frame.far[view]))
            seconds.append(found.seconds)
    return Result(join_scores(scores), tuple(seconds))


def run_sequence(detector: Ours, frames: Sequence[PatternFrame]) -> list[Result]:
    """Frames in their order, followed from the first one on; a result for each frame."""
    for view in frames[0].truth:
        detector.tracker(frames[0].sensor, view).reset()
    return [run_frames(detector, [frame]) for frame in frames]


def run_pair(detector: Detector, first: PatternFrame, second: PatternFrame) -> NDArray[np.float64]:
    """Errors of the displacement from the first to the second frame, px, of both views."""
    errors = [np.empty(0)]
    for view, truth in first.truth.items():
        grids = [
            (detector.detect(frame.sensor, view, _view(frame, view), at).grid, at)
            for frame, at in ((first, truth), (second, second.truth[view]))
        ]
        visible = first.visible[view] & second.visible[view]
        errors.append(displacement_errors(grids[0], grids[1], visible))
    return np.concatenate(errors)


def _view(frame: PatternFrame, view: str) -> Image:
    placement = frame.truth[view].placement
    if placement is None:
        msg = f"{frame.name}: the truth does not tell where the {view} view lies"
        raise GeometryError(msg)
    return split_frame(frame.image, placement)
