"""View images in which no grid may be found: the sensor is not the one that is described."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["bad_views", "misdescribed"]


def bad_views(view: NDArray[np.uint8], seed: int = 0) -> Mapping[str, NDArray[np.uint8]]:
    """Images of the size of a good view image, (height, width), that show no pattern as it is.

    "two patterns" shows the good one twice and smaller; "mirrored" what a wrong flip gives.
    """
    rng = np.random.default_rng(seed)
    height, width = view.shape
    small = view[::2, ::2]
    twice = np.full_like(view, int(np.median(view)))
    twice[: small.shape[0], : small.shape[1]] = small
    twice[height - small.shape[0] :, width - small.shape[1] :] = small
    stripes = np.indices(view.shape)[1] // 12 % 2 * 160 + 45
    return {
        "black": np.zeros_like(view),
        "white": np.full_like(view, 255),
        "grey": np.full_like(view, 128),
        "saturated": np.minimum(view.astype(np.int64) * 20 + 250, 255).astype(np.uint8),
        "noise": rng.integers(0, 256, view.shape).astype(np.uint8),
        "stripes": stripes.astype(np.uint8),
        "mirrored": np.ascontiguousarray(view[:, ::-1]),
        "upside down": np.ascontiguousarray(view[::-1]),
        "turned": np.ascontiguousarray(view[::-1, ::-1]),
        "inverted": 255 - view,
        "two patterns": twice,
    }


def misdescribed(sensor: SensorDescription) -> Mapping[str, SensorDescription]:
    """Descriptions of the same rig with a pattern of another size or the other colours."""
    pattern = sensor.pattern
    sizes = {
        f"{rows} x {cols} expected": (rows, cols)
        for rows, cols in (
            (pattern.rows - 1, pattern.cols),
            (pattern.rows, pattern.cols - 2),
            (pattern.rows - 2, pattern.cols - 2),
            (pattern.rows + 1, pattern.cols + 1),
            (pattern.rows + 2, pattern.cols),
        )
    }
    found = {
        name: replace(sensor, pattern=replace(pattern, rows=rows, cols=cols))
        for name, (rows, cols) in sizes.items()
    }
    other = "light" if pattern.corner_checker == "dark" else "dark"
    found["other colours expected"] = replace(
        sensor, pattern=replace(pattern, corner_checker=other)
    )
    return found
