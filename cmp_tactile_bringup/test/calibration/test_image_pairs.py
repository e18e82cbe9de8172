"""Images of two cameras are paired by the numbers in their names, never by their places in a list.

Public reports, tried here (report: trial: result):
- dkogan/mrcal 38: instants are the part of the names that changes, and some lack a camera: paired
- dicengine/dice 126: numbers with unlike numbers of digits: paired
- bvnayak/stereo_calibration 4: lists of unlike length: the rest is left out, and named
"""

from pathlib import Path

import pytest

from cmp_tactile_bringup.calibration.frames import pairs_by_number
from cmp_tactile_bringup.recordings.library import RecordingError


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
    lefts, rights = _names(left, 1, 2, 4, 10), _names(right, 10, 1, 2, 3)
    pairs, alone = pairs_by_number(lefts, rights)
    assert pairs == list(zip(_names(left, 1, 2, 10), _names(right, 1, 2, 10), strict=True))
    assert alone == [*_names(left, 4), *_names(right, 3)]


def test_one_pair_alone():
    pair = Path("cam0_04.png"), Path("cam1_04.png")
    assert pairs_by_number([pair[0]], [pair[1]]) == ([pair], [])
    with pytest.raises(RecordingError, match=r"L04.png .*R03.png: found no number"):
        pairs_by_number([Path("L04.png")], [Path("R03.png")])


def test_names_that_say_nothing_are_refused():
    with pytest.raises(RecordingError, match=r"b.png: found no number"):
        pairs_by_number([Path("a1.png"), Path("b.png")], _names("r{}.png", 1, 2))
    with pytest.raises(RecordingError, match=r"y/1.png: found .* x/1.png"):
        pairs_by_number([Path("x/1.png"), Path("y/1.png")], _names("r{}.png", 1, 2))
