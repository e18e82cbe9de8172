"""Section V.C: the points, and which differences of made-up results are significant."""

import numpy as np
import pytest

from cmp_tactile_simulation.scenes.description import Motion, MoveBy, Touch
from paper.experiments.probe import (
    point_scene,
    probe_points,
    significantly_more,
)


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


@pytest.mark.parametrize(("won", "lost", "clear"), [(8, 0, True), (4, 0, False), (8, 4, False)])
def test_a_few_points_more_in_the_zone_are_no_significant_difference(
    won: int, lost: int, clear: bool
) -> None:
    """Ten points are in the zone of both, others in that of one alone; two noises each."""
    depths = {"cmp": [0.25] * (10 + won) + [0.1] * lost, "dots": [0.25] * 10 + [0.1] * won}
    depths["dots"] += [0.25] * lost
    points = {f"{key}_depth": 1e-3 * np.tile(mm, (2, 1)).T for key, mm in depths.items()}
    assert significantly_more(points, "dots", np.full(10 + won + lost, 0.28e-3)) is clear
