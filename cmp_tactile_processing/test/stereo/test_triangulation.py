"""Triangulation recovers points exactly, its covariance is that of the errors, faults are named.

Errors of pixels are drawn with known standard deviations: what comes out must scatter as the
covariance says, which the mean of the squared Mahalanobis distances shows: 3 in three dimensions.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rectification import surface_intersection
from cmp_tactile_processing.measured import Grid, MarkerFault, Status
from cmp_tactile_processing.sensor.parameters import TriangulationParameters
from cmp_tactile_processing.sensor.parts import Camera, RefractingLayer
from cmp_tactile_processing.stereo.rig import StereoRig, implausible_ray_gap
from cmp_tactile_processing.stereo.triangulation import meet_surface, triangulate

LENSES = {
    "straight": Camera("pinhole", 733.0, 740.0, 511.0, 380.0, (0.0,) * 5),
    "plumb_bob": Camera("pinhole", 733.0, 740.0, 511.0, 380.0, (-0.2, 0.05, 1e-3, -2e-3, 0.01)),
    "equidistant": Camera("equidistant", 733.0, 740.0, 511.0, 380.0, (-0.02, 5e-3, 1e-3, -2e-3)),
}
PLATE_AND_GEL = (RefractingLayer(-0.014, 1.49), RefractingLayer(-0.0057, 1.41))
# Rounding of coordinates of some cm, through rays that meet at about 40 degrees.
ATOL_EXACT_M = 1e-15
STEP_PX = 1e-3
# Truncation of a central difference over STEP_PX, relative to curvatures of 1e-6 per px^2, and
# rounding of 1e-16 over that step.
ATOL_DERIVATIVE = 1e-11
# 400 points of 3 coordinates in 20 draws: the mean of 24,000 squares scatters by 1 %.
DRAWS, RTOL_SPREAD = 20, 0.05
STD_LEFT_PX, STD_RIGHT_PX = 0.03, 0.1


@pytest.fixture(params=[(lens, layers) for lens in LENSES for layers in ((), PLATE_AND_GEL)])
def rig(request, sensor):
    lens, layers = request.param
    return replace(sensor, camera=LENSES[lens], optics=replace(sensor.optics, layers=layers))


@pytest.fixture
def points(sensor):
    rng = np.random.default_rng(5)
    corners = sensor.pattern.corners().reshape(-1, 3)
    return corners + rng.normal(size=corners.shape) * 2e-4


def seen_in(rig, points):
    return [(view, view.project(points)) for view in build_views(rig).values()]


def noisy_bundles(views, std, rng):
    """Rays of the views' pixels, off by noise of a standard deviation of each point."""
    return tuple(
        view.ray_bundle(q + rng.normal(size=q.shape) * deviation[:, None])
        for (view, q), deviation in zip(views, std, strict=True)
    )


def std_of(value, points):
    return np.full(len(points), value)


def test_rays_and_their_derivatives_agree_with_finite_differences(rig, points):
    for view, q in seen_in(rig, points):
        bundle = view.ray_bundle(q)
        origins, directions = view.rays(q)
        np.testing.assert_allclose(bundle.origin, origins, atol=ATOL_EXACT_M, rtol=0)
        np.testing.assert_allclose(bundle.direction, directions, atol=ATOL_EXACT_M, rtol=0)
        for axis, step in enumerate(np.eye(2) * STEP_PX):
            after, before = view.ray_bundle(q + step), view.ray_bundle(q - step)
            for name in ("origin", "direction"):
                slope = (getattr(after, name) - getattr(before, name)) / (2 * STEP_PX)
                found = getattr(bundle, f"{name}_by_pixel")[..., axis]
                np.testing.assert_allclose(found, slope, atol=ATOL_DERIVATIVE, rtol=0)


@pytest.mark.parametrize("weighted", [True, False], ids=["weighted", "common normal"])
def test_errors_scatter_as_the_covariance_says(rig, points, weighted):
    rng = np.random.default_rng(6)
    views = seen_in(rig, points)
    std = std_of(STD_LEFT_PX, points), std_of(STD_RIGHT_PX, points)
    distances2 = []
    for _ in range(DRAWS):
        bundles = noisy_bundles(views, std, rng)
        found = triangulate(bundles, std, weighted=weighted, max_gap=1e-3)
        error = found.position - points
        distances2.append(
            np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error).mean()
        )
    assert np.mean(distances2) == pytest.approx(3, rel=RTOL_SPREAD)


