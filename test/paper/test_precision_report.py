"""IV.D: errors by region of the contact and by source."""

from __future__ import annotations

import numpy as np
import pytest

from paper.chain import CMP, Method
from paper.dot_trackers import DMP_NEAREST
from paper.experiments.precision import METHODS, Summary, split_of

DRAWS, ROWS, COLS = 40, 18, 18
SYSTEMATIC = 0.4e-6


def made_up(spread: dict[str, tuple[float, float]]) -> dict[str, np.ndarray]:
    """Results with noise of (inside, outside) m RMS per axis by method key; others have 1 um."""
    rng = np.random.default_rng(5)
    inside = np.zeros((ROWS, COLS), bool)
    inside[5:13, 4:12] = True
    data: dict[str, np.ndarray] = {
        "inside": inside,
    }
    for method in METHODS:
        within, beyond = spread.get(method.key, (1e-6, 1e-6))
        size = np.where(inside, within, beyond)[..., None]
        noise = rng.normal(size=(DRAWS, ROWS, COLS, 3)) * size
        data[f"{method.key}_errors"] = noise + SYSTEMATIC
        data[f"{method.key}_counts"] = np.tile([648, 648, 0], (DRAWS, 1))
    return data


@pytest.mark.parametrize("method", [CMP, DMP_NEAREST])
def test_regions_and_sources_of_error_are_distinguished(method: Method) -> None:
    data = made_up({method.key: (3e-6, 1e-6)})
    found = Summary.from_arrays(data, method)
    systematic, random = split_of(data[f"{method.key}_errors"])
    inside, outside = (np.hypot(noise, SYSTEMATIC) for noise in (3e-6, 1e-6))
    np.testing.assert_allclose(found.concentration, inside / outside, rtol=0.03)
    assert found.typical_concentration == pytest.approx(inside / outside, rel=0.02)
    assert systematic == pytest.approx(SYSTEMATIC * np.sqrt(3), rel=0.1)
    assert np.hypot(systematic, random) == pytest.approx(np.linalg.norm(found.rms), rel=1e-6)
