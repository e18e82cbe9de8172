"""The saddle-lattice detector: which corners it sees, and what joins them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cmp_tactile_processing.image.prepared import Prefilter
from cmp_tactile_processing.tracking.corners.saddle_lattice import SaddleLattice
from cmp_tactile_processing.tracking.detector import STEPS, NominalGrid, draw_nominal

# A detector's corner serves if the sub-pixel fit finds home from it: a pixel and a half.
DETECTED_PX = 1.5
PITCH_PX = 17.0


def straight_grid(rows, cols, pitch=PITCH_PX, shear=0.0):
    """Corners (rows, cols, 2) px of a sheared lattice, i along +y and j along +x."""
    i, j = np.mgrid[:rows, :cols].astype(float)
    return np.stack([(j + 2 + shear * i) * pitch, (i + 2 + 0.3 * shear * j) * pitch], axis=-1)


def ideal(corners, margin=60):
    """Picture of dark checkers on light, dark along (-, -) to (+, +) of corner (0, 0)."""
    size = np.ceil(corners.max(axis=(0, 1))).astype(int) + margin
    grid = _grid_of(corners)
    return draw_nominal(grid, (int(size[1]), int(size[0])), dark_first=True)


def _grid_of(corners):
    row_step, col_step = np.gradient(corners, axis=0), np.gradient(corners, axis=1)
    sides = np.linalg.norm(np.concatenate([row_step, col_step]), axis=-1)
    return NominalGrid(
        corners,
        row_step,
        col_step,
        float(np.median(sides)),
        float(sides.min()),
        float(sides.max()),
        cKDTree(corners.reshape(-1, 2)),
    )


def detected(picture, corners):
    prepared = Prefilter(picture.shape, PITCH_PX).prepare(picture)
    return SaddleLattice(_grid_of(corners), picture.shape).corner_graph(prepared)


def assert_is_lattice(graph, corners):
    """Every corner of the pattern once, no other, and a pointer wherever there is a gridline."""
    rows, cols = corners.shape[:2]
    distance = np.linalg.norm(graph.position[:, None] - corners.reshape(-1, 2), axis=-1)
    number = distance.argmin(axis=1)
    assert sorted(number) == list(range(rows * cols))
    assert distance.min(axis=1).max() < DETECTED_PX
    place = np.stack(np.divmod(number, cols), axis=1)
    for towards, step in enumerate(STEPS):
        other = graph.neighbour[:, towards]
        inside = ((place + step >= 0) & (place + step < (rows, cols))).all(axis=1)
        np.testing.assert_array_equal(other >= 0, inside)
        np.testing.assert_array_equal(place[other[inside]], place[inside] + step)
    np.testing.assert_array_equal(graph.even, place.sum(axis=1) % 2 == 0)


@pytest.mark.parametrize("shear", [0.0, 0.25, -0.25])
@pytest.mark.parametrize(("rows", "cols"), [(4, 4), (7, 12), (20, 20)])
def test_a_clean_lattice_is_found_whole(rows, cols, shear):
    corners = straight_grid(rows, cols, shear=shear)
    corners -= corners.min(axis=(0, 1)) - 40
    assert_is_lattice(detected(ideal(corners), corners), corners)


def test_a_lattice_seen_turned_and_stretched_against_the_nominal_is_found_whole():
    nominal = straight_grid(9, 9) + 40
    middle = nominal.mean(axis=(0, 1))
    angle = np.radians(18)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    seen = (nominal - middle) @ (turn @ np.diag([1.25, 0.8])).T + middle
    prepared = Prefilter((300, 300), PITCH_PX).prepare(ideal(seen, 120)[:300, :300])
    graph = SaddleLattice(_grid_of(nominal), (300, 300)).corner_graph(prepared)
    assert_is_lattice(graph, seen)