def test_faults_are_reported(sensor, points):
    views = seen_in(sensor, points)
    bundles = [view.ray_bundle(q) for view, q in views]
    left, right = bundles
    rays = {name: getattr(right, name).copy() for name in ("origin", "direction")}
    rays["direction"][0] = left.direction[0]
    rays["direction"][1] = -right.direction[1]
    rays["direction"][2] = np.nan
    rays["origin"][3] += [0, 3e-4, 0]
    std = std_of(0.02, points)
    found = triangulate((left, replace(right, **rays)), (std, std), weighted=True, max_gap=1e-4)
    assert found.fault[:5].tolist() == [
        MarkerFault.PARALLEL_RAYS,
        MarkerFault.BEHIND_CAMERA,
        MarkerFault.NO_RAY,
        MarkerFault.RAY_GAP,
        MarkerFault.NONE,
    ]
    assert np.isnan(found.position[:4]).all()
    assert np.isnan(found.covariance[:4]).all()
    assert np.isfinite(found.position[4:]).all()
    # How far the rays miss each other is reported even so: it speaks of the calibration.
    across = np.cross(left.direction[3], right.direction[3])
    apart = (rays["origin"] - left.origin)[3] @ across / np.linalg.norm(across)
    assert found.gap[3] == pytest.approx(abs(apart), rel=1e-9)


def grids_of(sensor, points):
    """Grids of both views whose corners are those points; no virtual markers."""
    shape = sensor.pattern.shape
    return {
        name: replace(
            Grid.missing(shape, ""),
            corners=view.project(points).reshape(*shape.corners, 2),
            corner_status=np.full(shape.corners, Status.MEASURED, np.uint8),
        )
        for name, view in build_views(sensor).items()
    }


def test_stage_weighs_each_corner_by_its_own_std(sensor, points):
    """Each view's own, and of a corner without one that of the parameters, here for a half."""
    rng, shape = np.random.default_rng(9), sensor.pattern.shape
    rig, exact = StereoRig(sensor), grids_of(sensor, points)
    half = np.indices(shape.corners).sum(axis=0) % 2 == 0
    assumed = sensor.triangulation.corner_noise
    distances2 = []
    for _ in range(DRAWS):
        seen = []
        for grid, own in zip(exact.values(), (0.3 * assumed, 2 * assumed), strict=True):
            std = np.where(half, own, assumed)[..., None]
            noisy = grid.corners + rng.normal(size=grid.corners.shape) * std
            seen.append(replace(grid, corners=noisy, corner_std=np.where(half, own, np.nan)))
        found = rig.triangulate(*seen)
        error = found.position - points.reshape(found.position.shape)
        inverse = np.linalg.inv(found.covariance)
        distances2.append(np.einsum("...i,...ij,...j", error, inverse, error))
    for part in (half, ~half):
        assert np.mean(np.array(distances2)[:, part]) == pytest.approx(3, rel=RTOL_SPREAD)


def test_stage_reports_why_a_marker_is_missing(sensor, points):
    grids = grids_of(sensor, points)

    def without(name, *places):
        corners, status = grids[name].corners.copy(), grids[name].corner_status.copy()
        for place in places:
            corners[place], status[place] = np.nan, Status.MISSING
        return replace(grids[name], corners=corners, corner_status=status)

    left, right = without("left", (0, 0), (0, 1)), without("right", (0, 0), (0, 2))
    right.corners[0, 3] += [0.0, 30.0]
    left.corner_status[0, 5] = Status.PREDICTED
    # A tracker that lost a corner without saying so must not poison its neighbours.
    left.corners[0, 4] = np.nan
    markers = StereoRig(sensor).triangulate(left, right)
    assert markers.fault[0, :6].tolist() == [
        MarkerFault.NOT_SEEN,
        MarkerFault.NOT_SEEN_LEFT,
        MarkerFault.NOT_SEEN_RIGHT,
        MarkerFault.RAY_GAP,
        MarkerFault.NO_RAY,
        MarkerFault.NONE,
    ]
    assert (markers.status[0, :5] == Status.MISSING).all()
    assert markers.status[0, 5] == Status.PREDICTED
    assert np.isnan(markers.position[0, :5]).all()
    assert np.isfinite(markers.position[0, 5:]).all()
    assert np.isnan(markers.covariance[0, :5]).all()
    assert (markers.status[1:] == Status.MEASURED).all()


