"""Images of a board: which frames of a live capture are kept, which images of two cameras pair."""

from pathlib import Path

import numpy as np
import pytest

from cmp_tactile_bringup.calibration.frames import BoardCapture, BoardView, Choice
from cmp_tactile_driver.bags.pairs import pairs_by_number
from cmp_tactile_processing.calibration.board.target import BoardSighting, BoardTarget
from cmp_tactile_processing.errors import FrameSourceError

TARGET = BoardTarget("chessboard", 9, 6, 0.01)
SIZE = (640, 480)


def sighting(x=320.0, y=240.0, side=30.0, lean=0.0, view="left"):
    """A board with its middle at (x, y) px, squares of that side, sheared by `lean`."""
    q = (TARGET.points[:, :2] / TARGET.square - (4.0, 2.5)) * side
    q = q @ np.array([[1.0, lean], [0.0, 1.0]]).T + (x, y)
    everything = np.arange(len(q))
    return BoardSighting(view, everything, q, np.full(len(q), 0.1), 1.0, side, SIZE)


def shown(capture, item, times=2):
    """What comes of a board that is held so for some frames."""
    return [capture.consider({"left": item}) for _ in range(times)][-1]


def test_a_board_is_kept_once_it_is_still_and_not_twice_in_one_place():
    capture = BoardCapture(TARGET)
    assert capture.consider({"left": sighting()}) is Choice.MOVING
    assert capture.consider({"left": sighting()}) is Choice.KEPT
    assert capture.consider({"left": sighting()}) is Choice.ALIKE
    assert capture.consider({"left": sighting(x=325)}) is Choice.MOVING
    assert capture.consider({"left": None}) is Choice.NOT_SEEN
    assert shown(capture, sighting(x=480, side=20)) is Choice.KEPT


def test_a_board_that_one_of_the_views_does_not_show_is_not_kept():
    capture = BoardCapture(TARGET)
    for _ in range(3):
        assert capture.consider({"left": sighting(), "right": None}) is Choice.NOT_SEEN


def test_what_is_missing_is_named_until_everything_was_shown():
    capture = BoardCapture(TARGET)
    assert "tilt it more" in capture.missing
    assert shown(capture, sighting(x=140, y=100, side=20)) is Choice.KEPT
    assert shown(capture, sighting(x=500, y=400, side=20)) is Choice.KEPT
    assert capture.missing == "bring it nearer and farther, tilt it more, about both axes"
    assert shown(capture, sighting(side=60)) is Choice.KEPT
    assert shown(capture, sighting(lean=0.6, side=25)) is Choice.KEPT
    assert not capture.missing


def test_part_of_a_charuco_board_shows_where_all_of_it_is():
    whole = sighting(x=300, y=200, lean=0.3)
    seen = whole.number % 9 > 2
    part = BoardSighting(
        "left", whole.number[seen], whole.pixels[seen], whole.std[seen], 1.0, 30.0, SIZE
    )
    np.testing.assert_allclose(
        BoardView.from_sighting(part, TARGET).values,
        BoardView.from_sighting(whole, TARGET).values,
        atol=1e-6,
    )


def _names(pattern: str, *numbers: int) -> list[Path]:
    return [Path(pattern.format(number)) for number in numbers]


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("L{:02d}.png", "R{:02d}.png"),
        ("left/{}.png", "right/{}.png"),
        ("cam0_{:04d}.png", "cam1_{:04d}.png"),
        ("2026-01-02_{}_left.png", "r{}.jpg"),
        ("{}_1.png", "{}_2.png"),
    ],
)
def test_one_missing_image_a_side_moves_no_other(left, right):
    """Images are paired by the numbers in their names, never by their places in a list.

    Public reports, tried here (report: trial: result):
    - dkogan/mrcal 38: instants are the part of names that changes, and some lack a camera: paired
    - dicengine/dice 126: numbers with unlike numbers of digits: paired
    - bvnayak/stereo_calibration 4: lists of unlike length: the rest is left out, and named
    """
    lefts, rights = _names(left, 1, 2, 4, 10), _names(right, 10, 1, 2, 3)
    pairs, alone = pairs_by_number(lefts, rights)
    assert pairs == list(zip(_names(left, 1, 2, 10), _names(right, 1, 2, 10), strict=True))
    assert alone == [*_names(left, 4), *_names(right, 3)]


def test_one_pair_alone():
    pair = Path("cam0_04.png"), Path("cam1_04.png")
    assert pairs_by_number([pair[0]], [pair[1]]) == ([pair], [])
    with pytest.raises(FrameSourceError, match=r"L04.png .*R03.png: found no number"):
        pairs_by_number([Path("L04.png")], [Path("R03.png")])


def test_names_that_say_nothing_are_refused():
    with pytest.raises(FrameSourceError, match=r"b.png: found no number"):
        pairs_by_number([Path("a1.png"), Path("b.png")], _names("r{}.png", 1, 2))
    with pytest.raises(FrameSourceError, match=r"y/1.png: found .* x/1.png"):
        pairs_by_number([Path("x/1.png"), Path("y/1.png")], _names("r{}.png", 1, 2))
