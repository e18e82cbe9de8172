"""Numbers that `cmp_tactile info` derives from a description."""

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_bringup.recordings.misfit import pattern_margin
from cmp_tactile_bringup.report.sensor_facts import geometry_facts, position_errors
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.stereo.rig import StereoRig

TRIALS = 200


@pytest.fixture(scope="module")
def sensor():
    return load_sensor("sample_rig")


def test_predicted_errors_are_those_of_noisy_corners(sensor):
    """The prediction against triangulated corners with seeded noise in both views."""
    rng = np.random.default_rng(11)
    rig, noise_px = StereoRig(sensor), 0.05
    corners = sensor.pattern.corners()
    exact = {name: view.project(corners) for name, view in rig.views.items()}
    empty = Grid.missing(sensor.pattern.shape, "")
    seen = np.ones(sensor.pattern.shape.corners, np.uint8)
    errors = []
    for _ in range(TRIALS):
        noisy = {
            name: replace(empty, corners=q + rng.normal(0, noise_px, q.shape), corner_status=seen)
            for name, q in exact.items()
        }
        errors.append(rig.triangulate(noisy["left"], noisy["right"]).position - corners)
    measured = np.std(errors, axis=0)
    predicted = position_errors(sensor, noise_px)
    # Median over 400 markers of a standard deviation from 200 trials: within 1 %.  The midpoint
    # of the common normal weighs the views a little otherwise than least squares: 5 % allowed.
    ratio = np.median(measured / predicted, axis=(0, 1))
    np.testing.assert_allclose(ratio, 1.0, atol=0.05)


def test_the_scale_is_the_distance_between_projected_corners(sensor):
    facts = geometry_facts(sensor)
    view = StereoRig(sensor).views["left"]
    q = view.project(sensor.pattern.corners())
    sides = np.stack([q[10, 10] - q[9, 10], q[9, 11] - q[9, 10]])
    expected = np.sqrt(abs(np.linalg.det(sides))) / (sensor.pattern.pitch * 1e3)
    low, high = _range(facts["Scale left"])
    assert low < expected < high
    low, high = _range(facts["Pattern left"].partition("; checkers")[2])
    assert low < expected * sensor.pattern.pitch * 1e3 < high


def test_a_moved_view_leaves_the_pattern_as_far_from_its_edge_as_expected(sensor):
    """The margin follows the roi pixel by pixel, and is negative once the pattern leaves it."""

    def left_moved_right_by(px):
        left = sensor.views["left"]
        roi = replace(left.roi, x=left.roi.x + px)
        views = {**sensor.views, "left": replace(left, roi=roi)}
        return replace(sensor, views=views)

    def margin(moved):
        return pattern_margin(StereoRig(moved).views["left"], moved)

    # The outer corners of the print, whose left end is the nearest to the edge once it is moved.
    printed = replace(sensor.pattern, rows=22, cols=22).corners()
    view = StereoRig(sensor).views["left"]
    left_end = view.placement.to_frame(view.project(printed))[..., 0].min() + 0.5
    for px in (int(left_end) - 3, int(left_end) + 4):
        assert margin(left_moved_right_by(px)) == pytest.approx(left_end - px, abs=1e-9)
    assert "inside the view, at least" in geometry_facts(sensor)["Pattern left"]
    outside = geometry_facts(left_moved_right_by(int(left_end) + 4))["Pattern left"]
    assert outside.startswith("not inside the view: ends up to")


def _range(text):
    low, high = text.partition("(")[2].rstrip(")").split(" to ")
    return float(low), float(high)


def test_one_view_is_said_to_infer_the_normal_force(sensor):
    optics = replace(sensor.optics, type="monocular")
    one = replace(sensor, views={"left": sensor.views["left"]}, optics=optics)
    assert geometry_facts(one)["Normal force"].startswith("inferred, not measured")
    assert "Normal force" not in geometry_facts(sensor)