@pytest.mark.parametrize(
    ("gap_um", "status", "share", "is_doubted"),
    [
        (177, Status.MEASURED, 1.0, True),
        (41, Status.MEASURED, 1.0, False),
        # Missing for its gap alone.
        (177, Status.MISSING, 0.6, True),
        # All others are predicted; a few may all lie under glare.
        (177, Status.MEASURED, 0.4, False),
        (177, Status.PREDICTED, 1.0, False),
    ],
)
def test_gaps_of_most_markers_that_are_not_predicted_doubt_the_sensor(
    gap_um, status, share, is_doubted
):
    states = np.full((10, 20), Status.PREDICTED, np.uint8)
    states.ravel()[: round(share * states.size)] = status
    text = implausible_ray_gap(np.full(states.shape, gap_um * 1e-6), states, "rig_7")
    assert bool(text) == is_doubted
    if is_doubted:
        assert f"{gap_um} um apart" in text
        assert "rig_7" in text


@pytest.mark.parametrize("method", ["weighted", "common_normal"])
def test_no_corner_counts_as_known_to_the_last_digit(sensor, points, method):
    """A tracker's standard deviation of 0 px is taken for 0.001 px: a covariance, not 0 or NaN."""
    grids = grids_of(sensor, points)
    rig = StereoRig(replace(sensor, triangulation=TriangulationParameters(method=method)))
    covariances = []
    for std in (0.0, 1e-3):
        deviations = np.full(sensor.pattern.shape.corners, std)
        left, right = (replace(grid, corner_std=deviations) for grid in grids.values())
        covariances.append(rig.triangulate(left, right).covariance.copy())
    assert (np.diagonal(covariances[0], axis1=-2, axis2=-1) > 0).all()
    np.testing.assert_array_equal(*covariances)


def test_parameters_choose_method_and_limit(sensor, points):
    grids = grids_of(sensor, points)
    grids["right"].corners[0, 0] += [0.0, 1.0]
    corner_std = np.full(sensor.pattern.shape.corners, 0.02)
    left, right = grids["left"], replace(grids["right"], corner_std=4 * corner_std)
    found = {}
    for method in ("weighted", "common_normal"):
        options = TriangulationParameters(method=method)
        found[method] = StereoRig(replace(sensor, triangulation=options)).triangulate(left, right)
    apart = np.linalg.norm(found["weighted"].position[0, 0] - found["common_normal"].position[0, 0])
    assert 1e-6 < apart < found["weighted"].ray_gap[0, 0] / 2
    # Of a view a quarter as sharp: across the baseline, in y, the point follows the other one.
    variances = [item.covariance[..., 1, 1].mean() for item in found.values()]
    assert variances[0] < 0.8**2 * variances[1]
    strict = TriangulationParameters(max_ray_gap=float(found["weighted"].ray_gap[0, 0]) / 2)
    markers = StereoRig(replace(sensor, triangulation=strict)).triangulate(left, right)
    assert markers.fault[0, 0] == MarkerFault.RAY_GAP
    assert (markers.fault != MarkerFault.NONE).sum() == 1


def test_one_view_scatters_as_its_covariance_says(rig):
    """On the known surface, moved to a plane so that it is level around each point."""
    rng = np.random.default_rng(8)
    surface = replace(rig.pattern.surface, type="plane", radius=float("inf"))
    points = rig.pattern.corners().reshape(-1, 3) * [1, 1, 0]
    view, q = seen_in(rig, points)[0]
    std = std_of(STD_LEFT_PX, points)
    distances2 = []
    for _ in range(DRAWS):
        rays = view.ray_bundle(q + rng.normal(size=q.shape) * STD_LEFT_PX)
        found = meet_surface(rays, std, surface)
        error = (found.position - points)[:, :2]
        inverse = np.linalg.inv(found.covariance[:, :2, :2])
        distances2.append(np.einsum("ni,nij,nj->n", error, inverse, error).mean())
    assert np.mean(distances2) == pytest.approx(2, rel=RTOL_SPREAD)
    exact = surface_intersection(*view.rays(q), surface)
    np.testing.assert_allclose(exact, points, atol=ATOL_EXACT_M, rtol=0)
