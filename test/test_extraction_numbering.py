"""Numbers of gridlines are right or absent: knocks, covers, darkness, whole-checker shifts."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from tracking.detectors import Ours, run_frames, view_image

from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.tracking.tracker import GridTracker
from hard_frames.deformation import deformation_of, jump
from hard_frames.grid_score import score_grid
from hard_frames.library import bad_views, cases_of, sequence_of
from hard_frames.studio import PatternCase, PatternStudio, disc, streak

# Whole checkers along x and y: the shifted lattice looks like the one before.
SHIFTS = [(1, 0), (-2, 0), (0, 2), (0, -1), (1, 1), (-1, 1), (2, -2), (-2, -2)]


@pytest.fixture(scope="module")
def studio():
    return PatternStudio(samples=2)


@pytest.fixture(scope="module")
def kept_tracker():
    return Ours("following", cold=False)


@pytest.fixture
def tracker(kept_tracker):
    """Of both views, as after its start."""
    kept_tracker.reset()
    return kept_tracker


@pytest.fixture(scope="module")
def grasp(sensor, studio):
    """Frames of the sequence."""
    return [studio.photograph(case) for case in sequence_of("grasp", sensor)]


@pytest.fixture(scope="module")
def clean(sensor, studio):
    """A clean frame."""
    return studio.photograph(cases_of("clean", sensor)[0])


@pytest.fixture(scope="module")
def rest(sensor, studio):
    """A frame at rest, from which the pattern jumps."""
    return studio.photograph(PatternCase("rest", sensor, jump(sensor, (0.0, 0.0))))


@pytest.fixture(scope="module")
def deformed(sensor, studio):
    """Frames of kinds of deformation."""
    return {
        kind: studio.photograph(PatternCase(kind, sensor, deformation_of(kind, sensor.pattern)))
        for kind in ("twist", "slide", "rest")
    }


def views_of(frame):
    """View and its image."""
    return [(view, view_image(frame, view)) for view in frame.truth]


@pytest.mark.parametrize("seed", [0, 1])
def test_what_is_hidden_leaves_the_other_numbers_right(sensor, studio, tracker, seed):
    """Thirds, two sides of the border, bands that leave components, a disc; any grey, textured."""
    for case in cases_of("hidden", sensor, seed):
        tracker.reset()
        score = run_frames(tracker, [studio.photograph(case)]).score
        assert score.wrong == 0, case.name
        assert score.found_far == score.far, case.name


def test_shifts_by_whole_checkers_are_followed(sensor, studio, tracker, rest):
    """A tracker that refines what it had takes the next corner for its own and never notices."""
    for shift in SHIFTS:
        for view, image in views_of(rest):
            tracker.track(sensor, view, image)
        moved = studio.photograph(PatternCase("moved", sensor, jump(sensor, shift)))
        score = run_frames(tracker, [moved]).score
        assert score.wrong == 0, shift
        assert score.complete == score.grids, shift


@pytest.mark.parametrize("kind", ["grasp", "released", "light switched", "hidden for a while"])
def test_sequences(sensor, studio, tracker, grasp, kind):
    made = (studio.photograph(case) for case in sequence_of(kind, sensor))
    for frame in grasp if kind == "grasp" else made:
        score = run_frames(tracker, [frame]).score
        assert score.wrong == 0, frame.name
        assert score.found_far == score.far, frame.name


def test_bad_images_between_good_ones_are_named_and_forgotten(sensor, tracker, rest):
    """Each follows a good frame, as when light, camera or gel change while the tracker runs."""
    for view, good in views_of(rest):
        for name, bad in bad_views(good).items():
            assert np.isfinite(tracker.track(sensor, view, good).grid.corners).all(), name
            grid = tracker.track(sensor, view, bad).grid
            assert np.isnan(grid.corners).all(), name
            assert grid.fault, name
            assert grid.reason, name
            assert grid.confidence == 0.0, name
        assert np.isfinite(tracker.track(sensor, view, good).grid.corners).all()


def blurred(image, kernel):
    return cv2.filter2D(image, -1, kernel / kernel.sum())


# The checkers' transfer function is negative for a disc of 0.86 to 1.6 sides, and for a streak of
# 2 to 4 sides along a gridline; sides are 13 to 22 px.
@pytest.mark.parametrize("detector", ["saddle_lattice", "contour_stitching"])
@pytest.mark.parametrize(
    ("kind", "kernel"), [("twist", disc(20.6)), ("slide", disc(19.9)), ("rest", streak(47.0, 2.87))]
)
def test_blur_that_exchanges_light_and_dark_is_named(sensor, deformed, detector, kind, kernel):
    rig = replace(sensor, tracking=replace(sensor.tracking, detector=detector))
    for view, image in views_of(deformed[kind]):
        grid = GridTracker(rig, view).track(blurred(image, kernel))
        assert not grid.corner_status.any()
        assert grid.fault in {GridFault.NO_CONTRAST, GridFault.NO_PATTERN, GridFault.AMBIGUOUS}


def test_focus_that_is_lost_and_found_again_leaves_the_numbers_right(sensor, tracker, deformed):
    frame = deformed["slide"]
    _, image = views_of(frame)[0]
    truth, visible = frame.truth["left"], frame.visible["left"]
    for radius in 24.0 - np.abs(np.linspace(-24.0, 24.0, 17)):
        grid = tracker.track(sensor, "left", blurred(image, disc(radius))).grid
        assert score_grid(grid, truth, visible, visible).wrong == 0
    assert score_grid(grid, truth, visible, visible).complete == 1


@pytest.mark.parametrize("angle", [45, 90, 110, 178, 180, 200, 270])
def test_a_turned_frame_gets_no_numbers(sensor, tracker, clean, angle):
    """About its middle: by half a turn, each view takes the other one's place."""
    height, width = clean.image.shape
    turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle, 1.0)
    turned = cv2.warpAffine(
        clean.image, turn, (width, height), borderMode=cv2.BORDER_REPLICATE, flags=cv2.INTER_CUBIC
    )
    for view, truth in clean.truth.items():
        grid = tracker.track(sensor, view, split_frame(turned, truth.placement)).grid
        assert not grid.corner_status.any()
        assert grid.fault is not GridFault.NONE


@pytest.mark.parametrize("angle", [90, 100, 270])
def test_a_view_turned_about_its_own_middle_gets_no_numbers(sensor, tracker, clean, angle):
    for view, image in views_of(clean):
        x, y = (float(value) for value in clean.truth[view].corners.reshape(-1, 2).mean(axis=0))
        turn = cv2.getRotationMatrix2D((x, y), angle, 1.0)
        size = image.shape[1], image.shape[0]
        moved = cv2.warpAffine(image, turn, size, borderMode=cv2.BORDER_REPLICATE)
        grid = tracker.track(sensor, view, moved).grid
        assert not grid.corner_status.any()
        assert grid.fault is GridFault.TURNED
