"""Sheets: room, papers and marks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.printing.pattern import PrintOptions, printed_pattern
from cmp_tactile_processing.printing.sheet import PAPERS, print_sheet
from cmp_tactile_processing.sensor.description import load_sensor


@pytest.mark.parametrize("paper", PAPERS)
def test_everything_lies_on_the_paper(paper):
    """Everything but text, of which the length is not known exactly."""
    sheet = print_sheet("fingertip", printed_pattern(load_sensor("sample_rig")), paper)
    points = np.concatenate([*sheet.ink, *(line.points for line in sheet.lines)])
    edge = 5 if paper == "fit" else 10
    assert (points >= edge - 1e-9).all()
    assert (points <= np.array([sheet.width, sheet.height]) - edge + 1e-9).all()


def test_an_unknown_paper_and_one_that_is_too_small_are_refused():
    rig = load_sensor("sample_rig")
    with pytest.raises(InputError, match=r"^paper: found 'A3', expected one of A4, letter"):
        print_sheet("rig", printed_pattern(rig), "A3")
    block = replace(rig.elastomer, size=(0.18, 0.12, 0.006))
    wide = printed_pattern(replace(rig, elastomer=block))
    with pytest.raises(InputError, match=r"^paper: found A4 with room for 184\.0 x 263\.0 mm"):
        print_sheet("wide", wide)
    assert print_sheet("wide", wide, "fit").width > 190


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("bleed", [0.0, 0.006])
def test_marks_stay_off_the_gel_the_margin_and_the_bleed(bleed, mirrored):
    """What is left on the skin after cutting is the pattern alone."""
    printed = printed_pattern(load_sensor("sample_rig"), PrintOptions(bleed=bleed))
    sheet = print_sheet("rig", printed, mirrored=mirrored)
    kept_free = np.abs(np.concatenate([printed.clear, printed.gel])).max(axis=0)
    marks = [line.points for line in sheet.lines if line.layer == "MARKS"]
    for points in marks:
        assert (np.abs(points - sheet.apex) >= kept_free + 2).any(axis=1).all()
