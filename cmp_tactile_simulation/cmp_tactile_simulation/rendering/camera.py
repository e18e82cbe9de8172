"""From the rendered pattern to the frame that a camera would give."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_simulation.rendering import Purpose, random_stream
from cmp_tactile_simulation.rendering.ink import DARK_GREY, LIGHT_GREY
from cmp_tactile_simulation.rendering.renderer import RenderedFrame

# Of a blur from the first of these on, px, the second is done before pixels integrate the light.
# The rest is quicker after it, where whole pixels would alias and move corners by 0.01 px alone.
WIDE_BLUR, BLUR_BEFORE = 1.5, 1.0
# Normal noise is drawn from so many numbers, all equally likely, from -4.3 to 4.3 standard
# deviations: that takes a fifth of the time.
NOISE_LEVELS = 1 << 16
WHITE = 255.0

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


def expose(
    frame: RenderedFrame,
    settings: CameraSettings,
    rng: np.random.Generator,
    seed: int = 0,
) -> NDArray[np.uint8]:
    """The camera's frame (height, width) of what was rendered.

    rng: noise of this frame.  seed: places of glare and clutter, the same in all frames.
    """
    image = _blurred(frame.grey, frame.fineness, settings.blur)
    _light(image, settings, _dirt(settings, image.shape, seed))
    return _digitised(image, settings, rng)


def _blurred(grey: NDArray[np.float32], fineness: int, sigma: float) -> NDArray[np.float32]:
    """Blurred by a lens, then integrated over the pixels: (height, width)."""
    before = sigma if sigma < WIDE_BLUR else BLUR_BEFORE
    after = math.sqrt(sigma**2 - before**2)
    weights = np.full(fineness, 1 / fineness)
    if before > 0:
        # As wide as OpenCV makes the kernel of such an image.
        size = round(8 * before * fineness + 1) | 1
        blur = cv2.getGaussianKernel(size, before * fineness)
        weights = np.convolve(np.asarray(blur)[:, 0], weights)
    image = _integrated(np.ascontiguousarray(grey), fineness, weights.astype(np.float32))
    if after > 0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), after), dtype=np.float32)
    return image


@kernel
def _integrated(
    grey: NDArray[np.float32], fineness: int, weights: NDArray[np.float32]
) -> NDArray[np.float32]:
    """The weighted means (height, width) about each pixel, of the same weights down and across.

    Entries beyond the frame's border are those as far on its other side.
    """
    height, width = grey.shape[0] // fineness, grey.shape[1] // fineness
    reach = (len(weights) - fineness) // 2
    image = np.zeros((height, width), np.float32)
    line = np.empty(grey.shape[1] + 2 * reach + fineness, np.float32)
    inner = line[reach : reach + grey.shape[1]]
    # Every entry of a pixel apart, so that the compiler does several pixels at once.
    apart = np.empty((fineness, len(line) // fineness), np.float32)
    for i in range(height):
        inner[:] = 0.0
        for k in range(len(weights)):
            row, weight = grey[_mirrored(fineness * i + k - reach, grey.shape[0])], weights[k]
            for j in range(len(inner)):
                inner[j] += weight * row[j]
        for k in range(reach):
            line[k] = inner[_mirrored(k - reach, len(inner))]
            line[reach + len(inner) + k] = inner[_mirrored(len(inner) + k, len(inner))]
        for n in range(fineness):
            for j in range(apart.shape[1]):
                apart[n, j] = line[fineness * j + n]
        out = image[i]
        for k in range(len(weights)):
            part, weight = apart[k % fineness, k // fineness :], weights[k]
            for j in range(width):
                out[j] += weight * part[j]
    return image


@kernel_part(forceinline=True)
def _mirrored(place: int, size: int) -> int:
    place = abs(place)
    return min(place, max(2 * size - 2 - place, 0))


class _Dirt(NamedTuple):
    """Share of the light that clutter lets through, and light of glare; (height, width) or None."""

    kept: NDArray[np.float32] | None
    glare: NDArray[np.float32] | None


def _dirt(settings: CameraSettings, shape: tuple[int, int], seed: int) -> _Dirt:
    clutter = _clutter(shape, settings.clutter, seed) if settings.clutter else None
    if not settings.glare_spots:
        return _Dirt(clutter, None)
    glare = _glare(shape, settings.glare_spots, settings.glare_size, seed)
    return _Dirt(clutter, settings.glare_strength * glare)


def _light(image: NDArray[np.float32], settings: CameraSettings, dirt: _Dirt) -> None:
    """Turn rendered greys into those of the settings' light, in place."""
    height, width = image.shape
    x, y = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)
    centre_x, centre_y = (width - 1) / 2, (height - 1) / 2
    radius2 = centre_x**2 + centre_y**2
    # Way across the frame along the light's direction, from 0 at its first corner to 1 at its last.
    along_x = x * math.cos(settings.light_direction)
    along_y = y * math.sin(settings.light_direction)
    least, most = along_x.min() + along_y.min(), along_x.max() + along_y.max()
    loss = (1 - 1 / settings.light_ratio) / max(most - least, 1e-9)
    contrast = (settings.light_level - settings.dark_level) / (LIGHT_GREY - DARK_GREY)
    _illuminate(
        image,
        (loss * along_x, 1 + loss * least - loss * along_y),
        tuple(settings.vignette * part**2 / radius2 for part in (x - centre_x, y - centre_y)),
        (contrast, settings.dark_level - contrast * DARK_GREY),
        *dirt,
    )


