"""What is read from the sweep: made-up results give the answer that was put in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from paper.experiment import Figure, Table, Text
from paper.pattern_choice_fields import FIELDS, WAVELENGTHS
from paper.pattern_choice_report import report
from paper.pattern_choice_results import (
    best_pattern,
    by_width,
    cells_of,
    coarsest_that_works,
    errors_at,
    excess,
    works_down_to,
)
from paper.pattern_choice_rig import CONDITIONS

CORNERS = np.array([10.0, 20.0, 40.0, 60.0])
MARKERS = 1000.0


def made_up(width: int) -> dict[str, NDArray[np.float64]]:
    """Sides of 28, 14, 7 and 4.7 px at 1024; errors fall with the square of the side to 1 um at
    7 px, and rise tenfold beyond; the finest pattern loses a marker in dim light, the coarsest
    some in good light.
    """
    sides = 280.0 / CORNERS * width / 1024
    errors = 1e-6 * np.array([16.0, 4.0, 1.0, 10.0])
    n, conditions = len(CORNERS), len(CONDITIONS)
    lost = np.zeros((n, conditions))
    lost[0, 0], lost[3, 1] = 50.0, 1.0
    return {
        "corners": CORNERS,
        "points": np.array([0.0, 6.0]),
        "width": np.array(float(width)),
        "side_least": sides,
        "side_mean": 1.2 * sides,
        "visible": np.full((n, conditions), MARKERS),
        "lost": lost,
        "wrong": np.zeros((n, conditions)),
        "marker": np.full((n, conditions), 1e-6),
        "field": np.broadcast_to(
            errors[:, None, None, None], (n, 2, conditions, len(FIELDS))
        ).copy(),
        "gain": np.ones((n, 2, len(WAVELENGTHS))),
        "seconds": np.full((n, 2), 0.02),
    }


def results() -> dict[str, dict[str, NDArray[np.float64]]]:
    return {"prototype-640-10": made_up(640), "prototype-1024-10": made_up(1024)}


def test_the_best_pattern_and_what_lies_between_two() -> None:
    group = by_width(cells_of(results(), "prototype"))[1024]
    assert best_pattern(group).corners == 40
    np.testing.assert_allclose(errors_at(group, np.sqrt(7.0 * 14.0)), 2e-6)
    assert excess(group, 14.0) == pytest.approx(4.0)
    assert np.isnan(errors_at(group, 3.0)[0])


def test_a_pattern_without_a_field_is_never_the_best() -> None:
    made = made_up(1024)
    made["field"][2] = np.nan
    group = cells_of({"prototype-1024-10": made}, "prototype")
    assert best_pattern(group).corners == 20
    assert np.isnan(cells_of({"prototype-1024-10": made}, "prototype")[2].fine())


def test_the_smallest_side_that_works_heeds_light_and_wrong_numbers() -> None:
    made = made_up(1024)
    group = cells_of({"prototype-1024-10": made}, "prototype")
    assert works_down_to(group, "good", 7.0) == pytest.approx(280 / 60)
    assert works_down_to(group, "dim", 7.0) == pytest.approx(7.0)
    made["wrong"][2, 0] = 1
    group = cells_of({"prototype-1024-10": made}, "prototype")
    assert np.isnan(works_down_to(group, "good", 7.0))
    assert works_down_to(group, "good", 14.0) == pytest.approx(14.0)


def test_coarse_patterns_that_lose_markers_are_told() -> None:
    group = by_width(cells_of(results(), "prototype"))[1024]
    found = coarsest_that_works(group, 7.0)
    assert found is not None
    assert found.corners == 20


def test_a_refused_pattern_counts_as_lost_altogether() -> None:
    made = made_up(1024)
    made["lost"][3], made["visible"][3] = np.nan, 0.0
    cell = cells_of({"prototype-1024-10": made}, "prototype")[-1]
    assert cell.lost_share("good") == 1.0
    assert not cell.works("good")


def test_the_page_tells_the_answer(tmp_path: Path) -> None:
    told = report(results(), tmp_path)
    figures = [block for block in told.blocks if isinstance(block, Figure)]
    assert len(figures) == 2
    assert all(figure.path.stat().st_size > 10_000 for figure in figures)
    tables = [block for block in told.blocks if isinstance(block, Table)]
    assert all(len(row) == len(table.head) for table in tables for row in table.rows)
    answer = told.blocks[0]
    assert isinstance(answer, Text)
    assert "least at 4.4 to 7.0 px" in answer.text
    assert told.claims[0].met is None
    assert "20 x 20: 4 and 4 um" in told.claims[0].ours


@pytest.mark.usefixtures("undrawn")
def test_what_few_virtual_markers_give_is_read_from_the_sweep(tmp_path: Path) -> None:
    """One of them takes off three quarters of what six do; on the finest pattern they do harm."""
    made = made_up(1024)
    six = made["field"][:, :1]
    without, one = 2.0 * six, 1.25 * six
    without[3] = one[3] = 0.5 * six[3]
    made |= {
        "points": np.array([0.0, 1.0, 6.0]),
        "field": np.concatenate([without, one, six], axis=1),
        "gain": np.ones((len(CORNERS), 3, len(WAVELENGTHS))),
        "seconds": np.full((len(CORNERS), 3), 0.02),
    }
    told = report({"prototype-1024-10": made}, tmp_path)
    (text,) = (b.text for b in told.blocks if isinstance(b, Text) and "beads' error" in b.text)
    assert "in the median of 3 patterns, 1: 75%." in text
    assert "They do harm on checkers of up to 4.7 px (1 of 4 patterns)" in text


@pytest.mark.usefixtures("undrawn")
def test_a_resolution_at_which_nothing_holds_is_not_hidden_in_the_light_table(
    tmp_path: Path,
) -> None:
    made = results()
    made["prototype-640-10"]["wrong"][:, 1] = 1
    told = report(made, tmp_path)
    (table,) = (b for b in told.blocks if isinstance(b, Table) and b.head[0] == "light")
    cells = {row[0]: row[1] for row in table.rows}
    assert cells["dim, 4 : 1"] == "7.0 (1 of 2 resolutions)"
    assert "(" not in cells["good"]
