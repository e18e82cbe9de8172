"""The saddle-lattice detector: which corners it sees, and what joins them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from cmp_tactile_processing.image.prefilter import Prefilter
from cmp_tactile_processing.tracking.corners.evidence import edge_evidence, ring_evidence
from cmp_tactile_processing.tracking.corners.neighbours import (
    edge_crossings,
)
from cmp_tactile_processing.tracking.corners.saddle_lattice import SaddleLattice, SaddleResponse
from cmp_tactile_processing.tracking.detector import STEPS, NominalGrid, draw_nominal

# A detector's corner serves if the sub-pixel fit finds home from it: a pixel and a half.
DETECTED_PX = 1.5
# The drawing's own corners are exact to this, px.
DRAWN_PX = 0.3
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


@pytest.mark.parametrize("blur", [2.0, 4.0])
@pytest.mark.parametrize("sigma", [0.0, 16.0])
def test_blur_and_noise_leave_it_whole(blur, sigma):
    corners = straight_grid(8, 9)
    picture = cv2.GaussianBlur(ideal(corners), (0, 0), blur).astype(float)
    picture += np.random.default_rng(0).normal(0, sigma, picture.shape)
    graph = detected(np.clip(np.rint(picture), 0, 255).astype(np.uint8), corners)
    assert_is_lattice(graph, corners)


def test_a_lattice_seen_turned_and_stretched_against_the_nominal_is_found_whole():
    nominal = straight_grid(9, 9) + 40
    middle = nominal.mean(axis=(0, 1))
    angle = np.radians(18)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    seen = (nominal - middle) @ (turn @ np.diag([1.25, 0.8])).T + middle
    prepared = Prefilter((300, 300), PITCH_PX).prepare(ideal(seen, 120)[:300, :300])
    graph = SaddleLattice(_grid_of(nominal), (300, 300)).corner_graph(prepared)
    assert_is_lattice(graph, seen)


def test_grey_margin_does_not_add_a_line_of_corners():
    corners = straight_grid(6, 6)
    picture = ideal(corners)
    low, high = corners[0, 0] - PITCH_PX, corners[-1, -1] + PITCH_PX
    grey = np.full_like(picture, 120)
    inside = np.s_[int(low[1]) : int(high[1]) + 1, int(low[0]) : int(high[0]) + 1]
    grey[inside] = picture[inside]
    assert_is_lattice(detected(cv2.GaussianBlur(grey, (0, 0), 0.8), corners), corners)


def test_pictures_without_corners_give_none():
    corners = straight_grid(6, 6)
    noise = np.random.default_rng(1).integers(0, 255, (200, 200)).astype(np.uint8)
    stripes = np.tile(np.repeat([40, 200], 17), 6)[None].repeat(200, axis=0).astype(np.uint8)
    for picture in (np.zeros((200, 200), np.uint8), stripes[:, :200].copy()):
        assert len(detected(picture, corners).position) == 0
    # Chance saddles in noise have no edges to each other: no more than a pair or two.
    assert len(detected(noise, corners).position) < 8


def test_the_strongest_are_kept_where_there_are_too_many():
    corners = straight_grid(8, 8)
    smooth = ideal(corners).astype(np.float32)
    every = SaddleResponse(smooth.shape, PITCH_PX, 500).candidates(smooth, 5.0)
    few = SaddleResponse(smooth.shape, PITCH_PX, 70).candidates(smooth, 5.0)
    assert len(every) >= 64
    assert 0 < len(few) <= 70
    assert set(map(tuple, few)) <= set(map(tuple, every))


def test_evidence_outside_the_image_and_crossings_without_edges_are_nan():
    flat = np.full((50, 50), 100.0, np.float32)
    step = np.array([[0.0, 10.0]]), np.array([[10.0, 0.0]])
    rim, other, middle = np.array([[1.0, 25.0]]), np.array([[1.0, 35.0]]), np.array([[25.0, 25.0]])
    assert np.isnan(ring_evidence(flat, rim, *step)[0, 1])
    assert np.isnan(edge_evidence(flat, rim, other, step[1])).all()
    assert np.isnan(edge_crossings(flat, middle, *step, np.array([80.0]))).all()


@pytest.mark.parametrize("radius", [3, 4, 5])
def test_a_destroyed_corner_is_measured_by_its_gridlines(radius):
    corners = straight_grid(7, 7, shear=0.1)
    picture = ideal(corners)
    x, y = corners[3, 3]
    cv2.circle(picture, (round(x), round(y)), radius, 190, -1, cv2.LINE_AA)
    smooth = cv2.GaussianBlur(picture, (0, 0), 1.0).astype(np.float32)
    row_step = (corners[4, 3] - corners[2, 3])[None] / 2
    col_step = (corners[3, 4] - corners[3, 2])[None] / 2
    start = corners[3, 3][None] + [1.0, -1.0]
    crossing = edge_crossings(smooth, start, row_step, col_step, np.array([80.0]))
    np.testing.assert_allclose(crossing[0], corners[3, 3], atol=DRAWN_PX)
