"""The claim of IV.C holds for every object, or it does not hold."""

from pathlib import Path

import numpy as np
import pytest

from paper.chain import CMP
from paper.experiments.objects import SCENES, claim
from paper.page import Page


def _met(errors: list[float], tmp_path: Path) -> tuple[bool | None, str]:
    """Of objects whose markers are all off by so much, m."""
    page, results = Page(tmp_path), {}
    for name, error in zip(SCENES.values(), errors, strict=True):
        counts = np.array([[60, 57, 1]])
        results[name] = {"cmp_all": np.array([[0.0, 0.0, error, error]]), "cmp_counts": counts}
    claim(results, CMP, page)
    return page.claims[0].met, page.claims[0].ours


@pytest.mark.parametrize(("worst", "met"), [(19e-6, True), (21e-6, False), (np.nan, False)])
def test_one_object_above_the_limit_is_enough_to_miss_it(
    worst: float, met: bool, tmp_path: Path
) -> None:
    found, ours = _met([1e-6, 1e-6, 1e-6, worst, 1e-6], tmp_path)
    assert found is met
    assert "of the 95.0% of the markers that were found" in ours
