"""The methods that are compared: which print, which tracker."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.tracker import GridTracker

__all__ = ["CMP", "CMP_PAPER", "Method", "ViewTracker"]


class ViewTracker(Protocol):
    """Follows the markers of one view from frame to frame."""

    def learn(self, at_rest: Sequence[NDArray[np.uint8]]) -> None:
        """Look at view images (H, W) of the gel at rest, before the first frame."""

    def track(self, half_image: NDArray[np.uint8]) -> Grid:
        """Markers of a view image (H, W); of dots, their centres are the corners."""

    def reset(self) -> None:
        """Forget earlier frames; what was learnt is kept."""


def _as_it_is(sensor: SensorDescription) -> SensorDescription:
    return sensor


@dataclass(frozen=True)
class Method:
    """A way to measure markers.

    key: of results; label: of figures and tables.  pattern_type: cmp or dmp.
    tracker: makes that of a view, from sensor and view name.
    settings: of triangulation and the rest, laid over the sensor's.
    """

    key: str
    label: str
    pattern_type: str
    tracker: Callable[[SensorDescription, str], ViewTracker]
    settings: Callable[[SensorDescription], SensorDescription] = _as_it_is


class _Checkers:
    """GridTracker as the pipeline uses it."""

    def __init__(self, sensor: SensorDescription, view: str) -> None:
        self._tracker = GridTracker(sensor, view)

    def learn(self, at_rest: Sequence[NDArray[np.uint8]]) -> None:
        self._tracker.inspect_print(at_rest)

    def track(self, half_image: NDArray[np.uint8]) -> Grid:
        return self._tracker.track(half_image)

    def reset(self) -> None:
        self._tracker.reset()


class _CheckersOfThePaper(_Checkers):
    """Section III: it learns nothing of the print."""

    def learn(self, at_rest: Sequence[NDArray[np.uint8]]) -> None:
        pass


def _paper_settings(sensor: SensorDescription) -> SensorDescription:
    """Contour stitching, quadratic sub-pixel correction, common normal, each frame by itself."""
    tracking = replace(
        sensor.tracking,
        detector="contour_stitching",
        virtual_markers="local_correction",
        follow=False,
    )
    triangulation = replace(sensor.triangulation, method="common_normal")
    return replace(sensor, tracking=tracking, triangulation=triangulation)


CMP = Method("cmp", "CMP", "cmp", _Checkers)
CMP_PAPER = Method(
    "cmp_paper", "CMP, the paper's algorithm", "cmp", _CheckersOfThePaper, _paper_settings
)
