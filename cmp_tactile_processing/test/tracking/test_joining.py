"""Fragments that continue the known corners, and corners that their neighbours contradict."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cmp_tactile_processing.tracking.detector import Component, NominalGrid
from cmp_tactile_processing.tracking.numbering.joining import drop_loose_corners, joined

SIDE_PX = 16.0
# Limits of displacement between a corner and what its neighbours expect: 0.3 sides and 1.5 px.
LOOSE_PX = 0.3 * SIDE_PX + 1.5


def lattice(rows: int, cols: int) -> np.ndarray:
    i, j = np.indices((rows, cols), dtype=np.float64)
    return SIDE_PX * np.stack([j, i], axis=-1)


def nominal_grid(rows: int, cols: int) -> NominalGrid:
    corners = lattice(rows, cols)
    tree = cKDTree(corners.reshape(-1, 2))
    return NominalGrid(corners, corners, corners, SIDE_PX, SIDE_PX, SIDE_PX, tree)


def component(nominal: NominalGrid, first: tuple[int, int], off_px: float = 0.0) -> Component:
    """3 x 3 corners from `first` on, off along the diagonal, numbered from (0, 0)."""
    number = np.indices((3, 3)).reshape(2, -1).T
    i, j = (number + first).T
    return Component(nominal.corners[i, j] + off_px, number, (i + j) % 2 == 0)


@pytest.mark.parametrize(("share", "is_joined"), [(0.0, True), (0.25, True), (0.3, False)])
def test_a_fragment_between_two_places_is_not_joined(share, is_joined):
    """Diagonal places of its colours are 1.41 sides apart: at 0.3 of that the nearer leads by 0.57.

    Of all other places the best one must not count: they are farther away.
    """
    corners, nominal = lattice(9, 14), nominal_grid(9, 14)
    corners[:, 7:] = np.nan
    fragment = component(nominal, (3, 8), share * SIDE_PX)
    shift = joined(corners, fragment, nominal, even_first=True)
    assert (shift is not None) == is_joined
    if is_joined:
        assert shift.tolist() == [3, 8]


@pytest.mark.parametrize("axis", [0, 1])
def test_a_slope_of_the_displacement_goes_on_with_restraint(axis):
    """0.08 sides between two lines would be 0.6 seven lines on, too far to be joined."""
    nominal = nominal_grid(14, 14)
    corners = nominal.corners.copy()
    lines = corners.swapaxes(0, axis)
    lines[2:] = np.nan
    lines[1, :, 1 - axis] -= 0.08 * SIDE_PX
    first = (7, 4) if axis == 0 else (4, 7)
    shift = joined(corners, component(nominal, first), nominal, even_first=True)
    assert shift is not None
    assert tuple(shift) == first


@pytest.mark.parametrize("contradicting", [0, 1, 2])
def test_a_corner_with_as_many_votes_for_as_against_is_loose(contradicting):
    """The middle of 3 x 3 corners has two pairs of neighbours; off by the mean of a pair's."""
    nominal = lattice(3, 3)
    corners = nominal.copy()
    for i, j in ((1, 0), (1, 2), (0, 1), (2, 1))[: 2 * contradicting]:
        corners[i, j] += 1.2 * LOOSE_PX, 0.0
    drop_loose_corners(corners, nominal)
    assert np.isnan(corners[1, 1]).all() == (contradicting > 0)
    # A corner without neighbours: nobody says where it is.
    alone = np.full_like(nominal, np.nan)
    alone[0, 0] = nominal[0, 0]
    drop_loose_corners(alone, nominal)
    assert np.isnan(alone).all()
