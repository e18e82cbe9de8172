"""Segments are fitted side by side, each as if it were alone."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.tracking.virtual_markers.fusion import (
    DECAY,
    LANES,
    MODES,
    ROUGHNESS,
    SHARE_BEFORE,
    Fits,
    FitScratch,
    MarkerBasis,
    blocks_of,
    fit_segments,
    share_of_models,
)
from cmp_tactile_processing.tracking.virtual_markers.ridge import MAX_COLUMNS

MARKERS, LENGTH_PX, CORNER_STD, RIDGE_STD = 6, 20.0, 0.02, 0.03
MEASURED = 9


def _measured(segments):
    """Parameters and deviations (segments, MEASURED), px, of gridlines that bend differently."""
    random = np.random.default_rng(segments)
    t = (np.arange(MEASURED) + random.uniform(0.2, 0.8, (segments, MEASURED))) / MEASURED
    bend = random.normal(0, 0.2, (segments, 1))
    return t, bend * np.sin(np.pi * t) + random.normal(0, RIDGE_STD, t.shape)


def _fitted(t, deviation):
    """Fits of these segments, all of one length, without blur."""
    count = len(t)
    lanes = blocks_of(count) * LANES
    columns = np.zeros((lanes // LANES, 5, MAX_COLUMNS, LANES), np.float32)
    for s in range(count):
        columns[s // LANES, :3, :MEASURED, s % LANES] = (
            t[s],
            deviation[s],
            np.full(MEASURED, RIDGE_STD**-2),
        )
    counts = np.where(np.arange(lanes) < count, MEASURED, 0)
    size, std = np.ones((2, lanes)), np.full((2, lanes), CORNER_STD)
    size[0] = LENGTH_PX
    fits = Fits.from_shape(count, MARKERS)
    fit_segments(
        size, std, counts, columns, MarkerBasis.from_count(MARKERS), fits, FitScratch.new()
    )
    return fits


def _seen(t):
    """What parameters t see of two corners and of the sines, (n, 2 + MODES)."""
    return np.stack([1 - t, t, *(np.sin(np.pi * k * t) for k in range(1, MODES + 1))], axis=-1)


@pytest.mark.parametrize("segments", [1, LANES - 1, LANES, LANES + 1])
def test_each_segment_has_the_posterior_of_its_own_measurements(segments):
    """That of a linear model, solved in double precision, under each roughness."""
    t, deviation = _measured(segments)
    fits = _fitted(t, deviation)
    markers = _seen(np.linspace(0, 1, MARKERS + 2))
    for number, roughness in enumerate(ROUGHNESS):
        sines = (roughness * LENGTH_PX * np.arange(1.0, MODES + 1) ** -DECAY) ** 2
        prior = np.diag(1 / np.array([CORNER_STD**2, CORNER_STD**2, *sines]))
        for s in (0, segments // 2, segments - 1):
            seen = _seen(t[s])
            covariance = np.linalg.inv(seen.T @ seen / RIDGE_STD**2 + prior)
            unknowns = covariance @ seen.T @ deviation[s] / RIDGE_STD**2
            # Single precision, times the condition of these matrices.
            np.testing.assert_allclose(
                fits.deviation[number, :, s], markers @ unknowns, atol=1e-4 * RIDGE_STD
            )
            variance = np.einsum("ka,ab,kb->k", markers, covariance, markers)
            np.testing.assert_allclose(fits.variance[number, :, s], variance, rtol=1e-3)


def test_what_the_roughnesses_say_together_is_their_mixture():
    """Of segments without measurements each is as likely as before; what they differ by counts."""
    fits, random = Fits.from_shape(LANES, MARKERS), np.random.default_rng(5)
    fits.deviation[:] = random.normal(0, 0.3, fits.deviation.shape)
    fits.variance[:] = random.uniform(0.01, 0.1, fits.variance.shape)
    share_of_models(np.zeros(LANES, np.int64), fits)
    mean = np.tensordot(SHARE_BEFORE, fits.deviation, 1)
    square = np.tensordot(SHARE_BEFORE, fits.variance + fits.deviation**2, 1)
    np.testing.assert_allclose(fits.mean, mean, rtol=1e-12)
    np.testing.assert_allclose(fits.spread, square - mean**2, rtol=1e-9)
