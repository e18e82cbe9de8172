"""The steps of contour stitching and gridline pointers, each against a known grid."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.contour_stitching import (
    CORNER_SIGNS,
    Checkers,
    Pretreatment,
    build_graph,
    find_checkers,
    merge_corners,
)
from cmp_tactile_processing.gridline_curves import curve_points, curve_residual
from cmp_tactile_processing.gridline_pointer import drop_strained, traverse
from cmp_tactile_processing.nominal_grid import NominalGrid
from cmp_tactile_processing.optics import build_views
from cmp_tactile_processing.saddle_point import refine_saddle_points

SIDE = 20.0


def dark_checkers(rows, cols, jitter=0.0, seed=0):
    """Quadrangles of the dark checkers around rows x cols corners, and the corners' places."""
    rng = np.random.default_rng(seed)
    quads = [
        (SIDE * (np.array([r, c]) + (CORNER_SIGNS + 1) / 2 - 1))[:, ::-1]
        for r in range(rows + 1)
        for c in range(cols + 1)
        if (r + c) % 2 == 0
    ]
    return Checkers(np.array(quads) + rng.normal(0, jitter, (len(quads), 4, 2)))


@pytest.mark.parametrize(("rows", "cols"), [(4, 4), (5, 8), (20, 20)])
def test_numbers_follow_from_connectivity_alone(rows, cols):
    checkers = dark_checkers(rows, cols, jitter=1.0)
    (island,) = traverse(build_graph(checkers, merge_corners(checkers, SIDE)))
    number = island.number - island.number.min(axis=0)
    assert len(number) == rows * cols
    # Jitter of 1 px, averaged over two outlines, stays within 5 px: four and more sigma.
    np.testing.assert_allclose(island.position, SIDE * number[:, ::-1], atol=5)
    np.testing.assert_array_equal(island.even, number.sum(axis=1) % 2 == 0)


def test_order_of_the_outlines_does_not_matter():
    checkers = dark_checkers(6, 7)
    shuffled = Checkers(np.random.default_rng(1).permutation(checkers.corners))
    grids = []
    for one in (checkers, shuffled):
        (island,) = traverse(build_graph(one, merge_corners(one, SIDE)))
        number = island.number - island.number.min(axis=0)
        grids.append(sorted(map(tuple, np.hstack([number, island.position]).tolist())))
    assert grids[0] == grids[1]


def test_a_pointer_that_no_gel_could_strain_is_dropped():
    checkers = dark_checkers(6, 6)
    graph = build_graph(checkers, merge_corners(checkers, SIDE))
    steps = (
        np.tile([0.0, SIDE], (len(graph.position), 1)),
        np.tile([SIDE, 0.0], (len(graph.position), 1)),
    )
    assert (drop_strained(graph, *steps).neighbour == graph.neighbour).all()
    # The same outlines seen by a rig that expects checkers of three times the side fit nowhere.
    expected_larger = drop_strained(graph, 3 * steps[0], 3 * steps[1])
    assert (expected_larger.neighbour == -1).all()


def test_a_gap_makes_two_islands_largest_first():
    corners = dark_checkers(6, 9).corners
    middle = np.abs(corners.mean(axis=1)[:, 0] - 5.5 * SIDE) < 1.1 * SIDE
    checkers = Checkers(corners[~middle])
    islands = traverse(build_graph(checkers, merge_corners(checkers, SIDE)))
    assert len(islands) == 2
    assert len(islands[0].position) > len(islands[1].position)


def test_a_false_pointer_does_not_shift_what_lies_behind_it():
    """Two corners of a row are lost and their neighbours joined: no other number may change."""
    checkers = dark_checkers(12, 12)
    graph = build_graph(checkers, merge_corners(checkers, SIDE))
    i, j = np.rint(graph.position.T[::-1] / SIDE).astype(int)
    merged = graph.merged & ~((i == 3) & (j >= 5) & (j <= 6))
    neighbour = graph.neighbour.copy()
    (left,), (right,) = (np.flatnonzero((i == 3) & (j == col)) for col in (4, 7))
    neighbour[left, 1], neighbour[right, 3] = right, left
    island = traverse(replace(graph, merged=merged, neighbour=neighbour))[0]
    offset = island.number - np.rint(island.position[:, ::-1] / SIDE).astype(int)
    assert len(np.unique(offset, axis=0)) == 1
    assert len(offset) >= 12 * 12 - 4


def test_corners_that_are_not_opposite_do_not_merge():
    """Algorithm 1 merges corner 1 with 3 and 2 with 4 only: a shifted outline is left alone."""
    corners = dark_checkers(4, 4).corners[:1]
    beside = Checkers(np.concatenate([corners, corners + [SIDE, 0]]))
    assert len(merge_corners(beside, SIDE)) == 0
    diagonal = Checkers(np.concatenate([corners, corners + [SIDE, SIDE]]))
    assert merge_corners(diagonal, SIDE).tolist() == [[0, 2, 1, 0]]


