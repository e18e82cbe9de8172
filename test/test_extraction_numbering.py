"""Numbers of gridlines are right or absent: knocks, covers, darkness, whole-checker shifts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.sensor_library import load_sensor
from cmp_tactile_processing.split import split_frame
from cmp_tactile_processing.tracker import GridTracker
from cmp_tactile_simulation.grid_score import score_grid
from cmp_tactile_simulation.pattern_bad_input import bad_views
from cmp_tactile_simulation.pattern_case import PatternCase, PatternStudio
from cmp_tactile_simulation.pattern_case_library import cases_of
from cmp_tactile_simulation.pattern_sequences import jump, sequence_of

# Whole checkers along x and y: the shifted lattice looks like the one before.
SHIFTS = [(x, y) for x in (-2, -1, 0, 1, 2) for y in (-2, -1, 0, 1, 2) if x or y]


@pytest.fixture(scope="module")
def sensor():
    return load_sensor("sample_rig")


@pytest.fixture(scope="module")
def studio():
    return PatternStudio(samples=2)


@pytest.fixture(scope="module")
def trackers(sensor):
    return {view: GridTracker(sensor, view) for view in sensor.views}


def scores(trackers, frame):
    return [
        score_grid(
            trackers[view].track(split_frame(frame.image, truth.placement)),
            truth,
            frame.visible[view],
            frame.far[view],
        )
        for view, truth in frame.truth.items()
    ]


def forget(trackers):
    for tracker in trackers.values():
        tracker.reset()


@pytest.mark.parametrize("seed", [0, 1])
def test_what_is_hidden_leaves_the_other_numbers_right(sensor, studio, trackers, seed):
    """Thirds, two sides of the border, bands that leave islands, a disc; of any grey, textured."""
    for case in cases_of("hidden", sensor, seed):
        forget(trackers)
        for score in scores(trackers, studio.photograph(case)):
            assert score.wrong == 0, case.name
            assert score.found_far == score.far, case.name


def test_shifts_by_whole_checkers_are_followed(sensor, studio, trackers):
    """A tracker that refines what it had takes the next corner for its own and never notices."""
    rest = studio.photograph(PatternCase("rest", sensor, jump(sensor, (0.0, 0.0))))
    forget(trackers)
    for shift in SHIFTS:
        scores(trackers, rest)
        moved = studio.photograph(PatternCase("moved", sensor, jump(sensor, shift)))
        for score in scores(trackers, moved):
            assert score.wrong == 0, shift
            assert score.complete, shift


@pytest.mark.parametrize("kind", ["grasp", "released", "light switched", "hidden for a while"])
def test_sequences(sensor, studio, trackers, kind):
    forget(trackers)
    for case in sequence_of(kind, sensor):
        for score in scores(trackers, studio.photograph(case)):
            assert score.wrong == 0, case.name
            assert score.found_far == score.far, case.name


def test_a_cold_start_in_every_frame_finds_what_following_finds(sensor, studio):
    """From scratch and followed, the same corners: no drift, no memory of wrong places."""
    anew = GridTracker(replace(sensor, tracking=replace(sensor.tracking, follow=False)), "left")
    following = GridTracker(sensor, "left")
    for case in sequence_of("grasp", sensor)[::3]:
        frame = studio.photograph(case)
        truth = frame.truth["left"]
        image = split_frame(frame.image, truth.placement)
        cold, followed = anew.track(image), following.track(image)
        assert (cold.corner_status == followed.corner_status).all()
        # Both are within 0.02 px of the truth nearly everywhere.
        assert np.nanmax(np.abs(cold.corners - followed.corners)) < 0.1


def test_bad_images_between_good_ones_are_named_and_forgotten(sensor, studio, trackers):
    """Each follows a good frame, as when light, camera or gel change while the tracker runs."""
    frame = studio.photograph(PatternCase("rest", sensor, jump(sensor, (0.0, 0.0))))
    forget(trackers)
    for view, truth in frame.truth.items():
        good = split_frame(frame.image, truth.placement)
        for name, bad in bad_views(good).items():
            assert np.isfinite(trackers[view].track(good).corners).all(), name
            grid = trackers[view].track(bad)
            assert np.isnan(grid.corners).all(), name
            assert grid.fault, name
            assert grid.reason, name
            assert grid.confidence == 0.0, name
        assert np.isfinite(trackers[view].track(good).corners).all()
