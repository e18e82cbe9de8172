"""Deep markers are chosen as the paper does, and chance is no difference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.measured import Surface
from cmp_tactile_processing.sensor.description import load_sensor
from paper.experiments.balls import clearly_less, deep_points
from paper.readings import without_virtual


@pytest.fixture(scope="module")
def rest() -> Surface:
    """Of the prototype, with virtual markers on straight lines between the corners."""
    pattern = load_sensor("prototype").pattern
    corners, shape = pattern.corners(), pattern.shape
    part = (np.arange(shape.points_per_segment) + 1) / (shape.points_per_segment + 1)
    part = part[:, None]
    rows = corners[:, :-1, None] * (1 - part) + corners[:, 1:, None] * part
    cols = corners[:-1, :, None] * (1 - part) + corners[1:, :, None] * part
    return Surface.from_exact_points(shape, corners, corners, rows, cols)


def _pressed(rest: Surface) -> Surface:
    """Down by 1 mm less 0.1 mm for each mm from the point (1, 2) mm, virtual markers as well."""
    parts = {}
    for name in ("position", "row_position", "col_position"):
        p = getattr(rest, name).copy()
        p[..., 2] -= 1e-3 - 0.1 * np.hypot(p[..., 0] - 1e-3, p[..., 1] - 2e-3)
        parts[name] = p
    return replace(rest, **parts)


def test_markers_above_four_fifths_of_the_depth_are_left_out(rest: Surface) -> None:
    pressed = _pressed(rest)
    points = deep_points(rest, pressed)
    off = np.hypot(points[:, 0] - 1e-3, points[:, 1] - 2e-3)
    # The deepest marker is within a checker's quarter of the point: 2 mm, up to 0.25 mm more.
    assert 1.9e-3 < off.max() < 2.3e-3
    corners = deep_points(without_virtual(rest), without_virtual(pressed))
    area, pitch = np.pi * off.max() ** 2, 14.5e-3 / 21
    assert len(corners) == pytest.approx(area / pitch**2, rel=0.2)
    # Six virtual markers on each of two segments for each corner; the deepest of them lies deeper
    # than the deepest corner, so that some are left out for it.
    assert 10 * len(corners) < len(points) < 13.5 * len(corners)


def test_a_difference_that_chance_explains_is_not_clear() -> None:
    rng = np.random.default_rng(3)
    first, second = rng.normal(0, 1, (2, 66))
    assert not clearly_less(first, second)
    assert clearly_less(first, 3 * second)
    assert not clearly_less(3 * first, second)
    assert not clearly_less(np.array([1.0]), np.array([2.0]))
