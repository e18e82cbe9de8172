"""Chance is no difference."""

from __future__ import annotations

import numpy as np

from paper.experiments.balls import clearly_less


def test_a_difference_that_chance_explains_is_not_clear() -> None:
    rng = np.random.default_rng(3)
    first, second = rng.normal(0, 1, (2, 66))
    assert not clearly_less(first, second)
    assert clearly_less(first, 3 * second)
    assert not clearly_less(3 * first, second)
    assert not clearly_less(np.array([1.0]), np.array([2.0]))
