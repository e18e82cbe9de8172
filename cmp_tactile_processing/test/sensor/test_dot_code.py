"""Every window of a coded sheet occurs once, turned and mirrored ones included."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from cmp_tactile_processing.sensor.dot_code import LARGEST_SHEET, WINDOW, dot_map, window_words


@pytest.mark.parametrize("seed", [0, 1, 65535])
@pytest.mark.parametrize("dark", [True, False])
def test_windows_occur_once(seed: int, dark: bool) -> None:
    sheet = dot_map(LARGEST_SHEET, LARGEST_SHEET, seed)
    seen: set[int] = set()
    turned = [(np.rot90(sheet, turns), bool(turns % 2)) for turns in range(4)]
    # A sheet of an odd number of checkers has the same colour in all its corners.
    for image in (image for one, _ in turned for image in (one, one[:, ::-1])):
        words = window_words(image, dark).ravel().tolist()
        assert len(set(words)) == len(words)
        assert not seen & set(words)
        seen |= set(words)
    assert len(seen) == 8 * (LARGEST_SHEET - WINDOW + 1) ** 2


def test_small_sheets_are_corners_of_large_ones() -> None:
    large = dot_map(LARGEST_SHEET, LARGEST_SHEET, 3)
    np.testing.assert_array_equal(dot_map(5, 21, 3), large[:5, :21])
    assert (dot_map(21, 21, 3) != dot_map(21, 21, 4)).mean() > 0.4
    assert 0.45 < large.mean() < 0.55


def test_prints_stay_readable() -> None:
    """What was printed once must be read by every later version: the map may never change."""
    packed = np.packbits(dot_map(LARGEST_SHEET, LARGEST_SHEET, 0)).tobytes()
    assert (
        hashlib.sha256(packed).hexdigest()
        == "5cfdabb05faba07725622e9b1ffe47bd1e62a624e9de578d2dbbdb1ccb52c2af"
    )


@pytest.mark.parametrize("size", [(0, 5), (5, LARGEST_SHEET + 1)])
def test_sheets_of_impossible_size(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="expected 1 to 61 along a side"):
        dot_map(*size)