def test_a_corner_has_one_partner_only():
    """A second outline over a checker competes for its corners; the nearer one gets them."""
    corners = dark_checkers(4, 4).corners
    doubled = Checkers(np.concatenate([corners, corners[:1] + 3.0]))
    pairs = merge_corners(doubled, SIDE)
    used = np.concatenate([pairs[:, 0] * 4 + pairs[:, 1], pairs[:, 2] * 4 + pairs[:, 3]])
    assert len(np.unique(used)) == len(used)


def test_nothing_is_merged_from_nothing():
    empty = Checkers(np.empty((0, 4, 2)))
    pairs = merge_corners(empty, SIDE)
    assert pairs.shape == (0, 4)
    assert traverse(build_graph(empty, pairs)) == []


def test_outlines_have_their_true_corners(sensor, stills, view_image):
    """Erosion is made good by expansion: stitched corners are within 2 px of the truth."""
    view = build_views(sensor)["left"]
    nominal = NominalGrid.of_view(sensor.pattern, view)
    truth = view.placement.from_frame(stills["press"].truth["corners_left_px"])
    for erosion in (1, 2, 3):
        image = view_image(stills["press"], "left")
        checkers = find_checkers(cv2.medianBlur(image, 3), nominal, Pretreatment(2.0, erosion))
        (island, *_) = traverse(build_graph(checkers, merge_corners(checkers, nominal.side_px)))
        number = island.number - island.number.min(axis=0)
        assert len(number) == 400
        error = island.position - truth[number[:, 0], number[:, 1]]
        assert np.linalg.norm(error, axis=1).max() < 2
        assert np.abs(error.mean(axis=0)).max() < 0.5


def test_saddle_point_is_found_from_afar_and_between_pixels():
    """Closed form: a product of two smooth edges, turned, has its saddle where they cross."""
    y, x = np.mgrid[:60, :60]
    rng = np.random.default_rng(2)
    for _ in range(20):
        centre = 30 + rng.uniform(-0.5, 0.5, 2)
        angle = rng.uniform(0, np.pi)
        u = (x - centre[0]) * np.cos(angle) + (y - centre[1]) * np.sin(angle)
        v = -(x - centre[0]) * np.sin(angle) + (y - centre[1]) * np.cos(angle)
        image = (120 + 80 * np.tanh(u / 2) * np.tanh(v / 2)).astype(np.float32)
        start = centre[None] + rng.uniform(-1.5, 1.5, 2)
        found = refine_saddle_points(image, start, 3, 6.0).position
        # Odd about the centre, so the fit itself has no bias; interpolation leaves 0.01 px.
        np.testing.assert_allclose(found[0], centre, atol=0.01)


def test_no_saddle_gives_nan():
    y, x = np.mgrid[:40, :40].astype(np.float32)
    hill = -((x - 20) ** 2) - (y - 20) ** 2
    flat = np.full((40, 40), 7, np.float32)
    for image in (hill, flat, x):
        assert np.isnan(
            refine_saddle_points(image, np.array([[20.0, 20.0]]), 3, 5.0).position
        ).all()
    border = np.array([[0.0, 0.0], [39.0, 20.0], [np.nan, 3.0]])
    assert np.isnan(refine_saddle_points(x * y, border, 3, 5.0).position).all()


def test_curves_reproduce_parabolas_exactly():
    s = np.arange(6.0)
    line = np.stack([s, 0.3 * s**2 - s], axis=-1)[None]
    t = (np.arange(5)[:, None] + np.array([0.25, 0.5, 0.75])).ravel()
    expected = np.stack([t, 0.3 * t**2 - t], axis=-1)
    np.testing.assert_allclose(curve_points(line, 3).reshape(-1, 2), expected, atol=1e-12)


def test_curve_is_missing_only_next_to_missing_corners():
    line = np.stack([np.arange(7.0), np.zeros(7)], axis=-1)[None].copy()
    line[0, 3] = np.nan
    missing = np.isnan(curve_points(line, 2)).any(axis=(0, 2, 3))
    assert missing.tolist() == [False, False, True, True, False, False]


def test_curve_residual_is_the_noise():
    corners = np.stack(np.meshgrid(np.arange(30.0), np.arange(30.0)), axis=-1) * 17
    noise = np.random.default_rng(5).normal(0, 0.05, corners.shape)
    assert curve_residual(corners) < 1e-12
    # RMS over both coordinates of sigma 0.05 a coordinate; 900 corners leave a few per cent.
    assert curve_residual(corners + noise) == pytest.approx(0.05 * np.sqrt(2), rel=0.1)
