"""Views of a drawn coded pattern: every piece is numbered by its dots, or the fault is named."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.measured import Grid, GridFault, NumberingKind
from cmp_tactile_processing.sensor.dot_code import dot_map
from cmp_tactile_processing.tracking.tracker import GridTracker

# The drawing smooths the checkers' edges to a quarter of a pixel: what its corners are off.
DRAWN_PX = 1.5
GREY = 120
# Checkers from what covers the pattern within which corners may be missing.
FAR = 2.2

Image = NDArray[np.uint8]


@pytest.fixture(scope="module")
def coded(sensor):
    return replace(sensor, pattern=replace(sensor.pattern, code="dots", code_seed=4))


@pytest.fixture(scope="module")
def kept_tracker(coded):
    return GridTracker(coded, "left")


@pytest.fixture
def photograph(draw, nominal):
    """Draws the pattern, moved by px, with the dots of a seed; None: without any."""

    def drawn(moved: tuple[float, float] = (0.0, 0.0), seed: int | None = 4) -> Image:
        return draw(nominal, moved, None if seed is None else dot_map(21, 21, seed))

    return drawn


def _assert_right(grid: Grid, truth: NDArray[np.float64], expected: NDArray[np.bool_]) -> None:
    """All expected corners are there, and none is wrong."""
    error = np.linalg.norm(grid.corners - truth, axis=-1)
    found = np.isfinite(error)
    assert error[found].max() < DRAWN_PX
    assert found[expected].all(), np.argwhere(expected & ~found)


def _far_from(covered: NDArray[np.bool_], truth: NDArray[np.float64], side: float) -> NDArray:
    """Corners in the image that lie FAR checkers from what is covered and from its edge."""
    reach = int(FAR * side)
    hidden = np.pad(covered, reach, constant_values=True)
    around = np.zeros(truth.shape[:2], bool)
    for index in np.ndindex(around.shape):
        x, y = np.rint(truth[index]).astype(int)
        inside = 0 <= x < covered.shape[1] and 0 <= y < covered.shape[0]
        around[index] = inside and not hidden[y : y + 2 * reach + 1, x : x + 2 * reach + 1].any()
    return around


@pytest.mark.parametrize(
    "checkers", [(0.0, 0.0), (2.0, 0.0), (-7.0, 3.0), (4.3, -9.6), (13.0, 0.0)]
)
def test_slides_of_any_size(checkers, tracker, photograph, nominal):
    """Also by whole checkers, and with one border after the other out of the image."""
    moved = nominal.side_px * np.array(checkers)
    image = photograph(tuple(moved))
    grid = tracker.track(image)
    truth = nominal.corners + moved
    expected = _far_from(np.zeros(image.shape, bool), truth, nominal.largest_side_px)
    assert expected.sum() >= 60
    _assert_right(grid, truth, expected)


@pytest.mark.parametrize("pieces", ["cross", "frame", "strip"])
def test_what_hides_the_border_and_cuts_the_grid_into_pieces(pieces, tracker, photograph, nominal):
    image = photograph()
    low, high = nominal.corners.min(axis=(0, 1)), nominal.corners.max(axis=(0, 1))
    y, x = np.indices(image.shape)
    u, v = (x - low[0]) / (high[0] - low[0]), (y - low[1]) / (high[1] - low[1])
    covered = {
        "cross": (np.abs(u - 0.5) < 0.06) | (np.abs(v - 0.5) < 0.06),
        "frame": (np.maximum(np.abs(u - 0.5), np.abs(v - 0.5)) > 0.33),
        "strip": np.abs(u - 0.5) > 0.2,
    }[pieces]
    image[covered] = GREY
    grid = tracker.track(image)
    expected = _far_from(covered, nominal.corners, nominal.largest_side_px)
    assert expected.sum() >= 50
    _assert_right(grid, nominal.corners, expected)
    assert grid.fault is GridFault.PARTLY_HIDDEN


@pytest.mark.parametrize(
    ("seen", "fault"),
    [
        pytest.param(lambda image: image[:, ::-1], GridFault.MIRRORED, id="mirrored"),
        pytest.param(lambda image: image[::-1], GridFault.MIRRORED, id="upside down"),
        pytest.param(lambda image: image[::-1, ::-1], GridFault.TURNED, id="turned"),
        pytest.param(lambda image: 255 - image, GridFault.OTHER_COLOURS, id="inverted"),
    ],
)
@pytest.mark.parametrize("covered", [0.0, 0.6])
def test_views_that_are_described_otherwise(seen, fault, covered, tracker, photograph):
    """Of a part of the pattern as of the whole."""
    image = photograph()
    image[: int(covered * image.shape[0] / 2)] = GREY
    grid = tracker.track(np.ascontiguousarray(seen(image)))
    assert not np.isfinite(grid.corners).any()
    assert grid.fault is fault


@pytest.mark.parametrize(("seed", "reason"), [(5, "another sheet"), (None, "have no dots")])
def test_other_patterns_are_refused(seed, reason, tracker, photograph):
    grid = tracker.track(photograph(seed=seed))
    assert not np.isfinite(grid.corners).any()
    assert grid.fault is GridFault.OTHER_PATTERN
    assert reason in grid.reason


def test_a_second_pattern_of_another_code_beside_a_part_of_ours(tracker, photograph, nominal):
    image, other = photograph(), photograph(seed=9)
    middle = int(nominal.corners[..., 0].mean())
    image[:, middle:] = other[:, middle:]
    image[:, middle - 6 : middle + 6] = GREY
    grid = tracker.track(image)
    covered = np.indices(image.shape)[1] >= middle - 6
    _assert_right(grid, nominal.corners, _far_from(covered, nominal.corners, nominal.side_px))
    assert not np.isfinite(grid.corners[nominal.corners[..., 0] > middle]).any()
    assert grid.fault is GridFault.TWO_PATTERNS


def test_dots_are_no_defects_of_the_print(tracker, photograph, nominal):
    image = photograph()
    x, y = np.rint(nominal.corners[5, 6]).astype(int)
    image[y - 3 : y + 4, x - 3 : x + 4] = 190
    defects = tracker.inspect_print([image]).defects
    tracker.use_print_defects(None)
    places = np.array([(defect.row, defect.col) for defect in defects])
    assert np.linalg.norm(places - (5, 6), axis=1).min() < 0.3
    checker = np.rint(places + 0.5).astype(int)
    in_the_middle = np.linalg.norm(places + 0.5 - checker, axis=1) < 0.2
    assert not (in_the_middle & dot_map(21, 21, 4)[checker[:, 0], checker[:, 1]]).any()


def test_checkers_too_small_for_dots_are_an_error(sensor):
    pattern = replace(sensor.pattern, rows=55, cols=55, pitch=sensor.pattern.pitch * 21 / 56)
    GridTracker(replace(sensor, pattern=pattern), "left")
    with pytest.raises(InputError, match=r"expected at least 6.5 px with code: dots"):
        GridTracker(replace(sensor, pattern=replace(pattern, code="dots")), "left")


# Beyond the view.

NUMBERED, BESIDE = 16, 2


@pytest.fixture(scope="module")
def part(coded):
    """The middle 16 x 16 corners of a sheet, of which the view shows 20 x 20."""
    pattern = replace(coded.pattern, rows=NUMBERED, cols=NUMBERED, border="beyond_view")
    return replace(coded, pattern=pattern)


@pytest.fixture
def sheet(draw, part, nominal):
    """Draws what the view shows of the sheet, moved by px."""
    extent = 21 * part.pattern.pitch
    shown = part.pattern.sheet((extent, extent))
    assert shown.rows == shown.cols == NUMBERED + 2 * BESIDE
    return lambda moved=(0.0, 0.0): draw(nominal, moved, shown.dots())


@pytest.mark.parametrize("seen", [slice(None), slice(0, 400), slice(380, None)])
def test_part_of_a_sheet_that_goes_on_beyond_the_view(seen, part, sheet, nominal):
    """Each frame by itself, after knocks that would be taken for no motion without the dots."""
    tracker = GridTracker(part, "left")
    inner = slice(BESIDE, BESIDE + NUMBERED)
    for checkers in ((0.0, 0.0), (2.0, 0.0), (1.0, -1.0), (1.1, -1.0), (-4.0, 3.0)):
        moved = nominal.side_px * np.array(checkers)
        image = sheet(moved)
        covered = np.ones(image.shape, bool)
        covered[seen] = False
        image[covered] = GREY
        grid = tracker.track(image)
        assert grid.numbering is NumberingKind.ABSOLUTE
        truth = (nominal.corners + moved)[inner, inner]
        expected = _far_from(covered, truth, nominal.largest_side_px)
        assert expected.sum() >= 40
        _assert_right(grid, truth, expected)


def test_a_view_of_another_part_of_the_sheet_is_reported(part, draw, nominal):
    """Of corners outside of rows x cols none gets a number."""
    elsewhere = dot_map(61, 61, part.pattern.code_seed)[:21, :21]
    grid = GridTracker(part, "left").track(draw(nominal, 0.0, elsewhere))
    assert not np.isfinite(grid.corners).any()
    assert "outside of rows x cols" in grid.reason


def test_dots_that_cannot_be_read_leave_a_sheet_beyond_the_view_without_numbers(
    part, draw, nominal
):
    grid = GridTracker(part, "left").track(cv2.GaussianBlur(draw(nominal), (0, 0), 3.0))
    assert not np.isfinite(grid.corners).any()
    assert grid.fault is GridFault.AMBIGUOUS
