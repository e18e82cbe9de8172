"""Gridlines of frames with exact truth: all corners, none wrong, as exact as is promised.

Frames are made by the simulator; the limits on lengths are those of docs and benchmarks
(`benchmarks/tracking/extraction.py --limits`), which measures them on many more frames.
"""

from dataclasses import replace

import numpy as np
import pytest
from tracking.detectors import Ours, run_frames, run_pair, view_image

from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_simulation.rendering.camera import CameraSettings
from hard_frames.covers import Cover
from hard_frames.deformation import deformation_of
from hard_frames.library import cases_of, flawed_pairs
from hard_frames.studio import PatternCase, PatternStudio, bent, pattern_rig

# Across the line: RMS of virtual markers, and the distance that one in a hundred exceeds, px.
VIRTUAL_RMS = {"clean": 0.012, "small spheres": 0.015, "blur 2": 0.0075}
VIRTUAL_P99 = 0.05
CORNER_RMSE = {"blur 3": 0.03, "noise 4": 0.03, "noise 16": 0.12}
# Measured on three prints: 0.030, 0.028 and, with edges that stray by 0.06 mm rms, 0.036 px.
DISPLACEMENT_RMS = 0.04

COMPLETE = (
    "clean", "small spheres", "blur 2", "blur 3", "blur 4", "noise 4", "noise 16",
    "salt and pepper 10 %", "light 0.2", "missing ink 40", "ragged 0.015 mm", "ragged 0.06 mm",
    "clutter, glare, margin",
)  # fmt: skip


@pytest.fixture(scope="module")
def studio():
    return PatternStudio()


@pytest.fixture(scope="module")
def tracker():
    return Ours("each frame by itself", follow=False)


@pytest.fixture(scope="module")
def scored(sensor, studio, tracker):
    """Scores of a kind of case, made once: two frames of it, both views."""
    scores = {}

    def score(kind):
        if kind not in scores:
            frames = [studio.photograph(case) for case in cases_of(kind, sensor)[:2]]
            scores[kind] = run_frames(tracker, frames).score
        return scores[kind]

    return score


@pytest.mark.parametrize("kind", COMPLETE)
def test_every_visible_corner_is_found_and_none_is_wrong(scored, kind):
    score = scored(kind)
    assert score.wrong == 0
    assert score.found_visible == score.visible
    assert score.complete == score.grids


def test_edges_that_stray_by_a_tenth_of_a_checker_cost_few_corners(scored):
    """Where the print is torn beside the border a corner or two may be left out, none is wrong."""
    score = scored("ragged 0.06 mm")
    assert score.wrong == 0
    assert score.found_visible >= 0.99 * score.visible


@pytest.mark.parametrize("kind", CORNER_RMSE)
def test_corners_of_blurred_and_noisy_frames_are_exact_enough(scored, kind):
    assert scored(kind).corner_rmse <= CORNER_RMSE[kind]


@pytest.mark.parametrize("blur", [1.2, 2.0])
def test_blur_alone_moves_no_corner(sensor, studio, tracker, blur):
    """Rounding to grey levels is left; light that aliases before it is blurred costs 0.01 px."""
    case = cases_of("clean", sensor)[0]
    frame = studio.photograph(replace(case, camera=CameraSettings(blur=blur, read_noise=0.0)))
    assert run_frames(tracker, [frame]).score.corner_rmse <= 0.006


def _ratios(tracker, frame):
    """Errors of the corners over their reported deviations."""
    ratios = []
    for view, truth in frame.truth.items():
        grid = tracker.track(frame.sensor, view, view_image(frame, view)).grid
        ratios.append((grid.corners - truth.corners) / grid.corner_std[..., None])
    return ratios


@pytest.mark.parametrize("kind", ["clean", "noise 16", "blur 3"])
def test_reported_deviations_are_those_of_the_errors(sensor, studio, tracker, kind):
    """Within what is measured of more frames and kinds (`benchmarks/tracking/bound.py`)."""
    frame = studio.photograph(cases_of(kind, sensor)[0])
    assert 0.8 < np.sqrt(np.nanmean(np.square(_ratios(tracker, frame)))) < 1.2


def test_reported_deviations_know_that_blur_reaches_the_next_gridlines(sensor, studio, tracker):
    """What these move a corner by is a bias; without it in the deviations the ratio is 1.7."""
    case = cases_of("clean", sensor)[0]
    frame = studio.photograph(replace(case, camera=CameraSettings(blur=5.0)))
    assert np.sqrt(np.nanmean(np.square(_ratios(tracker, frame)))) < 1.5