@kernel
def _illuminate(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    image: NDArray[np.float32],
    light: tuple[NDArray[np.float64], NDArray[np.float64]],
    vignette: tuple[NDArray[np.float64], NDArray[np.float64]],
    line: tuple[float, float],
    kept: NDArray[np.float32] | None,
    glare: NDArray[np.float32] | None,
) -> None:
    """Make of each grey, in place: light kept (contrast grey + offset) + glare.

    light, vignette: what columns (width,) take off of what rows (height,) have, and what both lose.
    """
    (by_x, by_y), (lost_x, lost_y), (contrast, offset) = light, vignette, line
    for i in range(image.shape[0]):
        row, even, lost = image[i], by_y[i], 1 - lost_y[i]
        for j in range(len(row)):
            here = (even - by_x[j]) * (lost - lost_x[j])
            if kept is not None:
                here *= kept[i, j]
            value = here * (contrast * row[j] + offset)
            if glare is not None:
                value += glare[i, j]
            row[j] = value


def _digitised(
    image: NDArray[np.float32], settings: CameraSettings, rng: np.random.Generator
) -> NDArray[np.uint8]:
    if settings.read_noise > 0:
        frame = _noisy(image, settings.read_noise, rng)
    else:
        # Rounded and saturated.
        frame = np.asarray(cv2.convertScaleAbs(image), np.uint8)
    if settings.salt_and_pepper > 0:
        struck = rng.random(frame.shape, dtype=np.float32) < settings.salt_and_pepper
        frame[struck] = rng.integers(0, 2, int(np.count_nonzero(struck))).astype(np.uint8) * 255
    return frame


