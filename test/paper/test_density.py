"""Table I: areas, counts, and a report that shows where the paper's figure is not reached."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cmp_tactile_processing.sensor.description import load_sensor
from paper.experiments.density import claims, densities, printed_area, virtual_count
from paper.page import Page


def test_area_and_counts_of_the_prototype() -> None:
    pattern = load_sensor("prototype").pattern
    # 21 checkers over 14.5 mm; 20 lines with 19 stretches of 6 in each direction.
    assert printed_area(pattern) == pytest.approx(0.0145**2, rel=1e-9)
    assert virtual_count(pattern) == 2 * 20 * 19 * 6


def _informed(virtual_share: float) -> dict[str, np.ndarray[Any, Any]]:
    data = {
        "corners": np.float64(400.0),
        "virtual": np.float64(4560.0),
        "area": np.float64(2e-4),
        "depth": np.float64(6e-4),
        "normal_force": np.float64(1.9),
    }
    for key in ("cmp_rest", "cmp_press", "cmp_paper_rest", "cmp_paper_press"):
        data[key] = np.array([[1.0, virtual_share, virtual_share / 2]] * 2)
    return {name: np.asarray(value) for name, value in data.items()}


@pytest.mark.parametrize(("share", "met"), [(1.0, True), (0.5, False)])
def test_only_measured_virtual_markers_count_for_the_claim(
    share: float, met: bool, tmp_path: Path
) -> None:
    data = _informed(share)
    assert densities(data) == (200.0, 2280.0)
    page = Page(tmp_path)
    claims(data, page)
    assert [claim.met for claim in page.claims] == [met, True]
    assert f"{2280 * share:,.0f} measured" in page.claims[0].ours
