"""Two contacts: the dip between two dents, and the separation down to which it holds."""

import numpy as np
import pytest

from paper.experiments.resolution import dip_between, smallest_resolved


def test_dip_is_the_fall_from_the_smaller_of_two_maxima() -> None:
    depth = np.array([0.0, 0.5, 1.0, 0.7, 0.4, 0.6, 0.8, 0.3, 0.0])
    assert dip_between(depth) == pytest.approx(1 - 0.4 / 0.8)
    assert dip_between(depth[::-1]) == pytest.approx(1 - 0.4 / 0.8)


@pytest.mark.parametrize(
    "depth", [[0.1, 0.5, 0.9, 0.5, 0.1], [0.9, 0.8, 0.6, 0.4, 0.1], [0.1, 0.2, 0.5, 0.9, 0.3]]
)
def test_one_maximum_has_no_dip_wherever_it_lies(depth: list[float]) -> None:
    assert dip_between(np.array(depth)) == 0


@pytest.mark.parametrize("depth", [[0.5, np.nan, 0.2, 0.4, 0.5], [-0.1, -0.2, -0.1, -0.3, -0.1]])
def test_a_line_that_is_not_known_or_not_pressed_in_has_no_dip(depth: list[float]) -> None:
    dip = dip_between(np.array(depth))
    assert np.isnan(dip)
    assert not dip >= 0.0


def test_smallest_separation_ends_at_the_first_that_fails() -> None:
    separation = np.repeat([3.0, 2.0, 1.0, 0.5], 2) * 1e-3
    data = np.array([True, True, True, True, True, False, True, True])
    assert smallest_resolved(separation, data) == pytest.approx(2e-3)
    assert smallest_resolved(separation, np.ones(8, bool)) == pytest.approx(0.5e-3)
    assert smallest_resolved(separation, data, 0.5) == pytest.approx(0.5e-3)
    data[0] = False
    assert np.isnan(smallest_resolved(separation, data))