def _noisy(image: NDArray[np.float32], sigma: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The image with normal noise, rounded and saturated."""
    # Each number that is drawn has the places of four pixels.
    drawn = rng.integers(1 << 64, size=-(-image.size // 4), dtype=np.uint64).view(np.uint16)
    frame = np.empty(image.shape, np.uint8)
    _add(image, np.float32(sigma) * _normal_levels(), drawn, frame)
    return frame


@lru_cache(maxsize=1)
def _normal_levels() -> NDArray[np.float32]:
    levels = ndtri((np.arange(NOISE_LEVELS) + 0.5) / NOISE_LEVELS)
    return np.asarray(levels / levels.std(), np.float32)


@kernel
def _add(
    image: NDArray[np.float32],
    levels: NDArray[np.float32],
    drawn: NDArray[np.uint16],
    frame: NDArray[np.uint8],
) -> None:
    width = image.shape[1]
    for i in range(image.shape[0]):
        for j in range(width):
            value = image[i, j] + levels[drawn[i * width + j]]
            frame[i, j] = int(min(max(value, 0.0), WHITE) + 0.5)


# What the camera makes of the light: a field for each way in which a real frame falls short.


@dataclass(frozen=True)
class CameraSettings(Parameters, section="camera"):
    """Light, lens, dirt and sensor noise.  Lengths in px of the frame, light in grey levels 0..255.

    The defaults are a good camera's: a little blur, vignetting and noise, nothing else.
    Raises InputError for a value outside its range.
    """

    light_level: float = parameter(
        205.0,
        "grey level of the light skin at its brightest place",
        unit="grey levels",
        within=(1, 1000),
    )
    dark_level: float = parameter(
        45.0,
        "grey level of the dark ink at its brightest place",
        unit="grey levels",
        within=(0, 1000),
    )
    light_ratio: float = parameter(
        1.0, "brightest over darkest illumination across the frame", within=(1, 100)
    )
    light_direction: float = parameter(
        0.0,
        "direction in which the light decreases, from the frame's x axis (right) towards y (down)",
        unit="rad",
        within=(-2 * math.pi, 2 * math.pi),
    )
    vignette: float = parameter(
        0.15,
        "share of the light that is lost in the frame's corners; the loss grows with the square "
        "of the distance from the centre",
        within=(0, 1),
    )
    blur: float = parameter(0.7, "standard deviation of the blur", unit="px", within=(0, 20))
    glare_spots: int = parameter(
        0, "number of glare spots; the seed sets their places", within=(0, 200)
    )
    glare_size: float = parameter(
        12.0, "standard deviation of a glare spot's light", unit="px", within=(0.5, 500)
    )
    glare_strength: float = parameter(
        400.0, "light at the centre of a glare spot", unit="grey levels", within=(0, 10000)
    )
    clutter: int = parameter(
        0,
        "number of dust grains and hairs on the optics; the seed sets their places",
        within=(0, 2000),
    )
    read_noise: float = parameter(
        1.0,
        "standard deviation of the noise",
        unit="grey levels",
        within=(0, 100),
    )
    salt_and_pepper: float = parameter(
        0.0,
        "share of the pixels that are white or black at random (salt and pepper)",
        within=(0, 1),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.dark_level < self.light_level:
            msg = (
                f"camera.dark_level: found {self.dark_level}, "
                f"expected less than light_level, {self.light_level}"
            )
            raise InputError(msg)


# What stays between the gel and the camera: glare, dust and hairs.


@lru_cache(maxsize=4)
def _glare(shape: tuple[int, int], count: int, size: float, seed: int) -> NDArray[np.float32]:
    """Light of round spots anywhere in a frame of that shape; 1 at a spot's centre."""
    (height, width), rng = shape, random_stream(Purpose.GLARE, seed)
    light = np.zeros(shape, dtype=np.float32)
    x, y = np.arange(width), np.arange(height)
    for _ in range(count):
        at_x, at_y = rng.uniform(0, width), rng.uniform(0, height)
        across = np.exp(-((x - at_x) ** 2) / (2 * size**2))
        down = np.exp(-((y - at_y) ** 2) / (2 * size**2))
        light += np.outer(down, across).astype(np.float32)
    return light


@lru_cache(maxsize=4)
def _clutter(shape: tuple[int, int], count: int, seed: int) -> NDArray[np.float32]:
    """Share of the light that grains and hairs anywhere on the optics let through."""
    kept, rng = np.ones(shape, dtype=np.float32), random_stream(Purpose.CLUTTER, seed)
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
    return np.asarray(cv2.GaussianBlur(kept, (0, 0), CLUTTER_BLUR), dtype=np.float32)


def _hair(middle: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Points (n, 2) px of an arc that passes the middle."""
    length, turn = rng.uniform(*HAIR_LENGTH), rng.uniform(-2.5, 2.5)
    share = np.linspace(-0.5, 0.5, HAIR_POINTS)
    heading = rng.uniform(0, 2 * np.pi) + turn * share
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=-1) * length / HAIR_POINTS
    points = np.cumsum(steps, axis=0)
    return np.asarray(middle + points - points[HAIR_POINTS // 2])
