"""Virtual markers of a segment: ridge measurements fused with the curve through the corners.

The gridline deviates from the curve by a line (the corners' own errors) and a sine series whose
amplitudes have a prior: one of several roughnesses.  How likely each roughness is, in the frame
and in the segment, follows from how strongly the measurements contradict the curve.  The segments
are fitted side by side, in blocks: the last axis of every array counts them, so that each step runs
over neighbouring numbers.  Arrays are long enough for whole blocks.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import NAN_SAFE, kernel, kernel_part

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Index = NDArray[np.int64]
# Roughness: standard deviation of the first sine's amplitude, as a share of the segment's length;
# the k-th one's is k^-DECAY of it; of its square, SHARE_OF_SINE.
ROUGHNESS = np.array([0.0004, 0.005, 0.04])
MODELS = len(ROUGHNESS)
MODES, DECAY = 5, 1.5
SHARE_OF_SINE = np.arange(1.0, MODES + 1) ** (-2 * DECAY)
UNKNOWNS = MODES + 2
ENTRIES = UNKNOWNS * (UNKNOWNS + 1) // 2
# Before a frame is seen: how likely each roughness is, and the number of segments this counts for.
SHARE_BEFORE = np.array([0.85, 0.12, 0.03])
WEIGHT_BEFORE = 8.0
EXPECTATION_ROUNDS = 12
# A measurement further from the fit than this many standard deviations is dirt.
OUTLIER = 4.0
LEAST_COLUMNS = 3
# Corners and ridges share pixels: the variance of their noise is this many times that of
# independent measurements.
SHARED_PIXELS_VARIANCE_RATIO = 1.2
# The deviation of a corner's own fit allows for the bias of straight edges, and so do the fits
# here.  The gridlines remove this much of it from a corner and from a virtual marker.  Measured
# with noise of 1 to 16 grey levels, blur and little light (benchmarks/tracking/bound.py).
CORNER_BIAS_PX = 3e-3
MARKER_BIAS_PX = 3.5e-3
# Segments that are fitted side by side, a block.  They are stored in single precision, which halves
# the time and moves no marker of the sample grasp by more than 2e-7 px.
LANES = 64


def blocks_of(segments: int) -> int:
    """How many blocks hold so many segments."""
    return -(-segments // LANES)


class Fits(NamedTuple):
    """Of every segment s, under every roughness m, at every marker k and at the corners.

    deviation, variance (m, k, s) px across; evidence (m, s): relative to the likeliest roughness,
    1 where nothing was measured; share (m,): how likely each roughness is in the frame; mean,
    spread (k, s): deviation and its variance over the roughnesses.
    """

    deviation: Array
    variance: Array
    evidence: Array
    share: Array
    mean: Array
    spread: Array

    @classmethod
    def from_shape(cls, segments: int, markers: int) -> Fits:
        """Buffers for so many segments with so many markers each."""
        lanes = blocks_of(segments) * LANES
        deviation, variance = np.empty((2, MODELS, markers + 2, lanes))
        mean, spread = np.empty((2, markers + 2, lanes))
        evidence, share = np.empty((MODELS, lanes)), np.empty(MODELS)
        return cls(deviation, variance, evidence, share, mean, spread)


class FitScratch(NamedTuple):
    """Of a block: normal equations, prior variances, covariance, its determinant.

    energy: weighted sum of the squared measurements.
    """

    normal: Single
    right: Single
    prior: Single
    covariance: Single
    solution: Single
    row: Single
    pivot: Single
    energy: Single
    determinant: Array

    @classmethod
    def new(cls) -> FitScratch:
        """Buffers of their own."""
        rows = (ENTRIES, UNKNOWNS, UNKNOWNS, ENTRIES, UNKNOWNS, UNKNOWNS, UNKNOWNS + 1, 1)
        arrays: list[Any] = [np.empty((count, LANES), np.float32) for count in rows]
        return cls(*[*arrays, np.empty((1, LANES))])


class MarkerBasis(NamedTuple):
    """values (k, UNKNOWNS): deviation at marker k from the unknowns; pairs (k, ENTRIES): its
    variance from their covariance, products of the values, those beside the diagonal twice.
    """

    values: Single
    pairs: Single

    @classmethod
    def from_count(cls, count: int) -> MarkerBasis:
        """Of `count` markers, equally spaced between two corners, and these first and last."""
        t = np.arange(count + 2.0) / (count + 1)
        sines = [np.sin(np.pi * t * k) for k in range(1, MODES + 1)]
        values = np.stack([1 - t, t, *sines], axis=1)
        a, b = np.tril_indices(UNKNOWNS)
        pairs = values[:, a] * values[:, b] * np.where(a == b, 1.0, 2.0)
        return cls(*(np.require(each, np.float32, "C") for each in (values, pairs)))


@kernel_part(fastmath=True)
def _set_rows(columns: Single, column: int, row: Single) -> None:
    """What a measured column sees of each unknown."""
    for s in range(LANES):
        t = columns[0, column, s]
        # Cosine and sine of pi (t - 1/2) as power series, to 1e-6.
        x = (t - 0.5) * math.pi
        z = x * x
        sine = 1 + z * (-1 / 2 + z * (1 / 24 + z * (-1 / 720 + z * (1 / 40320 - z / 3628800))))
        cosine = -x * (1 + z * (-1 / 6 + z * (1 / 120 + z * (-1 / 5040 + z / 362880))))
        row[0, s] = 1 - t
        row[1, s] = t
        # Blur flattens the k-th sine by exp(-x k^2); the crossing gridline's pull sees its slope.
        x = columns[3, column, s]
        lean = columns[4, column, s]
        share = 1 / (1 + x * (1 + x * (1 / 2 + x / 6)))
        ratio, flattened = share, 1.0
        row[0, s] -= lean
        row[1, s] += lean
        before, here, slope_before, slope = 0.0, sine, 1.0, cosine
        for k in range(1, MODES + 1):
            flattened *= ratio
            ratio *= share * share
            row[k + 1, s] = here * flattened + lean * math.pi * k * slope
            before, here = here, 2 * cosine * here - before
            slope_before, slope = slope, 2 * cosine * slope - slope_before


@kernel_part(fastmath=True)
def _accumulate(columns: Single, longest: int, work: FitScratch) -> None:
    """Normal equations of the measured columns."""
    normal, right, row, scale = work.normal, work.right, work.row, work.pivot
    normal[:] = 0.0
    right[:] = 0.0
    work.energy[:] = 0.0
    for column in range(longest):
        _set_rows(columns, column, row)
        for s in range(LANES):
            value = columns[1, column, s]
            work.energy[0, s] += columns[2, column, s] * value * value
        entry = 0
        for a in range(len(work.right)):
            for s in range(LANES):
                scale[0, s] = columns[2, column, s] * row[a, s]
                right[a, s] += scale[0, s] * columns[1, column, s]
            for b in range(a + 1):
                for s in range(LANES):
                    normal[entry, s] += scale[0, s] * row[b, s]
                entry += 1


@kernel_part(forceinline=True)
def _entry(a: int, b: int) -> int:
    """Place of an entry of a symmetric matrix in its lower triangle, row by row."""
    return a * (a + 1) // 2 + b if a >= b else b * (b + 1) // 2 + a


@kernel_part(fastmath=True)
def _sweep(k: int, work: FitScratch) -> None:
    """Solve the symmetric matrix for its k-th unknown; all swept, it is its negative inverse."""
    matrix, pivot, determinant = work.covariance, work.pivot, work.determinant
    diagonal = _entry(k, k)
    for s in range(LANES):
        # No less than the prior's share: rounding could leave it negative in a very long segment.
        own = max(matrix[diagonal, s], 1 / work.prior[k, s])
        determinant[0, s] *= own * work.prior[k, s]
        pivot[-1, s] = -1 / own
    for a in range(len(work.right)):
        entry = _entry(a, k)
        for s in range(LANES):
            pivot[a, s] = matrix[entry, s]
            matrix[entry, s] *= -pivot[-1, s]
    for a in range(len(work.right)):
        for b in range(a + 1):
            if k not in (a, b):
                entry, beside = _entry(a, b), _entry(a, k)
                for s in range(LANES):
                    matrix[entry, s] -= matrix[beside, s] * pivot[b, s]
    for s in range(LANES):
        matrix[diagonal, s] = pivot[-1, s]


@kernel_part(fastmath=True)
def _invert(work: FitScratch) -> None:
    """Covariance, the inverse of normal + 1 / prior, by sweeping one unknown after the other.

    determinant: of (normal + 1 / prior) times the priors.
    """
    matrix = work.covariance
    for entry in range(len(work.normal)):
        for s in range(LANES):
            matrix[entry, s] = work.normal[entry, s]
    work.determinant[:] = 1.0
    for k in range(len(work.right)):
        for s in range(LANES):
            matrix[_entry(k, k), s] += 1 / work.prior[k, s]
    for k in range(len(work.right)):
        _sweep(k, work)
    for entry in range(len(work.normal)):
        for s in range(LANES):
            matrix[entry, s] = -matrix[entry, s]


@kernel_part(fastmath=True)
def _solve(work: FitScratch) -> None:
    for a in range(len(work.right)):
        for s in range(LANES):
            work.solution[a, s] = 0.0
        for b in range(len(work.right)):
            entry = _entry(a, b)
            for s in range(LANES):
                work.solution[a, s] += work.covariance[entry, s] * work.right[b, s]


@kernel_part
def _is_clean(work: FitScratch) -> bool:
    """Whether all that the fits leave unexplained is less than one outlier would leave."""
    for s in range(LANES):
        left = work.energy[0, s]
        for a in range(len(work.right)):
            left -= work.solution[a, s] * work.right[a, s]
        if left > OUTLIER**2:
            return False
    return True


@kernel_part
def _drop_outliers(columns: Single, counts: Index, longest: int, work: FitScratch) -> int:
    """Take the weight from columns that the fit contradicts; returns how many these were."""
    if _is_clean(work):
        return 0
    dropped = 0
    for column in range(longest):
        _set_rows(columns, column, work.row)
        for s in range(LANES):
            fitted = 0.0
            for k in range(len(work.right)):
                fitted += work.row[k, s] * work.solution[k, s]
            weight = columns[2, column, s]
            if weight * (columns[1, column, s] - fitted) ** 2 > OUTLIER**2:
                columns[2, column, s] = 0.0
                counts[s] -= 1
                dropped += 1
    return dropped


@kernel_part
def _drop_short(columns: Single, counts: Index, longest: int) -> None:
    for s in range(LANES):
        if counts[s] < LEAST_COLUMNS:
            counts[s] = 0
            for column in range(longest):
                columns[2, column, s] = 0.0


@kernel_part(fastmath=True)
def _set_markers(
    basis: MarkerBasis, deviation: Array, variance: Array, first: int, work: FitScratch
) -> None:
    """Deviation and its variance at the markers of a block under one roughness."""
    total = work.pivot
    for marker in range(basis.values.shape[0]):
        for s in range(LANES):
            total[0, s] = total[1, s] = np.float32(0)
        for a in range(len(work.right)):
            value = basis.values[marker, a]
            for s in range(LANES):
                total[0, s] += value * work.solution[a, s]
        for entry in range(len(work.normal)):
            pair = basis.pairs[marker, entry]
            for s in range(LANES):
                total[1, s] += pair * work.covariance[entry, s]
        means = deviation[marker, first : first + LANES]
        spreads = variance[marker, first : first + LANES]
        for s in range(LANES):
            means[s] = total[0, s]
            spreads[s] = total[1, s]


@kernel_part(fastmath=True)
def _set_evidence(evidence: Array, work: FitScratch) -> None:
    """Log evidence of one roughness less a constant of the segment."""
    for s in range(LANES):
        explained = 0.0
        for a in range(len(work.right)):
            explained += work.solution[a, s] * work.right[a, s]
        evidence[s] = (explained - math.log(work.determinant[0, s])) / 2


@kernel_part
def _set_prior(size: Array, end_std: Array, first: int, model: int, work: FitScratch) -> None:
    """Variances of the unknowns of a block before anything is measured, under one roughness."""
    for s in range(LANES):
        tilt = size[1, first + s]
        for end in range(2):
            work.prior[end, s] = (end_std[end, first + s] * tilt) ** 2
        sine = ROUGHNESS[model] * size[0, first + s] * tilt
        for k in range(MODES):
            work.prior[2 + k, s] = sine * sine * SHARE_OF_SINE[k]


@kernel
def fit_segments(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    size: Array,
    end_std: Array,
    counts: Index,
    columns: Single,
    basis: MarkerBasis,
    fits: Fits,
    work: FitScratch,
) -> None:
    """Fit every segment s under every roughness.

    size (2, s): length of the segment, px, and what a distance across it is along a column;
    end_std (2, s) px of its corners; counts (s,), columns (s / LANES, 5, COLUMNS, LANES) of
    `measure`; what contradicts the fit loses its weight.
    """
    for block in range(len(columns)):
        first = block * LANES
        seen, measured = counts[first : first + LANES], columns[block]
        longest = 0
        for s in range(LANES):
            longest = max(longest, seen[s])
        _drop_short(measured, seen, longest)
        _accumulate(measured, longest, work)
        for model in range(MODELS - 1, -1, -1):
            _set_prior(size, end_std, first, model, work)
            _invert(work)
            _solve(work)
            roughest = model == MODELS - 1
            if roughest and _drop_outliers(measured, seen, longest, work) > 0:
                _drop_short(measured, seen, longest)
                _accumulate(measured, longest, work)
                _invert(work)
                _solve(work)
            _set_evidence(fits.evidence[model, first : first + LANES], work)
            _set_markers(basis, fits.deviation[model], fits.variance[model], first, work)


@kernel
def share_of_models(counts: Index, fits: Fits) -> None:
    """How likely each roughness is in this frame, by a few rounds of expectation maximisation, and
    what all of them together say of the markers.
    """
    evidence, share = fits.evidence, fits.share
    for s in range(len(counts)):
        top = evidence[0, s]
        for model in range(1, MODELS):
            top = max(top, evidence[model, s])
        for model in range(MODELS):
            evidence[model, s] = math.exp(evidence[model, s] - top) if counts[s] > 0 else 1.0
    for model in range(MODELS):
        share[model] = SHARE_BEFORE[model]
    for _ in range(EXPECTATION_ROUNDS):
        first, second, third = WEIGHT_BEFORE * SHARE_BEFORE
        total = WEIGHT_BEFORE
        for s in range(len(counts)):
            if counts[s] == 0:
                continue
            a = share[0] * evidence[0, s]
            b = share[1] * evidence[1, s]
            c = share[2] * evidence[2, s]
            scale = 1 / (a + b + c)
            first += a * scale
            second += b * scale
            third += c * scale
            total += 1.0
        share[0], share[1], share[2] = first / total, second / total, third / total
    _mix(fits)


@kernel_part(fastmath=NAN_SAFE)
def _mix(fits: Fits) -> None:
    """Mean and variance over the roughnesses."""
    deviation, variance, evidence, share, mean, spread = fits
    lanes = evidence.shape[1]
    for marker in range(len(mean)):
        for s in range(lanes):
            a, b = share[0] * evidence[0, s], share[1] * evidence[1, s]
            c = share[2] * evidence[2, s]
            x, y, z = deviation[0, marker, s], deviation[1, marker, s], deviation[2, marker, s]
            scale = 1 / (a + b + c)
            middle = (a * x + b * y + c * z) * scale
            square = a * (variance[0, marker, s] + x * x) + b * (variance[1, marker, s] + y * y)
            square += c * (variance[2, marker, s] + z * z)
            mean[marker, s] = middle
            spread[marker, s] = max(square * scale - middle * middle, 0.0)


@kernel_part(forceinline=True)
def true_std(variance: float, bias: float) -> float:
    """Standard deviation of a fit that has a variance in px^2, bias in px, with pixels shared."""
    return math.sqrt(SHARED_PIXELS_VARIANCE_RATIO * max(variance - bias * bias, variance / 4))


@kernel
def set_sizes(curve: Array, corner_std: Array, size: Array, end_std: Array) -> None:
    """Length and tilt (2, s) of the segments of curve (a, b, 4, 2); std (2, s) of their ends.

    corner_std (a, b+1).  Tilt: what a distance across the segment is along an image axis.
    """
    for i in range(curve.shape[0]):
        for j in range(curve.shape[1]):
            s = i * curve.shape[1] + j
            x = abs(curve[i, j, 1, 0] + curve[i, j, 2, 0] + curve[i, j, 3, 0])
            y = abs(curve[i, j, 1, 1] + curve[i, j, 2, 1] + curve[i, j, 3, 1])
            known = math.isfinite(x) and math.isfinite(y) and x + y > 0
            size[0, s] = math.hypot(x, y) if known else 1.0
            size[1, s] = size[0, s] / max(x, y) if known else 1.0
            end_std[0, s] = corner_std[i, j]
            end_std[1, s] = corner_std[i, j + 1]
