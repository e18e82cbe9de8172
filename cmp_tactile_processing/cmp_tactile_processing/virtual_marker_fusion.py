"""Virtual markers of a segment: ridge measurements fused with the curve through the corners.

The gridline deviates from the curve by a line (the corners' own errors) and a sine series whose
amplitudes have a prior: one of several roughnesses.  How likely each roughness is, in the frame
and in the segment, follows from how strongly the measurements contradict the curve.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["MODES", "ROUGHNESS", "fit_segments", "mix_models", "share_of_models"]

# Roughness: standard deviation of the first sine's amplitude, as a share of the segment's length;
# the k-th one's is k^-DECAY of it.
ROUGHNESS = np.array([0.0004, 0.003, 0.015, 0.08])
MODES, DECAY = 5, 1.5
UNKNOWNS = MODES + 2
# Before a frame is seen: how likely each roughness is, and the number of segments this counts for.
SHARE_BEFORE = np.array([0.4, 0.3, 0.2, 0.1])
WEIGHT_BEFORE = 8.0
# A measurement further from the fit than this many standard deviations is dirt.
OUTLIER = 4.0
# A marker further than this from every measured column along the gridline is predicted, px.
NEAR_PX = 2.0
LEAST_COLUMNS = 3
# Standard deviations of a corner that came without one, px.
UNKNOWN_CORNER = 0.05

NEVER, MEASURED, PREDICTED = 0, 1, 2


@njit(cache=True, nogil=True)
def _basis(t, row):  # type: ignore[no-untyped-def]
    row[0] = 1 - t
    row[1] = t
    first = math.sin(math.pi * t)
    twice = 2 * math.cos(math.pi * t)
    row[2] = first
    row[3] = twice * first
    for k in range(4, UNKNOWNS):
        row[k] = twice * row[k - 1] - row[k - 2]


@njit(cache=True, nogil=True, fastmath=True)
def _accumulate(columns, count, used, normal, right):  # type: ignore[no-untyped-def]
    """Normal equations of the used columns; returns their weighted sum of squares."""
    for a in range(UNKNOWNS):
        right[a] = 0.0
        for b in range(a + 1):
            normal[a, b] = 0.0
    row = np.empty(UNKNOWNS)
    energy = 0.0
    for index in range(count):
        if not used[index]:
            continue
        _basis(columns[index, 0], row)
        bend = columns[index, 3] * columns[index, 4] * math.pi**2
        for k in range(2, UNKNOWNS):
            row[k] *= 1 - bend * (k - 1) ** 2
        weight = 1 / columns[index, 2]
        value = columns[index, 1]
        energy += weight * value * value
        for a in range(UNKNOWNS):
            scaled = weight * row[a]
            right[a] += scaled * value
            for b in range(a + 1):
                normal[a, b] += scaled * row[b]
    return energy


@njit(cache=True, nogil=True, fastmath=True)
def _solve(normal, right, prior, lower, half, solution):  # type: ignore[no-untyped-def]
    """Posterior mean under prior variances; returns twice its log evidence less a constant.

    lower: Cholesky factor of normal + 1 / prior, with the inverse of its diagonal on it.
    """
    log_determinant = 0.0
    explained = 0.0
    for a in range(UNKNOWNS):
        log_determinant += math.log(prior[a])
        for b in range(a + 1):
            total = normal[a, b]
            if a == b:
                total += 1 / prior[a]
            for k in range(b):
                total -= lower[a, k] * lower[b, k]
            if a == b:
                log_determinant += math.log(total)
                lower[a, a] = 1 / math.sqrt(total)
            else:
                lower[a, b] = total * lower[b, b]
        total = right[a]
        for k in range(a):
            total -= lower[a, k] * half[k]
        half[a] = total * lower[a, a]
        explained += half[a] * half[a]
    for a in range(UNKNOWNS - 1, -1, -1):
        total = half[a]
        for k in range(a + 1, UNKNOWNS):
            total -= lower[k, a] * solution[k]
        solution[a] = total * lower[a, a]
    return explained - log_determinant


@njit(cache=True, nogil=True, fastmath=True)
def _variance(lower, row):  # type: ignore[no-untyped-def]
    """Posterior variance of the deviation whose basis values are `row`, which is overwritten."""
    total = 0.0
    for a in range(UNKNOWNS):
        value = row[a]
        for k in range(a):
            value -= lower[a, k] * row[k]
        row[a] = value * lower[a, a]
        total += row[a] * row[a]
    return total


@njit(cache=True, nogil=True)
def _drop_outliers(columns, count, used, solution):  # type: ignore[no-untyped-def]
    row = np.empty(UNKNOWNS)
    dropped = 0
    for index in range(count):
        _basis(columns[index, 0], row)
        bend = columns[index, 3] * columns[index, 4] * math.pi**2
        fitted = row[0] * solution[0] + row[1] * solution[1]
        for k in range(2, UNKNOWNS):
            fitted += row[k] * (1 - bend * (k - 1) ** 2) * solution[k]
        good = (columns[index, 1] - fitted) ** 2 < OUTLIER**2 * columns[index, 2]
        if used[index] and not good:
            dropped += 1
        used[index] = good
    return dropped


@njit(cache=True, nogil=True)
def fit_segments(  # type: ignore[no-untyped-def]  # noqa: PLR0913, PLR0917
    curve, corner_std, counts, columns, used, deviation, variance, evidence
):
    """Fit every segment under every roughness.

    curve (a, b, 4, 2); corner_std (a, b+1); counts (a, b), columns (a, b, COLUMNS, 5) from
    `measure_ridges`; used (COLUMNS,) scratch.  Results: deviation, variance (a, b, models, n) at
    the markers across px, px^2; evidence (a, b, models): log, 0 where nothing was measured.
    """
    normal = np.empty((UNKNOWNS, UNKNOWNS))
    lower = np.empty((UNKNOWNS, UNKNOWNS))
    right, half, solution = np.empty(UNKNOWNS), np.empty(UNKNOWNS), np.empty(UNKNOWNS)
    prior, row = np.empty(UNKNOWNS), np.empty(UNKNOWNS)
    n = deviation.shape[3]
    last = len(ROUGHNESS) - 1
    for i in range(curve.shape[0]):
        for j in range(curve.shape[1]):
            c = curve[i, j]
            x = abs(c[1, 0] + c[2, 0] + c[3, 0])
            y = abs(c[1, 1] + c[2, 1] + c[3, 1])
            if not (math.isfinite(x) and math.isfinite(y)):
                continue
            length = math.hypot(x, y)
            # Standard deviations across the gridline become those along the column.
            tilt = length / max(x, y)
            for end in range(2):
                std = corner_std[i, j + end]
                if not math.isfinite(std):
                    std = UNKNOWN_CORNER
                prior[end] = (max(std, 1e-4) * tilt) ** 2
            count = counts[i, j]
            if count < LEAST_COLUMNS:
                count = 0
                counts[i, j] = 0
            for index in range(count):
                used[index] = True
            _accumulate(columns[i, j], count, used, normal, right)
            for model in range(last, -1, -1):
                for k in range(MODES):
                    prior[2 + k] = (ROUGHNESS[model] * length * tilt * (k + 1) ** -DECAY) ** 2
                log_evidence = _solve(normal, right, prior, lower, half, solution) / 2
                if model == last and count > 0:
                    if _drop_outliers(columns[i, j], count, used, solution) > 0:
                        kept = 0
                        for index in range(count):
                            if used[index]:
                                for field in range(columns.shape[3]):
                                    columns[i, j, kept, field] = columns[i, j, index, field]
                                kept += 1
                        count = kept if kept >= LEAST_COLUMNS else 0
                        counts[i, j] = count
                        for index in range(count):
                            used[index] = True
                        _accumulate(columns[i, j], count, used, normal, right)
                        log_evidence = _solve(normal, right, prior, lower, half, solution) / 2
                evidence[i, j, model] = log_evidence if count > 0 else 0.0
                for marker in range(n):
                    _basis((marker + 1) / (n + 1), row)
                    total = 0.0
                    for k in range(UNKNOWNS):
                        total += row[k] * solution[k]
                    deviation[i, j, model, marker] = total
                    variance[i, j, model, marker] = _variance(lower, row)


@njit(cache=True, nogil=True)
def share_of_models(counts, evidence, share):  # type: ignore[no-untyped-def]
    """How likely each roughness is in this frame: a few rounds of expectation maximisation."""
    models = len(share)
    total = np.empty(models)
    for model in range(models):
        share[model] = SHARE_BEFORE[model]
    for _ in range(3):
        for model in range(models):
            total[model] = WEIGHT_BEFORE * SHARE_BEFORE[model]
        for i in range(counts.shape[0]):
            for j in range(counts.shape[1]):
                if counts[i, j] == 0:
                    continue
                top = -math.inf
                for model in range(models):
                    top = max(top, evidence[i, j, model])
                scale = 0.0
                for model in range(models):
                    scale += share[model] * math.exp(evidence[i, j, model] - top)
                for model in range(models):
                    part = share[model] * math.exp(evidence[i, j, model] - top)
                    total[model] += part / scale
        sum_total = total.sum()
        for model in range(models):
            share[model] = total[model] / sum_total


@njit(cache=True, nogil=True)
def mix_models(  # type: ignore[no-untyped-def]  # noqa: PLR0913, PLR0917
    curve, counts, columns, deviation, variance, evidence, share, position, status, std
):
    """Mean over the roughnesses, into position (a, b, n, 2), status and std (a, b, n)."""
    n = position.shape[2]
    models = len(share)
    weight = np.empty(models)
    for i in range(curve.shape[0]):
        for j in range(curve.shape[1]):
            c = curve[i, j]
            x = c[1, 0] + c[2, 0] + c[3, 0]
            y = c[1, 1] + c[2, 1] + c[3, 1]
            if not (math.isfinite(x) and math.isfinite(y)):
                for marker in range(n):
                    position[i, j, marker, 0] = math.nan
                    position[i, j, marker, 1] = math.nan
                    status[i, j, marker] = NEVER
                    std[i, j, marker] = math.nan
                continue
            along_axis = 1 if abs(y) > abs(x) else 0
            span = max(abs(x), abs(y))
            top = -math.inf
            for model in range(models):
                top = max(top, evidence[i, j, model])
            scale = 0.0
            for model in range(models):
                weight[model] = share[model] * math.exp(evidence[i, j, model] - top)
                scale += weight[model]
            for marker in range(n):
                mean, square = 0.0, 0.0
                for model in range(models):
                    part = weight[model] / scale
                    value = deviation[i, j, model, marker]
                    mean += part * value
                    square += part * (variance[i, j, model, marker] + value * value)
                t = (marker + 1) / (n + 1)
                for axis in range(2):
                    position[i, j, marker, axis] = (
                        (c[3, axis] * t + c[2, axis]) * t + c[1, axis]
                    ) * t + c[0, axis]
                position[i, j, marker, 1 - along_axis] += mean
                v_x = (3 * c[3, 0] * t + 2 * c[2, 0]) * t + c[1, 0]
                v_y = (3 * c[3, 1] * t + 2 * c[2, 1]) * t + c[1, 1]
                v_along = v_y if along_axis == 1 else v_x
                across = abs(v_along) / math.hypot(v_x, v_y)
                std[i, j, marker] = math.sqrt(max(square - mean * mean, 0.0)) * across
                nearest = math.inf
                for index in range(counts[i, j]):
                    nearest = min(nearest, abs(columns[i, j, index, 0] - t))
                near = nearest * span < NEAR_PX
                status[i, j, marker] = MEASURED if near else PREDICTED
