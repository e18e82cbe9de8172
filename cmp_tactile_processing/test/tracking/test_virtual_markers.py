"""Virtual markers on synthetic grids whose gridlines are known in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.measured import GridShape, Status
from cmp_tactile_processing.tracking.virtual_markers.locator import VirtualMarkerLocator

from .conftest import prepared

SHAPE = GridShape(5, 6, 6)
SIDE_PX = 17.0
CORNER_STD_PX = 0.006
# Limits of RMS distances across the gridline, px.
RMSE_CLEAN_PX, RMSE_BUMP_PX, RMSE_BLURRED_PX = 0.012, 0.015, 0.03
# A standard deviation is honest when it is within this factor of the RMS error.
HONEST = 1.5


@dataclass(frozen=True)
class Scene:
    """A checkerboard turned by 0.1 rad, sheared, with one bump of the gridlines.

    bump: (column, row, height, radius) in cells; the gridlines along the rows rise over it.
    """

    shape: GridShape
    side: float = SIDE_PX
    shear: float = 0.15
    bump: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    @property
    def _axes(self):
        c, s = np.cos(0.1), np.sin(0.1)
        return np.array([[c, -s], [s, c]]) @ [[1, self.shear], [0, 1]] * self.side

    def _lift(self, m):
        col, row, height, radius = self.bump
        return height * np.exp(-((m[..., 0] - col) ** 2 + (m[..., 1] - row) ** 2) / (2 * radius**2))

    def to_image(self, m):
        lifted = np.stack([m[..., 0], m[..., 1] + self._lift(m)], axis=-1)
        return lifted @ self._axes.T + 3.0 * self.side

    def to_pattern(self, q):
        flat = (q - 3.0 * self.side) @ np.linalg.inv(self._axes).T
        m = flat.copy()
        for _ in range(8):  # contracts by the bump's slope, 0.15, each time
            m[..., 1] = flat[..., 1] - self._lift(m)
        return m

    @property
    def corners(self):
        i, j = np.mgrid[: self.shape.rows, : self.shape.cols].astype(float)
        return self.to_image(np.stack([j, i], axis=-1))

    def render(self, blur=0.8, samples=10):
        """Grey image without noise: samples x samples points a pixel, then a Gaussian blur."""
        width, height = (self.corners.max(axis=(0, 1)) + 2.5 * self.side).astype(int)
        v, u = np.mgrid[:height, :width].astype(float)
        total = np.zeros((height, width))
        for shift in np.ndindex(samples, samples):
            sub = (np.array(shift) + 0.5) / samples - 0.5
            cell = np.floor(self.to_pattern(np.stack([u + sub[0], v + sub[1]], axis=-1)))
            printed = (cell >= -1) & (cell < [self.shape.cols, self.shape.rows])
            total += printed.all(axis=-1) & (cell.sum(axis=-1) % 2 == 0)
        return cv2.GaussianBlur(40 + 130 * total / samples**2, (0, 0), blur)

    def distance(self, points, along):
        """Signed distance across the gridlines of points (rows, cols, n, 2); along: 0 or 1."""
        lines = np.arange(points.shape[along], dtype=float)
        lines = lines[:, None, None] if along == 0 else lines[None, :, None]
        off = self.to_pattern(points)[..., 1 - along] - lines
        slopes = [
            self.to_pattern(points + step)[..., 1 - along]
            - self.to_pattern(points - step)[..., 1 - along]
            for step in ([5e-5, 0], [0, 5e-5])
        ]
        return off * 1e-4 / np.hypot(*slopes)


def located(scene, image, method="fused", corner_error=CORNER_STD_PX, **doubtful):
    corners = scene.corners
    corners = corners + np.random.default_rng(3).normal(0, corner_error, corners.shape)
    std = np.full(scene.shape.corners, max(corner_error, 1e-3))
    return VirtualMarkerLocator(scene.shape, method).locate(image, corners, std, **doubtful)


def errors_and_stds(scene, found):
    rows, cols = found
    error = [scene.distance(rows.position, 0).ravel(), scene.distance(cols.position, 1).ravel()]
    return np.concatenate(error), np.concatenate([rows.std.ravel(), cols.std.ravel()])


def assert_honest(error, std):
    """Root mean squares alike."""
    assert rms(error) / HONEST < rms(std) < HONEST * rms(error)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.fixture(scope="module")
def plain():
    scene = Scene(SHAPE)
    return scene, scene.render()


@pytest.fixture(scope="module")
def bumped():
    """A contact much narrower than a cell between two corners: 1 px high, 5 px in radius."""
    scene = Scene(SHAPE, bump=(2.5, 2.0, 0.06, 0.3))
    return scene, scene.render()


def test_clean_markers_lie_on_their_gridlines(plain):
    scene, image = plain
    found = located(scene, prepared(image))
    error, std = errors_and_stds(scene, found)
    assert rms(error) < RMSE_CLEAN_PX
    assert np.abs(error).max() < 0.05
    for part in (np.s_[: found[0].std.size], np.s_[found[0].std.size :]):
        assert_honest(error[part], std[part])
    assert all((markers.status == Status.MEASURED).all() for markers in found)


def test_markers_run_from_their_corner_to_the_next(plain):
    scene, image = plain
    rows, cols = located(scene, prepared(image))
    t = np.arange(1, 7) / 7
    m = scene.to_pattern(rows.position)[..., 0] - np.arange(5)[None, :, None]
    np.testing.assert_allclose(m, np.broadcast_to(t, m.shape), atol=0.01)
    m = scene.to_pattern(cols.position)[..., 1] - np.arange(4)[:, None, None]
    np.testing.assert_allclose(m, np.broadcast_to(t, m.shape), atol=0.01)


def test_a_bump_between_two_corners_is_not_smoothed_away(bumped):
    scene, image = bumped
    without = scene.distance(located(scene, prepared(np.full_like(image, 100.0)))[0].position, 0)
    assert np.abs(without).max() > 0.5
    found = located(scene, prepared(image))
    error, std = errors_and_stds(scene, found)
    assert rms(error) < RMSE_BUMP_PX
    assert np.abs(error).max() < 0.08
    assert (np.abs(error) < 5 * std).all()
    # What contradicts the curve is less sure than what agrees with it.
    assert found[0].std[2, 2].mean() > 1.5 * found[0].std[4].mean()


@pytest.mark.parametrize(
    ("seen", "largest"),
    [
        # Without a model of the line that crosses the ridge is off by 0.3 px next to the corners.
        ({"shear": -0.5}, 0.06),
        ({"shear": 0.5}, 0.06),
        ({"side": 8.0}, np.inf),
        ({"side": 40.0}, np.inf),
    ],
    ids=str,
)
def test_sheared_small_and_large_checkers(seen, largest):
    scene = Scene(SHAPE, **seen)
    error, _ = errors_and_stds(scene, located(scene, prepared(scene.render())))
    assert rms(error) < RMSE_CLEAN_PX
    assert np.abs(error).max() < largest


def test_a_hidden_segment_is_predicted_and_less_sure(plain):
    scene, image = plain
    image = image.copy()
    x, y = scene.corners[2, 2:4].mean(axis=0).astype(int)
    cv2.circle(image, (int(x), int(y)), 7, 90.0, -1)
    rows, _ = located(scene, prepared(image))
    middle = slice(2, 4)
    assert (rows.status[2, 2, middle] == Status.PREDICTED).all()
    assert (rows.status[[0, 4]] == Status.MEASURED).all()
    assert (rows.std[2, 2, middle] > 1.5 * rows.std[0, :, middle].mean()).all()
    assert np.abs(scene.distance(rows.position, 0)[2, 2, middle]).max() < 0.1


def test_doubtful_markers_are_not_measured(plain):
    scene, image = plain
    image = image.copy()
    x, y = scene.corners[2, 2:4].mean(axis=0).astype(int)
    image[y - 2 : y + 1, x - 2 : x + 3] = 170.0  # missing ink that moves the edge by 2 px
    doubtful = np.zeros(SHAPE.row_lines, dtype=bool)
    doubtful[2, 2, 1:5] = True
    spoilt = located(scene, prepared(image))[0]
    rows = located(scene, prepared(image), doubtful_rows=doubtful)[0]
    assert np.abs(scene.distance(spoilt.position, 0)[2, 2]).max() > 0.2
    assert np.abs(scene.distance(rows.position, 0)[2, 2, 2:4]).max() < 0.05
    assert (rows.status[2, 2, 2:4] == Status.PREDICTED).all()
    assert (rows.std[2, 2, 2:4] > spoilt.std[0, 0, 2:4]).all()


@pytest.mark.parametrize("method", ["fused", "local_correction"])
def test_next_to_a_missing_corner_there_is_none(plain, method):
    scene, image = plain
    corners = scene.corners.copy()
    corners[0, 0] = corners[2, 3] = np.nan
    std = np.where(np.isnan(corners[..., 0]), np.nan, CORNER_STD_PX)
    rows, cols = VirtualMarkerLocator(SHAPE, method).locate(prepared(image), corners, std)
    missing = np.zeros(SHAPE.row_lines, dtype=bool)
    missing[0, 0] = missing[2, 2:4] = True
    np.testing.assert_array_equal(rows.status == Status.MISSING, missing)
    np.testing.assert_array_equal(np.isnan(rows.position[..., 0]), missing)
    np.testing.assert_array_equal(np.isnan(rows.std), missing)
    missing = np.zeros(SHAPE.col_lines, dtype=bool)
    missing[0, 0] = missing[1:3, 3] = True
    np.testing.assert_array_equal(cols.status == Status.MISSING, missing)
    assert np.nanmax(np.abs(scene.distance(rows.position, 0))) < 0.1


def test_local_correction_is_as_good_as_its_method(plain):
    """Quadratic through three pixels of the gradient: 0.014 px, and it says what it measured."""
    scene, image = plain
    rows, cols = located(scene, prepared(image), "local_correction")
    error, std = errors_and_stds(scene, (rows, cols))
    measured = np.concatenate([rows.status.ravel(), cols.status.ravel()]) == Status.MEASURED
    assert 0.4 < measured.mean() < 0.9
    assert rms(error[measured]) < 0.018
    assert_honest(error[measured], std[measured])


@pytest.mark.parametrize("method", ["fused", "local_correction"])
def test_without_corners_or_picture_nothing_is_invented(plain, method):
    scene, image = plain
    locator = VirtualMarkerLocator(SHAPE, method)
    nothing = np.full_like(scene.corners, np.nan)
    rows, cols = locator.locate(prepared(image), nothing, nothing[..., 0])
    assert (rows.status == Status.MISSING).all()
    assert np.isnan(cols.position).all()
    flat = prepared(np.full_like(image, 80.0))
    rows, cols = locator.locate(flat, scene.corners, nothing[..., 0])
    assert (rows.status == Status.PREDICTED).all()
    assert np.isfinite(cols.std).all()
    outside = scene.corners + 1000.0
    rows, _ = locator.locate(prepared(image), outside, nothing[..., 0])
    assert (rows.status == Status.PREDICTED).all()


def test_an_unknown_method_is_named():
    with pytest.raises(InputError, match="found 'best', expected one of fused, local_corr"):
        VirtualMarkerLocator(SHAPE, "best")
