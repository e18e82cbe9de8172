"""How a picture differs from a description by which no marker is found in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.counting import Sighting, count_corners
from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.geometry.split import split_frame, to_grey
from cmp_tactile_processing.sensor.description import SensorDescription

# Perspective alone makes checkers of one view differ by a third.
MAX_SIDE_RATIO = 1.4


def description_misfits(sensor: SensorDescription, frame: NDArray[np.uint8]) -> Iterator[str]:
    """A line for each view: what is seen in it without the description, and which key to check.

    frame: (H, W) or (H, W, 3) uint8.  Nothing for a view that shows no pattern and could.
    """
    grey = to_grey(frame, sensor.tracking.grey_weights)
    for name, view in build_views(sensor).items():
        margin, seen = pattern_margin(view, sensor), None
        try:
            seen = count_corners(np.ascontiguousarray(split_frame(grey, view.placement)))
        except FrameError:
            if margin >= 0 or sensor.pattern.border == "beyond_view":
                continue
        text = f"{name} view: by {sensor.origin}, the pattern is {margin_words(view, sensor)}"
        if seen is not None:
            text += f"; {_comparison(sensor, view, seen)}"
        yield text


def _comparison(sensor: SensorDescription, view: ViewGeometry, seen: Sighting) -> str:
    pattern = sensor.pattern
    nominal = view.project(pattern.corners())
    side_px = float(np.nanmedian(np.linalg.norm(np.diff(nominal, axis=1), axis=-1)))
    ratio = seen.quality.side_px / side_px
    if not 1 / MAX_SIDE_RATIO < ratio < MAX_SIDE_RATIO:
        keys = "pattern.pitch, focal length and distance of the camera"
    elif sorted(seen.corners.shape[:2]) != sorted((pattern.rows, pattern.cols)):
        keys = "pattern.rows and cols"
    else:
        keys = "the pose, which takes points of the gel to the camera (not its inverse)"
    found = f"found {seen.size_text} with checkers of {seen.quality.side_px:.1f} px"
    expected = f"expected {pattern.rows} x {pattern.cols} with checkers of {side_px:.1f} px"
    return f"{found}, {expected}: check {keys}"


def margin_words(view: ViewGeometry, sensor: SensorDescription) -> str:
    """Whether the outermost checkers lie inside the view."""
    if sensor.pattern.border == "beyond_view":
        return "continues beyond the view"
    margin = pattern_margin(view, sensor)
    if not np.isfinite(margin):
        return "not inside the view: a part cannot be projected"
    if margin < 0:
        return f"not inside the view: ends up to {-margin:.0f} px beyond it"
    return f"inside the view, at least {margin:.0f} px from its edge"


def pattern_margin(view: ViewGeometry, sensor: SensorDescription) -> float:
    """Least distance of the outer checkers' outer corners from the view's edge at rest, px.

    Negative where one is outside; NaN where one has no pixel.
    """
    pattern, place = sensor.pattern, view.placement
    printed = replace(pattern, rows=pattern.rows + 2, cols=pattern.cols + 2)
    q = view.project(printed.corners())
    # Pixel (0, 0) is the centre of the top-left pixel.
    size = np.array([place.width, place.height])
    return float(np.minimum(q + 0.5, size - 0.5 - q).min())
