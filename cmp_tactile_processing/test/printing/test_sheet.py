"""Sheets: room, copies, papers, marks and names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.printing.pattern import PrintOptions, printed_pattern
from cmp_tactile_processing.printing.sheet import PAPERS, print_sheet, printed_copy
from cmp_tactile_processing.sensor.description import load_sensor


@pytest.fixture(scope="module")
def copy():
    return printed_copy("fingertip", printed_pattern(load_sensor("sample_rig")))


def reach(drawing):
    """Lowest and highest coordinates of everything but text."""
    points = [contour for ink in drawing.ink for contour in ink]
    points += [line.points for line in drawing.lines]
    everything = np.concatenate(points)
    return everything.min(axis=0), everything.max(axis=0)


@pytest.mark.parametrize("paper", PAPERS)
@pytest.mark.parametrize("copies", [1, 16])
def test_everything_lies_on_the_paper_and_no_copy_on_another(paper, copies, copy):
    sheet = print_sheet(copy, paper, copies)
    low, high = reach(sheet.drawing)
    edge = 5 if paper == "fit" else 10
    assert (low >= edge - 1e-9).all()
    assert high[0] <= sheet.width - edge + 1e-9
    assert high[1] <= sheet.height - edge + 1e-9
    assert len(sheet.origins) == len(sheet.drawing.ink) == copies
    boxes = [(copy.low + origin, copy.high + origin) for origin in sheet.origins]
    for number, (low, high) in enumerate(boxes):
        for other_low, other_high in boxes[:number]:
            assert (low >= other_high).any() or (high <= other_low).any()
    assert any(line.layer == "CUT" for line in sheet.drawing.lines) == (copies > 1)


def test_copies_that_have_no_room_are_refused_with_how_many_have(copy):
    assert len(print_sheet(copy, "letter", 16).origins) == 16
    with pytest.raises(InputError, match=r"^copies: found 17, expected at most 16 of .* mm on"):
        print_sheet(copy, "letter", 17)
    with pytest.raises(InputError, match=r"^copies: found 0, expected 1 or more"):
        print_sheet(copy, "A4", 0)
    with pytest.raises(InputError, match=r"^paper: found 'A3', expected one of A4, letter"):
        print_sheet(copy, "A3")


def test_a_pattern_larger_than_the_paper_is_refused_but_fits_a_fitting_one():
    rig = load_sensor("sample_rig")
    block = replace(rig.elastomer, size=(0.18, 0.12, 0.006))
    wide = printed_copy("wide", printed_pattern(replace(rig, elastomer=block)))
    with pytest.raises(InputError, match=r"^paper: found A4 with room for 184\.0 x 263\.0 mm"):
        print_sheet(wide)
    assert print_sheet(wide, "fit").width > 190


def test_marks_stay_off_the_gel_the_margin_and_the_bleed():
    """What is left on the skin after cutting is the pattern alone."""
    rig = load_sensor("sample_rig")
    for bleed in (0.0, 0.006):
        printed = printed_pattern(rig, PrintOptions(bleed=bleed))
        copy = printed_copy("rig", printed)
        kept_free = np.abs(np.concatenate([printed.clear, printed.gel])).max(axis=0)
        marks = [line.points for line in copy.drawing.lines if line.layer == "REGISTRATION"]
        for points in (*marks, *copy.drawing.solids):
            assert (np.abs(points) >= kept_free + 0.5).any(axis=1).all()
        assert min(copy.targets - kept_free) >= 3