@pytest.mark.parametrize("kind", VIRTUAL_RMS)
def test_virtual_markers_lie_on_their_gridlines(scored, kind):
    score = scored(kind)
    assert score.virtual_rms <= VIRTUAL_RMS[kind]
    assert score.virtual_p99 <= VIRTUAL_P99


def test_noise_makes_virtual_markers_no_worse_than_corners(scored):
    """Where the gradient is lost in noise, the curve through the corners must take over."""
    for kind in ("noise 4", "noise 16"):
        assert scored(kind).virtual_rms <= scored(kind).corner_rmse


def test_displacement_of_one_flawed_print(sensor, studio, tracker):
    """Flaws move the corners of a print, the same way in all frames: pictures at rest show it.

    The last one's edges stray by a tenth of a checker, and what is pressed stretches between the
    true corner and where the model has it: by twice the limit, if pictures were taken there.
    """
    for pair in flawed_pairs(sensor):
        errors = run_pair(tracker, *map(studio.photograph, pair))
        assert len(errors) > 700
        assert np.sqrt(np.mean(errors**2)) <= DISPLACEMENT_RMS


def test_ragged_print_that_slides_far(sensor, studio, tracker):
    """The model takes some ragged corners for others, 4 px off, and misleads those around them."""
    rest, _ = flawed_pairs(sensor)[2]
    slid = bent(sensor, "slide", camera=rest.camera, defects=rest.defects, frame=1)
    errors = run_pair(tracker, studio.photograph(rest), studio.photograph(slid))
    assert len(errors) > 700
    # Measured: 0.20 px; a gridline is 1.3 px thick with this blur.
    assert errors.max() < 0.5


def test_pictures_of_another_print_are_not_used(sensor, studio, tracker):
    """A gel may be exchanged without a new inspection."""
    ragged = studio.photograph(flawed_pairs(sensor)[2][0])
    clean = studio.photograph(cases_of("clean", sensor)[0])
    own, image = tracker.tracker(sensor, "left"), view_image(clean, "left")
    alone = own.track(image)
    own.inspect_print([view_image(ragged, "left")])
    found = own.track(image)
    own.use_print_defects(None)
    apart = np.linalg.norm(found.corners - alone.corners, axis=-1)
    # As a shift that fits would be off by what the edges of the other print stray by, 1.2 px.
    assert apart.max() < 0.01


RIGS = (
    (4, 4, "dark", PatternSurface(), 0),
    (5, 8, "light", PatternSurface("sphere_cap", 0.027), 1),
    (14, 9, "dark", PatternSurface("cylinder", 0.02, "y"), 20),
    (24, 40, "light", PatternSurface("sphere_cap", 0.04), 6),
    (60, 60, "dark", PatternSurface(), 1),
)


@pytest.mark.parametrize("described", RIGS, ids=lambda rig: f"{rig[0]} x {rig[1]}")
def test_other_grids(studio, tracker, described):
    rows, cols, corner, surface, points = described
    rig = pattern_rig(rows, cols, corner_checker=corner, surface=surface, points_per_segment=points)
    frame = studio.photograph(PatternCase("rig", rig, deformation_of("press", rig.pattern)))
    score = run_frames(tracker, [frame]).score
    assert score.wrong == 0
    assert score.found_visible == score.visible == 2 * rows * cols
    grid = tracker.track(rig, "left", view_image(frame, "left")).grid
    assert grid.row_lines.shape == (rows, cols - 1, points, 2)


def test_a_grid_that_slides_with_a_third_hidden_is_not_taken_for_a_turned_one(
    sensor, studio, tracker
):
    """Where it is hidden, the rest also fits the other view in some places."""
    case = bent(sensor, "slide", cover=Cover("left", 1 / 3))
    score = run_frames(tracker, [studio.photograph(case)]).score
    assert score.wrong == 0
    assert score.found_far == score.far > 0


def test_light_that_is_too_low_gives_no_wrong_number(sensor, studio, tracker):
    """Between what is seen well and what is not there are no guesses."""
    for contrast in (12.0, 5.0, 2.0):
        camera = CameraSettings(light_level=20 + contrast, dark_level=20, read_noise=2.0)
        case = PatternCase("dim", sensor, deformation_of("twist", sensor.pattern), camera)
        assert run_frames(tracker, [studio.photograph(case)]).score.wrong == 0
