"""A scene's frames: truth that belongs to the picture, the same wherever the run begins."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import SlipState
from cmp_tactile_simulation.scenes.simulation import Simulation

# solver.LOAD_TOLERANCE times the normal force.
ATOL_LOAD_N = 1e-6
# The spline and the projection of the truth are exact but for rounding.
ATOL_PX = 1e-6


@pytest.fixture(scope="module")
def simulation(small_scene):
    return Simulation(small_scene())


@pytest.fixture(scope="module")
def frames(simulation):
    return list(simulation.frames())


def test_frames_bear_the_phases_and_stamps_of_the_scene(frames, simulation):
    names = [frame.phase for frame in frames]
    assert names == ["rest"] + 3 * ["press"] + 3 * ["drag"] + 2 * ["stay"]
    steps = np.diff([frame.stamp_ns for frame in frames])
    assert np.abs(steps - 1e9 / simulation.scene.rate).max() <= 1
    assert {frame.image.shape for frame in frames} == {(192, 256)}


def test_pixel_truth_is_the_projection_of_the_truth_in_3d(frames, simulation):
    for frame in frames:
        for name, view in build_views(simulation.scene.sensor).items():
            grid = frame.grids[name]
            assert grid.found_fraction > 0.8
            expected = view.project(frame.surface.position)
            seen = grid.corner_status != 0
            np.testing.assert_allclose(grid.corners[seen], expected[seen], atol=ATOL_PX)


def test_a_press_moves_the_markers_under_the_indenter_down(frames):
    rest, pressed = frames[0], frames[3]
    assert rest.force.slip_state == SlipState.NO_CONTACT
    assert np.abs(rest.surface.displacement).max() < 1e-12
    assert rest.force.wrench.tolist() == [0.0] * 6
    assert pressed.force.wrench[2] < -0.05
    deepest = np.unravel_index(
        pressed.surface.displacement[..., 2].argmin(), pressed.surface.shape.corners
    )
    assert np.linalg.norm(pressed.surface.reference[deepest][:2] - (0.0005, 0)) < 0.002
    # Less than the indenter's way: the skin above the markers gives way too.
    assert 1e-4 < -pressed.surface.displacement[..., 2].min() < 4.5e-4


def test_a_phase_ends_at_its_load(frames, simulation):
    end = frames[6]
    np.testing.assert_allclose(end.force.wrench[:3], [0.1, 0.0, -0.6], atol=ATOL_LOAD_N)
    loads = [simulation.contact.load(state.contact) for state in simulation.states()]
    assert (loads[6].normal, loads[6].torque) == pytest.approx((0.6, 0.0), abs=ATOL_LOAD_N)
    start, half_way = loads[3:5]
    share = 7 / 27
    expected = start.normal + share * (0.6 - start.normal)
    assert half_way.normal == pytest.approx(expected, abs=ATOL_LOAD_N)


def test_holding_changes_nothing_but_the_noise(frames):
    held, before = frames[7], frames[6]
    np.testing.assert_array_equal(held.surface.position, before.surface.position)
    np.testing.assert_array_equal(held.force.force, before.force.force)
    difference = held.image.astype(float) - before.image
    # Two frames of read noise of one grey level, each rounded to whole levels.
    assert difference.std() == pytest.approx((2 * (1 + 1 / 12)) ** 0.5, rel=0.02)
    assert abs(difference.mean()) < 5 * difference.std() / difference.size**0.5


def test_dots_are_seen_instead_of_checkers(small_scene, frames):
    dots = next(iter(Simulation(small_scene(pattern_type="dmp")).frames()))
    corner = np.round(dots.grids["left"].corners_frame[2, 2]).astype(int)
    patch = (slice(corner[1] - 1, corner[1] + 2), slice(corner[0] - 1, corner[0] + 2))
    assert dots.image[patch].mean() < frames[0].image[patch].mean() - 20
