"""Live capture of a board: which frames are kept, and what is reported of those still missing."""

import numpy as np

from cmp_tactile_bringup.calibration.frames import BoardCapture, BoardView, Choice
from cmp_tactile_processing.calibration.board.target import BoardSighting, BoardTarget

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
