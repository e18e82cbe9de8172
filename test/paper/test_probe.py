"""Section V.C: the points, and which differences of made-up results are significant."""

from typing import Any

import numpy as np
import pytest

from cmp_tactile_simulation.scenes.description import Motion, MoveBy, Touch
from paper.experiments.probe import (
    point_scene,
    probe_points,
    significantly_more,
)
from paper.readings import READINGS


def test_each_of_25_points_is_pressed_half_a_millimetre_deep() -> None:
    points = probe_points()
    assert len(set(points)) == 25
    scene = point_scene(points[7])
    goals = [phase.goal for phase in scene.motion]
    touch, press = goals[0], goals[1]
    assert isinstance(touch, Touch)
    assert isinstance(press, MoveBy)
    assert touch.at == points[7]
    assert touch.clearance + press.offset[2] == pytest.approx(-0.5e-3)
    assert Motion(scene.motion).phase(scene.frame_count - 1).name.startswith("hold")


def made_up(cmp_mm: float, dots_mm: float, cmp_gain_mm: float) -> dict[str, Any]:
    """Two points, two noises; the marker surface is 0.28 mm deep."""
    made: dict[str, Any] = {
        "points": np.array([[0.0, 0.0], [1e-3, 0.0]]),
        "true": np.full(2, 0.28e-3),
        "corner": np.full(2, 0.3e-3),
        "corner_xy": np.zeros((2, 4, 2)),
    }
    for reading in READINGS:
        depth = cmp_mm if reading.key == "cmp" else dots_mm
        gain = cmp_gain_mm if reading.key == "cmp" else 0.01
        made[f"{reading.key}_depth"] = np.full((2, 2), 1e-3 * depth)
        for way in ("square", "nearest", "dense"):
            made[f"{reading.key}_{way}"] = np.full((2, 2), 1e-3 * (depth + gain))
    return made


def joined_points(parts: list[dict[str, Any]]) -> dict[str, Any]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@pytest.mark.parametrize(("won", "lost", "clear"), [(8, 0, True), (4, 0, False), (8, 4, False)])
def test_a_few_points_more_in_the_zone_are_no_significant_difference(
    won: int, lost: int, clear: bool
) -> None:
    both, cmp, dots = made_up(0.25, 0.25, 0.0), made_up(0.25, 0.1, 0.0), made_up(0.1, 0.25, 0.0)
    points = joined_points([both] * 5 + [cmp] * (won // 2) + [dots] * (lost // 2))
    assert significantly_more(points, "dmp_nearest", points["true"]) is clear
