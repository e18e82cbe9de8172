"""The page in Markdown: tables that stay tables, claims counted, figures beside it."""

import itertools
from pathlib import Path

import pytest

from paper.figure_style import panels
from paper.page import Page, add_claims, add_facts, add_summary


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


def test_a_figure_lies_beside_the_page_and_is_the_same_each_time(page: Page) -> None:
    files = []
    for _ in range(2):
        figure, axes = panels(1, 1, 2.0)
        axes.plot([0, 1])
        page.figure(figure, "grasp.knocks")
        files.append((page.folder / "grasp_knocks.png").read_bytes())
    assert files[0] == files[1]
    link, _ = (line for line in _lines(page) if line.startswith("!["))
    assert link.endswith("; a point is one knock](grasp_knocks.png)")


def test_a_head_that_is_one_field_stands_for_its_values(page: Page) -> None:
    page.table("objects.errors", [("ring", "1 mm", "2", "3")], methods=["CMP", "DMP"])
    assert page.parts[0].startswith("| object | press | CMP | DMP |")


def test_departures_have_four_columns_and_no_open_field(page: Page) -> None:
    page.departures("precision", diameter=0.35)
    table = page.parts[-1].splitlines()
    assert all(line.count("|") == 5 for line in table)
    assert "{" not in page.parts[-1]
    assert "diameter 0.35 of the pitch" in page.parts[-1]


def test_the_page_says_what_it_was_made_with(page: Page) -> None:
    add_facts(page, {"Run": "fast"}, page.folder)
    assert "| Run | fast |" in "\n".join(page.parts)
    assert "no checkout" in "\n".join(page.parts)
