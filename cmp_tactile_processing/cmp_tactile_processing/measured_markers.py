"""Measured markers: sub-pixel corners of a numbered grid, and corners that the outlines missed."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.saddle_point import SaddlePoints, refine_saddle_points

__all__ = ["complete_corners", "refine_corners", "window_radius"]

# Shares of the local checker side: how far refinement may move a stitched corner, and how far a
# corner may lie from where its neighbours predict it.
REFINE_REACH, COMPLETE_REACH = 0.3, 0.25
# Where the rim of something that hides the gel crosses a gridline, there is a saddle too.  It is
# weaker or stronger than those around it, or its contours run askew of the gridlines.  Of corners
# in sight, 99.9 % stay within 0.73 to 1.2 of their neighbours' strength, even at noise of 16 grey
# levels or on a worn print, and 99.9 % below a skew of 0.2 (0.48 on the worn print).
WEAKEST_SADDLE, STRONGEST_SADDLE = 0.65, 1.4
LARGEST_SKEW = 0.4
MAX_ROUNDS = 8


def window_radius(side_px: float) -> int:
    """Radius of the saddle-point fit for checkers of that side, px."""
    return int(np.clip(round(0.18 * side_px), 2, 6))


def refine_corners(
    smooth: NDArray[np.float32], corners: NDArray[np.float64], side_px: float, first_even: bool
) -> NDArray[np.float64]:
    """Saddle points near corners (rows, cols, 2) px; NaN where there is none of the right sign.

    first_even: dark checkers touch corner (0, 0) along the diagonal (-, -) to (+, +).
    """
    flat = corners.reshape(-1, 2)
    saddles = refine_saddle_points(smooth, flat, window_radius(side_px), REFINE_REACH * side_px)
    good = _right_saddles(saddles, corners, first_even)
    return np.where(good[..., None], saddles.position.reshape(corners.shape), np.nan)


def complete_corners(
    smooth: NDArray[np.float32], corners: NDArray[np.float64], side_px: float, first_even: bool
) -> NDArray[np.float64]:
    """Fill missing corners (rows, cols, 2) from the image, outwards from those that are known.

    A corner is looked for where its neighbours along the gridlines put it, and taken only if
    there is a saddle of the right sign close by: nothing is invented where the grid is hidden.
    """
    corners = corners.copy()
    tried = np.zeros(corners.shape[:2], dtype=bool)
    for _ in range(MAX_ROUNDS):
        guess = _predicted(corners)
        wanted = np.isnan(corners[..., 0]) & np.isfinite(guess[..., 0]) & ~tried
        if not wanted.any():
            break
        tried |= wanted
        saddles = refine_saddle_points(
            smooth, guess[wanted], window_radius(side_px), COMPLETE_REACH * side_px
        )
        candidate = corners.copy()
        candidate[wanted] = saddles.position
        found = refine_corners(smooth, candidate, side_px, first_even)
        corners[wanted] = found[wanted]
        # A corner next to a newly found one has a better prediction than before.
        tried &= ~_beside(wanted & np.isfinite(corners[..., 0]))
    return corners


def _beside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    near = np.zeros_like(mask)
    for reach in (1, 2):
        near[reach:] |= mask[:-reach]
        near[:-reach] |= mask[reach:]
        near[:, reach:] |= mask[:, :-reach]
        near[:, :-reach] |= mask[:, reach:]
    return near


def _right_saddles(
    saddles: SaddlePoints, corners: NDArray[np.float64], first_even: bool
) -> NDArray[np.bool_]:
    """Whether each saddle is that of a corner in sight with the number that it bears.

    Its surface must bend down along the diagonal of the dark checkers, by as much as around it,
    and be straight along both gridlines.
    """
    rows, cols = corners.shape[:2]
    row_step, col_step = (step.reshape(-1, 2) for step in _steps(corners))
    bend = _curvature(saddles, row_step - col_step) - _curvature(saddles, row_step + col_step)
    i, j = np.divmod(np.arange(rows * cols), cols)
    strength = np.where(((i + j) % 2 == 0) == first_even, bend, -bend).reshape(rows, cols)
    along = np.maximum(
        np.abs(_curvature(saddles, row_step)), np.abs(_curvature(saddles, col_step))
    ).reshape(rows, cols)
    if not np.isfinite(strength).any():
        return np.zeros((rows, cols), dtype=bool)
    relative = strength / _around(strength)
    with np.errstate(invalid="ignore"):
        good = (relative > WEAKEST_SADDLE) & (relative < STRONGEST_SADDLE)
        return np.asarray(good & (along < LARGEST_SKEW * strength))


def _around(strength: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median strength of the 5 x 5 saddles around each one; light may differ across the view."""
    size = np.abs(strength)
    filled = np.where(np.isnan(size), np.nanmedian(size), size)
    return np.asarray(cv2.medianBlur(filled.astype(np.float32), 5), dtype=np.float64)


def _curvature(saddles: SaddlePoints, direction: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).T
    hxx, hxy, hyy = saddles.hessian.T
    return np.asarray(hxx * x * x + 2 * hxy * x * y + hyy * y * y)


def _steps(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Local steps along i and j, (rows, cols, 2) px each, from whichever neighbours are known."""
    results = []
    for axis in (0, 1):
        step = np.diff(corners, axis=axis)
        pad = np.full_like(np.take(corners, [0], axis=axis), np.nan)
        before = np.concatenate([pad, step], axis=axis)
        after = np.concatenate([step, pad], axis=axis)
        one = np.where(np.isnan(before), after, before)
        known = np.where(np.isnan(after), one, (one + after) / 2)
        lonely = np.isnan(known[..., 0])
        if lonely.any():
            seen = ~np.isnan(step[..., 0])
            known[lonely] = np.median(step[seen], axis=0) if seen.any() else np.nan
        results.append(known)
    return results[0], results[1]


def _predicted(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over both gridlines of where the neighbours put each corner; NaN where they cannot."""
    rows, cols = corners.shape[:2]
    padded = np.full((rows + 4, cols + 4, 2), np.nan)
    padded[2:-2, 2:-2] = corners

    def shifted(di: int, dj: int) -> NDArray[np.float64]:
        return padded[2 + di : 2 + di + rows, 2 + dj : 2 + dj + cols]

    guesses = []
    for di, dj in ((1, 0), (0, 1)):
        before, after = shifted(-di, -dj), shifted(di, dj)
        guesses += [
            (before + after) / 2,
            2 * before - shifted(-2 * di, -2 * dj),
            2 * after - shifted(2 * di, 2 * dj),
        ]
    stack = np.stack(guesses)
    count = np.isfinite(stack).sum(axis=0)
    with np.errstate(invalid="ignore"):
        return np.where(count > 0, np.nansum(stack, axis=0) / np.maximum(count, 1), np.nan)
