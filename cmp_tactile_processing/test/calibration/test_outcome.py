"""Numbers of calibrations as people read them."""

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.calibration.observation import LEAST_STD, observed
from cmp_tactile_processing.calibration.outcome import ViewResiduals, reprojection, value_text
from cmp_tactile_processing.measured import Grid, GridShape, Status


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (1.54e-3, "m", "1.54 mm"),
        (1.0e-3, "m", "1 mm"),
        (25e-6, "m", "25 um"),
        (1.968e-7, "m", "0.197 um"),
        (1543.2, "px", "1540 px"),
        (0.0000131, "px", "0.0000131 px"),
        (np.radians(5e-5), "rad", "0.00005 deg"),
        (0.4567, "", "45.67%"),
        (np.nan, "m", "nan mm"),
    ],
)
def test_a_figure_is_one_text_wherever_it_stands(value, unit, text):
    """Table and verdict of a check had 1.54 mm and 1.54e+03 um of one figure.

    Reports of the kind, tried here:
    kajf/bozr 85 (an error says 6.466547e+06 of what the user wrote as 6466547), joshwlewis/unitwise
    13 (0.2E2 for 20): no power of ten in any text of a calibration's figures.
    """
    assert value_text(value, unit) == text


def test_outliers_do_not_count_in_the_reprojection_error():
    pixels = np.zeros((3, 2))
    residuals = np.array([[0.3, 0.4], [0.0, 0.5], [30.0, 40.0]])
    used = np.array([True, True, False])
    view = ViewResiduals("left", pixels, residuals, np.zeros(3, np.intp), used)
    assert view.rms == pytest.approx(0.5)
    assert reprojection([view, view]) == pytest.approx(0.5)
    assert reprojection([view], all_corners=True) == pytest.approx(np.sqrt((0.5 + 2500) / 3))


@pytest.mark.parametrize("reported_px", [0.01, 0.2])
def test_a_mean_corner_is_as_sure_as_its_frames_scatter_or_say(reported_px):
    """8 frames with 0.1 px of noise per coordinate; in 5 of them one corner is not seen."""
    shape, frames, noise_px = GridShape(30, 40, 1), 8, 0.1
    rng, empty = np.random.default_rng(4), Grid.missing(shape, "")
    grids = []
    for number in range(frames):
        status = np.full(shape.corners, Status.MEASURED, np.uint8)
        status[2, 3] = Status.MISSING if number < 5 else Status.MEASURED
        corners = rng.normal(0, noise_px, (*shape.corners, 2))
        deviations = np.full(shape.corners, reported_px)
        grids.append(replace(empty, corners=corners, corner_status=status, corner_std=deviations))
    seen = observed("left", grids, np.ones(frames, np.bool_))
    one_px = max(noise_px, reported_px)
    variance = np.nanmean(seen.std**2)
    assert variance == pytest.approx(one_px**2 / frames + LEAST_STD**2, rel=0.03)
    assert np.argwhere(~seen.seen).tolist() == [[2, 3]]
    assert np.isnan(seen.std[2, 3])
