"""Where the gel can be touched and where its markers are observed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_simulation.gel import contact_nodes


def shaped(sensor, rows, cols, pitch):
    return replace(sensor, pattern=replace(sensor.pattern, rows=rows, cols=cols, pitch=pitch))


@pytest.mark.parametrize("nodes", [12, 40])
def test_patch_covers_pattern_outer_checkers_and_margin(prototype, nodes):
    grid = contact_nodes(prototype, nodes)
    assert (grid.rows, grid.cols) == (nodes, nodes)
    assert grid.extent == pytest.approx((0.0165, 0.0165))


@pytest.mark.parametrize("nodes", [5, 6, 40])
def test_patch_keeps_one_spacing_from_the_side(prototype, nodes):
    """Hats that are cut off at the side would lose the nodes' equality."""
    grid = contact_nodes(shaped(prototype, 20, 20, 0.022 / 21), nodes)
    assert grid.extent[0] / 2 + grid.spacing[0] == pytest.approx(0.011)


@pytest.mark.parametrize(("rows", "cols"), [(20, 8), (8, 20), (4, 60)])
def test_nodes_are_as_far_apart_along_either_side(prototype, rows, cols):
    sensor = shaped(prototype, rows, cols, 0.013 / max(rows, cols))
    grid = contact_nodes(sensor, 24)
    assert max(grid.rows, grid.cols) == 24
    assert grid.spacing[0] == pytest.approx(grid.spacing[1])
    checkers = np.array([cols + 1, rows + 1]) * sensor.pattern.pitch
    assert (np.array(grid.extent) >= checkers + 2e-3 - 1e-9).all()
