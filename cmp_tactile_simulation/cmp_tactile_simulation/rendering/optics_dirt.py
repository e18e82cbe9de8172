"""What lies between the gel and the camera and stays there: glare, dust and hairs."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["clutter_transmission", "glare_light"]

# Dust grains: radius, px.  Hairs: length and width, px.
GRAIN_RADIUS = (1.5, 6.0)
HAIR_LENGTH = (40.0, 200.0)
HAIR_WIDTH = (1, 2)
HAIR_POINTS = 24
# Share of the light that one keeps, and the blur of what is not in focus, px.
KEPT_LIGHT = (0.2, 0.7)
CLUTTER_BLUR = 1.5
# cv2 draws at fractions of a pixel of 2^-SHIFT.
SHIFT = 4


def glare_light(
    shape: tuple[int, int], count: int, size: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Light of round spots anywhere in a frame of that shape; 1 at a spot's centre."""
    height, width = shape
    light = np.zeros(shape, dtype=np.float32)
    x, y = np.arange(width), np.arange(height)
    for _ in range(count):
        at_x, at_y = rng.uniform(0, width), rng.uniform(0, height)
        across = np.exp(-((x - at_x) ** 2) / (2 * size**2))
        down = np.exp(-((y - at_y) ** 2) / (2 * size**2))
        light += np.outer(down, across).astype(np.float32)
    return light


def clutter_transmission(
    shape: tuple[int, int], count: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Share of the light that grains and hairs anywhere on the optics let through."""
    kept = np.ones(shape, dtype=np.float32)
    for _ in range(count):
        mask = np.zeros(shape, dtype=np.uint8)
        centre = rng.uniform(0, 1, 2) * shape[::-1]
        if rng.random() < 0.5:
            radius = rng.uniform(*GRAIN_RADIUS)
            at_x, at_y = (round(value * 2**SHIFT) for value in centre)
            cv2.circle(mask, (at_x, at_y), round(radius * 2**SHIFT), 255, -1, cv2.LINE_AA, SHIFT)
        else:
            points = np.rint(_hair(centre, rng) * 2**SHIFT).astype(np.int32)
            width = int(rng.integers(HAIR_WIDTH[0], HAIR_WIDTH[1] + 1))
            cv2.polylines(mask, [points], False, 255, width, cv2.LINE_AA, SHIFT)
        kept *= 1 - (1 - rng.uniform(*KEPT_LIGHT)) * (mask.astype(np.float32) / 255)
    if count:
        kept = np.asarray(cv2.GaussianBlur(kept, (0, 0), CLUTTER_BLUR), dtype=np.float32)
    return kept


def _hair(middle: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Points (n, 2) px of an arc that passes the middle."""
    length, turn = rng.uniform(*HAIR_LENGTH), rng.uniform(-2.5, 2.5)
    share = np.linspace(-0.5, 0.5, HAIR_POINTS)
    heading = rng.uniform(0, 2 * np.pi) + turn * share
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=-1) * length / HAIR_POINTS
    points = np.cumsum(steps, axis=0)
    return np.asarray(middle + points - points[HAIR_POINTS // 2])
