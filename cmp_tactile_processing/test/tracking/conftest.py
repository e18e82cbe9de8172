"""A tracker of the left view of the sample rig, and noisy drawings of what that view would show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.detector import NominalGrid, draw_nominal
from cmp_tactile_processing.tracking.tracker import GridTracker

NOISE_SEED = 5
SMOOTHING_PX = 1.2


def prepared(image: NDArray[Any]) -> PreparedImage:
    """The image with noise of one grey level, rounded to these, ready to be measured."""
    noisy = image + np.random.default_rng(0).normal(0, 1.0, image.shape)
    grey = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTHING_PX)
    low, high = np.percentile(grey, (5, 95))
    return PreparedImage(grey, np.asarray(smooth), SMOOTHING_PX, 1.0, float(high - low))


@pytest.fixture(scope="session")
def nominal(sensor: SensorDescription) -> NominalGrid:
    """The whole print at rest, px."""
    return NominalGrid.of_view(sensor.pattern, build_views(sensor)["left"])


@pytest.fixture(scope="session")
def kept_tracker(sensor: SensorDescription) -> GridTracker:
    """The tracker that the tests of a module share; a module may have one of another sensor."""
    return GridTracker(sensor, "left")


@pytest.fixture
def tracker(kept_tracker: GridTracker) -> GridTracker:
    """A tracker as after its start."""
    kept_tracker.reset()
    return kept_tracker


@pytest.fixture
def photograph(
    draw: Callable[..., NDArray[np.uint8]], nominal: NominalGrid
) -> Callable[..., NDArray[np.uint8]]:
    """Draws the print with its corners displaced by (rows, cols, 2) or (2,) px."""
    return partial(draw, nominal)


@pytest.fixture
def draw(sensor: SensorDescription) -> Callable[..., NDArray[np.uint8]]:
    """Draws a nominal grid with its corners displaced by (rows, cols, 2) or (2,) px.

    dots (rows + 1, cols + 1): checkers that bear one.  noise: its deviation, grey levels.
    """
    place = build_views(sensor)["left"].placement
    rng = np.random.default_rng(NOISE_SEED)

    def drawn(
        nominal: NominalGrid,
        displacement: NDArray[np.float64] | float = 0.0,
        dots: NDArray[np.bool_] | None = None,
        noise: float = 1.5,
    ) -> NDArray[np.uint8]:
        moved = replace(nominal, corners=nominal.corners + displacement)
        picture = draw_nominal(moved, (place.height, place.width), True, dots)
        noisy = picture + rng.normal(0, noise, picture.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)

    return drawn
