"""The page in Markdown: tables that stay tables, claims counted, figures beside it."""

import itertools
from pathlib import Path

import pytest

from paper.page import Page, add_claims, add_summary


@pytest.fixture
def page(tmp_path: Path) -> Page:
    page = Page(tmp_path)
    page.claim("resolution.finer", met=False, cmp=6.5, dots=13.9)
    page.claim("density.density", met=True, corners=190, virtual=2169, measured=2168.6)
    page.claim("reliability.contrast", met=None, range="a | b")
    return page


def _lines(page: Page) -> list[str]:
    return page.write("paper.md").read_text(encoding="utf-8").splitlines()


def test_bars_in_cells_end_no_cell(page: Page) -> None:
    page.table("balls.fits", [["|CMP|"] * 8])
    add_claims(page, page.claims)
    lines = _lines(page)
    assert lines[0].startswith(r"| reading | markers in a fit | \|fitted - ball\|, % |")
    for line, following in itertools.pairwise(lines):
        if following.startswith("| ---"):
            assert line.replace(r"\|", "").count("|") == following.count("|")


def test_claims_are_counted_and_those_missed_come_first(page: Page) -> None:
    add_summary(page, page.claims, fast=True)
    text = "\n".join(_lines(page))
    assert "3 claims: 1 met, 1 not met; 1 could not be missed." in text
    missed = "depth near the spheres off by 6.5 um RMS; DMP at best 13.9 um |"
    assert any(line.startswith("| IV.E: five") and line.endswith(missed) for line in _lines(page))
    assert "density" not in text
