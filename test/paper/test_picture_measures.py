"""Pictures show the light and the visibility that were asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.rendering.renderer import RenderedFrame
from paper.experiments.reliability import DIRECTIONS, lit

SIDE = 768, 1024


@pytest.fixture(scope="module")
def at_rest() -> dict[str, Grid]:
    sensor = load_sensor("prototype")
    grids = {}
    for name, view in build_views(sensor).items():
        grid = Grid.missing(sensor.pattern.shape, "", view.placement)
        grids[name] = replace(grid, corners=view.project(sensor.pattern.corners()))
    return grids


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("fineness", [1, 2])
def test_light_spans_the_ratio_across_the_pattern(
    at_rest: dict[str, Grid], direction: float, fineness: int
) -> None:
    even = RenderedFrame(np.full([side * fineness for side in SIDE], 200, np.float32), fineness)
    shown = lit(even, 0.05, direction, at_rest).grey
    q = np.concatenate([grid.corners_frame.reshape(-1, 2) for grid in at_rest.values()])
    col, row = np.rint(q * fineness).astype(int).T
    at_corners = shown[row, col]
    # A pixel along the way is 0.2 % of the light at most.
    assert at_corners.max() == pytest.approx(200, rel=5e-3)
    assert at_corners.min() == pytest.approx(200 * 0.05, abs=200 * 5e-3)
