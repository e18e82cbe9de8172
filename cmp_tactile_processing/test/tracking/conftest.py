"""Noisy drawings of a pattern, as the left view of the sample rig would show it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.detector import NominalGrid, draw_nominal

NOISE_SEED = 5


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
