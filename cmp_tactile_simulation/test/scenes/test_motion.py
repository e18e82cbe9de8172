"""Phases on the axis of frames, and the places and loads that they lead to."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.gel import LinearElastomer
from cmp_tactile_simulation.indenter_shapes import Sphere
from cmp_tactile_simulation.scenes.description import (
    Hold,
    Motion,
    MoveBy,
    Phase,
    Release,
    Start,
    Touch,
    goal_pose,
    start_pose,
    turned,
)

# Rotation matrices of 3 x 3 products in float64.
ATOL = 1e-12
RADIUS_M = 0.004
# A sphere that touches a cap between nodes is let down by at most spacing^2 / 8 (1/r + 1/R).
TOUCH_ATOL_M = 2e-4


@pytest.fixture(scope="module")
def contact():
    elastomer = LinearElastomer(load_sensor("sample_rig"), nodes=8)
    return ContactSimulation(elastomer, Sphere(RADIUS_M), 0.5)


def motion(easing):
    return Motion([Phase("a", 3, Hold(), easing), Phase("b", 1, Hold()), Phase("c", 4, Hold())])


def test_every_frame_belongs_to_its_phase():
    phases = motion("linear")
    assert [phases.phase(frame).name for frame in range(8)] == list("aaabcccc")
    assert [phases.begins_phase(frame) for frame in range(8)] == [
        frame in (0, 3, 4) for frame in range(8)
    ]


@pytest.mark.parametrize(
    ("easing", "shares"), [("linear", [1 / 3, 2 / 3, 1]), ("smooth", [7 / 27, 20 / 27, 1])]
)
def test_the_last_frame_of_a_phase_is_at_its_goal(easing, shares):
    phases = motion(easing)
    assert [phases.share(frame) for frame in range(3)] == pytest.approx(shares)
    assert phases.share(3) == 1.0


def test_turns_are_about_fixed_axes_x_first():
    # x turned by 90 degrees about x stays, then about y goes to -z, then about z stays there.
    np.testing.assert_allclose(turned((90, 90, 90)) @ [1, 0, 0], [0, 0, -1], atol=ATOL)
    np.testing.assert_allclose(turned((0, 0, 90)) @ [1, 0, 0], [0, 1, 0], atol=ATOL)


def test_moving_by_is_relative_and_turns_about_the_gels_axes(contact):
    begin = Pose(np.array([1.0, 2.0, 3.0]), turned((90, 0, 0)))
    there = goal_pose(MoveBy((0.5, 0.0, 0.0), (0, 0, 90)), begin, contact)
    assert there.position.tolist() == [1.5, 2.0, 3.0]
    np.testing.assert_allclose(there.rotation, turned((90, 0, 90)), atol=ATOL)


@pytest.mark.parametrize("clearance", [0.0, 0.001])
def test_touch_and_release_are_above_the_gels_surface(contact, clearance):
    layer = 3e-4
    top = RADIUS_M + clearance
    for pose in (
        goal_pose(Touch((0.0, 0.0), clearance), Pose(np.array([0.0, 0.0, 0.03])), contact),
        goal_pose(Release(clearance), Pose(np.array([0.0, 0.0, 0.001])), contact),
        start_pose(Start(Touch((0.0, 0.0), clearance)), contact),
    ):
        assert pose.position[:2].tolist() == [0.0, 0.0]
        assert pose.position[2] == pytest.approx(top + layer, abs=TOUCH_ATOL_M) or (
            pose.position[2] == pytest.approx(top, abs=TOUCH_ATOL_M)
        )
