"""From the rendered pattern to the frame that a camera would give."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_simulation.rendering.camera_settings import CameraSettings
from cmp_tactile_simulation.rendering.ink import DARK_GREY, LIGHT_GREY
from cmp_tactile_simulation.rendering.optics_dirt import clutter_transmission, glare_light
from cmp_tactile_simulation.rendering.random_streams import Purpose, random_stream
from cmp_tactile_simulation.rendering.renderer import RenderedFrame

__all__ = ["expose"]

WHITE = 255.0
# Blur that varies across the frame is mixed from levels this far apart, px, but not from more.
BLUR_STEP = 0.3
MOST_LEVELS = 16
# From this blur on, px, it makes no difference to blur whole pixels, and it is quicker.
BLUR_IN_PIXELS = 1.2
# Fixed, so that the noise is the same on every machine.
NOISE_STREAMS = 4


def expose(
    frames: Sequence[RenderedFrame],
    settings: CameraSettings,
    rng: np.random.Generator,
    seed: int = 0,
) -> NDArray[np.uint8]:
    """The camera's frame (height, width) of what was rendered while the shutter was open.

    rng: noise of this frame.  seed: places of glare and clutter, the same in all frames.
    Raises FrameError without frames or for frames of different sizes.
    """
    grey, fineness = _mean(frames)
    image = _through_lens(grey, fineness, settings)
    optics = _optics(settings, image.shape, seed)
    image *= optics.gain
    image += optics.glow
    return _digitised(image, settings, rng)


def _mean(frames: Sequence[RenderedFrame]) -> tuple[NDArray[np.float32], int]:
    if not frames or any(
        frame.grey.shape != frames[0].grey.shape or frame.fineness != frames[0].fineness
        for frame in frames
    ):
        found = ", ".join(f"{frame.grey.shape}" for frame in frames) or "none"
        msg = f"rendered frames: found {found}, expected one or more of the same size"
        raise FrameError(msg)
    if len(frames) == 1:
        return frames[0].grey, frames[0].fineness
    total = np.zeros_like(frames[0].grey)
    for frame in frames:
        total += frame.grey
    return total / np.float32(len(frames)), frames[0].fineness


def _through_lens(
    grey: NDArray[np.float32], fineness: int, settings: CameraSettings
) -> NDArray[np.float32]:
    """Blurred, then integrated over the pixels: (height, width)."""
    if settings.defocus == 0:
        return _blurred(grey, fineness, settings.blur)
    shape = grey.shape[0] // fineness, grey.shape[1] // fineness
    image: NDArray[np.float32] = np.zeros(shape, dtype=np.float32)
    for sigma, share in _blur_levels(shape, settings):
        image += share * _blurred(grey, fineness, sigma)
    return image


def _blurred(grey: NDArray[np.float32], fineness: int, sigma: float) -> NDArray[np.float32]:
    before = 0 < sigma < BLUR_IN_PIXELS
    if before:
        grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma * fineness), dtype=np.float32)
    if fineness > 1:
        size = grey.shape[1] // fineness, grey.shape[0] // fineness
        small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        grey = np.asarray(small, dtype=np.float32)
    if sigma > 0 and not before:
        grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma), dtype=np.float32)
    return np.array(grey, dtype=np.float32)


def _along(shape: tuple[int, ...], direction: float) -> NDArray[np.float64]:
    """Way across the frame along a direction, from 0 at its first corner to 1 at its last."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    way = x * math.cos(direction) + y * math.sin(direction)
    return np.asarray((way - way.min()) / max(float(np.ptp(way)), 1e-9))


@lru_cache(maxsize=2)
def _blur_levels(
    shape: tuple[int, int], settings: CameraSettings
) -> list[tuple[float, NDArray[np.float32]]]:
    """Blurs, px, and the share that each has at each pixel."""
    focus = settings.focus_position
    off = np.abs(_along(shape, settings.focus_direction) - focus) / max(focus, 1 - focus)
    variance = settings.blur**2 + (settings.defocus * off) ** 2
    low, high = math.sqrt(float(variance.min())), math.sqrt(float(variance.max()))
    count = min(MOST_LEVELS, max(2, math.ceil((high - low) / BLUR_STEP) + 1))
    levels = np.linspace(low, high, count)
    # A mixture of two Gaussians has the mean of their variances.
    return [
        (float(sigma), np.interp(variance, levels**2, chosen).astype(np.float32))
        for sigma, chosen in zip(levels, np.eye(count), strict=True)
    ]


@dataclass(frozen=True)
class _Optics:
    """What light and dirt make of a rendered grey: grey * gain + glow, (height, width)."""

    gain: NDArray[np.float32]
    glow: NDArray[np.float32]


@lru_cache(maxsize=4)
def _optics(settings: CameraSettings, shape: tuple[int, int], seed: int) -> _Optics:
    height, width = shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    centre_x, centre_y = (width - 1) / 2, (height - 1) / 2
    radius2 = ((x - centre_x) ** 2 + (y - centre_y) ** 2) / (centre_x**2 + centre_y**2)
    light = 1 - (1 - 1 / settings.light_ratio) * _along(shape, settings.light_direction)
    light *= 1 - settings.vignette * radius2
    # Apart, so that more glare leaves the clutter where it is.
    glare_rng, clutter_rng = (
        random_stream(purpose, seed) for purpose in (Purpose.GLARE, Purpose.CLUTTER)
    )
    light *= clutter_transmission(shape, settings.clutter, clutter_rng)
    glare = glare_light(shape, settings.glare_spots, settings.glare_size, glare_rng)
    contrast = (settings.light_level - settings.dark_level) / (LIGHT_GREY - DARK_GREY)
    glow = light * (settings.dark_level - contrast * DARK_GREY) + settings.glare_strength * glare
    return _Optics((light * contrast).astype(np.float32), glow.astype(np.float32))


def _digitised(
    image: NDArray[np.float32], settings: CameraSettings, rng: np.random.Generator
) -> NDArray[np.uint8]:
    if settings.read_noise > 0 or settings.full_well > 0:
        noise = _normal(image.shape, rng)
        if settings.full_well > 0:
            # So many electrons that Poisson's distribution is a normal one.
            variance = image.clip(0) * np.float32(WHITE / settings.full_well)
            noise *= np.sqrt(variance + np.float32(settings.read_noise**2))
        else:
            noise *= np.float32(settings.read_noise)
        image = image + noise
    frame = np.rint(image).clip(0, WHITE).astype(np.uint8)
    if settings.salt_and_pepper > 0:
        struck = rng.random(frame.shape, dtype=np.float32) < settings.salt_and_pepper
        frame[struck] = rng.integers(0, 2, int(np.count_nonzero(struck))).astype(np.uint8) * 255
    return frame


def _normal(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float32]:
    """Standard normal numbers, drawn by several threads from streams of their own."""
    noise = np.empty(shape, dtype=np.float32)
    streams = [np.random.default_rng(seed) for seed in rng.integers(0, 2**63, NOISE_STREAMS)]
    parts = np.array_split(noise, NOISE_STREAMS)
    list(_noise_pool().map(_fill, streams, parts))
    return noise


def _fill(stream: np.random.Generator, part: NDArray[np.float32]) -> None:
    stream.standard_normal(dtype=np.float32, out=part)


@lru_cache(maxsize=1)
def _noise_pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(NOISE_STREAMS, thread_name_prefix="camera noise")
