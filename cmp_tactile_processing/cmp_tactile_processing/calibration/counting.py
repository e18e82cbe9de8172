"""Counts the checkers in a picture without knowing the sensor, and judges the picture.

Size and direction of the checkers are read from the picture's spectrum, which needs no knowledge of
either; then the tracker counts the corners.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.image.prepared import Prefilter
from cmp_tactile_processing.sensor import parts
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.dots import DotReading, read_dots
from cmp_tactile_processing.tracking.image_fault import SATURATED, image_fault
from cmp_tactile_processing.tracking.numbering.pattern_border import border_sides
from cmp_tactile_processing.tracking.tracker import GridTracker

Float = NDArray[np.float64]
Image = NDArray[np.uint8]

# Of a larger picture the spectrum is that of a smaller one, of so many px at most along a side;
# light that changes over so many px of that is taken out.
SAMPLES, LIGHT_PX = 1024, 25.0
# Checkers are looked for from this many px a side to a quarter of the picture; of those that are
# larger than such a share too few are in sight.
SMALLEST_SIDE_PX, LARGEST_SHARE = 4.0, 1 / 7
# The second direction of the diagonals is across the first one to so many degrees, and as long to
# such a share.
ACROSS_DEG, AS_LONG = 25.0, 0.4
# A line of corners counts where so large a share of it is seen.
LEAST_SEEN = 0.5
# Fewer corners may be there by chance.
FEWEST_CORNERS = 36
# The camera that looks for the corners: any will do.
ANGLE_DEG, PITCH_M = 60.0, 1e-3
# What is not to be seen in a picture.
THICKNESS_M, SKIN_M, YOUNG_PA, POISSON, RIM = 0.005, 0.0003, 5e5, 0.48, 4
# Grey levels are compared so near to an edge; pixels and the interpolation between them blur it by
# a variance of a twelfth and a sixth of a square pixel.
NEAR_PX, SAMPLING_PX2 = 0.5, 0.25
# Blurs of which the share near an edge is known, in sides, and harmonics of the checkers.
BLURS, HARMONICS = np.geomspace(5e-3, 1.0, 200), np.arange(1, 200, 2)
# Standard deviations of a corner were measured on pictures drawn with known blur, noise and
# contrast: below FLOOR_PX they do not fall; the rest is proportional to noise, to 1 / contrast, to
# blur^2 + BLUR_PX^2 and, in units of the pitch, to side^-1.5.
FLOOR_PX, BLUR_PX = 0.003, 1.37

MOST_SATURATED = 0.02
ADVICE = {
    "blur_px": "out of focus or motion blur: adjust the focus, or shorten the exposure",
    "contrast": "low contrast: add light, or print with more black",
    "noise": "noise: add light and reduce the gain",
    "side_px": "small checkers: move the camera closer, or print larger checkers",
}


@dataclass(frozen=True)
class MarkerQuality:
    """How well a picture shows the corners of checkers.

    side_px: of a checker.  blur_px: standard deviation of the blur of the edges that are blurred
    more, along rows or columns, beyond that of the pixels.  contrast: grey levels between light and
    dark checkers.  saturated: share of the light checkers at the end of the scale.  noise: grey
    levels.  std_px: median standard deviation of a corner.
    """

    side_px: float
    blur_px: float
    contrast: float
    saturated: float
    noise: float
    std_px: float

    @property
    def std_pitch(self) -> float:
        """Standard deviation of a corner in units of the pitch."""
        return self.std_px / self.side_px

    def std_if(self, name: str) -> float:
        """`std_pitch` if one of side_px, blur_px, contrast and noise were as in GOOD."""
        good, floor = getattr(GOOD, name), min(FLOOR_PX, self.std_px)
        share = {
            "side_px": (self.side_px / good) ** 1.5,
            "blur_px": (good**2 + BLUR_PX**2) / (self.blur_px**2 + BLUR_PX**2),
            "contrast": self.contrast / good,
            "noise": good / max(self.noise, good),
        }[name]
        left = np.sqrt(self.std_px**2 - floor**2) * min(share, 1.0)
        if name == "side_px":
            floor *= min(self.side_px / good, 1.0)
        return float(np.hypot(floor, left)) / self.side_px

    def advice(self, least_gain: float) -> list[str]:
        """What to change, what costs most first.

        least_gain: share of the standard deviation that a change must be able to take off.
        """
        gains = {name: 1 - self.std_if(name) / self.std_pitch for name in ADVICE}
        costly = sorted(gains, key=lambda name: -gains[name])
        texts = [ADVICE[name] for name in costly if gains[name] >= least_gain]
        if self.saturated > MOST_SATURATED:
            return [
                f"{self.saturated:.0%} of the light checkers are overexposed: reduce the light",
                *texts,
            ]
        return texts


# A good picture, as a webcam can take it.
GOOD = MarkerQuality(
    side_px=16.0, blur_px=0.6, contrast=180.0, saturated=0.0, noise=1.5, std_px=FLOOR_PX
)


@dataclass(frozen=True)
class Sighting:
    """A pattern in an image.

    corners (rows, cols, 2) px: rows downwards, columns to the right, NaN where one is not seen;
    even: whether the dark checkers touch corner (0, 0) along the diagonal (-, -) to (+, +); ends:
    whether the pattern does above the first row, below the last, left of the first column and
    right of the last one; dots: of the checkers around the corners.
    """

    corners: Float
    even: bool
    ends: tuple[bool, ...]
    quality: MarkerQuality
    dots: DotReading

    @property
    def size_text(self) -> str:
        """How many corners."""
        return f"{self.corners.shape[0]} x {self.corners.shape[1]} corners"

    def mirrored(self, width: int) -> Sighting:
        """The same in the mirrored image, of so many px, with rows upwards and columns to the left:
        the next corner of a row, or column, is where it was in the image.
        """
        corners = self.corners[::-1].copy()
        corners[..., 0] = width - 1 - corners[..., 0]
        above, below, left, right = self.ends
        even = self.even == (len(corners) % 2 == 0)
        dots = replace(self.dots, bits=self.dots.bits[::-1])
        return replace(
            self, corners=corners, even=even, ends=(below, above, left, right), dots=dots
        )

    def turned(self, quarters: int) -> Sighting:
        """The same with its rows and columns turned as `np.rot90` does."""
        seen = self
        for _ in range(quarters % 4):
            above, below, left, right = seen.ends
            seen = replace(
                seen,
                corners=np.rot90(seen.corners),
                even=seen.even == (seen.corners.shape[1] % 2 == 0),
                ends=(right, left, above, below),
                dots=replace(seen.dots, bits=np.rot90(seen.dots.bits)),
            )
        return seen


def count_corners(image: Image, name: str = "picture") -> Sighting:
    """The pattern in an image (H, W) uint8.

    Raises FrameError, which begins with the name, where no checkers are seen, or too few.
    """
    fault, reason = image_fault(image)
    if fault:
        msg = f"{name}: found it {reason}, expected checkers"
        raise FrameError(msg)
    step = lattice_step(image, name)
    side, largest = float(np.linalg.norm(step)), LARGEST_SHARE * min(image.shape)
    if side > largest:
        msg = (
            f"{name}: found checkers of {side:.0f} px, expected at most {largest:.0f}: move the "
            "camera away"
        )
        raise FrameError(msg)
    wide = _wide_description(image, step)
    grid = GridTracker(wide).track(image)
    known = np.isfinite(grid.corners[..., 0])
    if np.count_nonzero(known) < FEWEST_CORNERS:
        msg = (
            f"{name}: found {np.count_nonzero(known)} corners of checkers of {side:.0f} px "
            f"({grid.reason}), expected at least {FEWEST_CORNERS}: make the pattern sharp, evenly "
            "lit, nearly upright and as large as possible in the picture"
        )
        raise FrameError(msg)
    part = _part_with_corners(known)
    corners, dark = grid.corners[part], wide.pattern.corner_checker == "dark"
    even = dark == ((part[0].start + part[1].start) % 2 == 0)
    prepared = Prefilter(image.shape, side).prepare(image)
    sides = border_sides(prepared, corners, even, corners.shape[:2])
    std = np.nan if grid.corner_std is None else float(np.nanmedian(grid.corner_std))
    worth = _marker_quality(prepared.grey, corners, even, (prepared.noise, std))
    dots = read_dots(prepared, corners, even)
    return Sighting(corners, even, tuple(item.ends for item in sides), worth, dots)


def lattice_step(image: Image, name: str = "picture") -> Float:
    """The way, (2,) px, from a corner to the next one along the rows of a checkerboard.

    A checkerboard's strongest waves run along the diagonals of its checkers; the sum of two that
    cross is the wave along its rows.  Raises FrameError where there are none.
    """
    grey = image.astype(np.float32)
    shrunk = min(1.0, SAMPLES / max(image.shape))
    if shrunk < 1:
        grey = np.asarray(
            cv2.resize(grey, None, fx=shrunk, fy=shrunk, interpolation=cv2.INTER_AREA)
        )
    grey -= cv2.GaussianBlur(grey, (0, 0), LIGHT_PX)
    window = np.outer(np.hanning(grey.shape[0]), np.hanning(grey.shape[1]))
    power = np.abs(np.fft.rfft2(grey * window, (SAMPLES, SAMPLES)))
    fy, fx = np.fft.fftfreq(SAMPLES)[:, None], np.fft.rfftfreq(SAMPLES)[None]
    length = np.hypot(fx, fy)
    longest = np.sqrt(0.5) / SMALLEST_SIDE_PX
    shortest = np.sqrt(0.5) / (min(grey.shape) / 4)
    power[(length < shortest) | (length > longest)] = 0.0
    power = cv2.GaussianBlur(power, (0, 0), 2.0)

    def strongest(allowed: NDArray[np.bool_]) -> Float:
        y, x = np.unravel_index(np.where(allowed, power, 0.0).argmax(), power.shape)
        return np.array([fx[0, x], fy[y, 0]])

    first = strongest(np.ones_like(power, dtype=bool))
    size = float(np.hypot(*first))
    if not size:
        msg = f"{name}: found no repeating pattern, expected checkers"
        raise FrameError(msg)
    along = (fx * first[0] + fy * first[1]) / np.maximum(length * size, 1e-12)
    across = np.abs(along) < np.sin(np.radians(ACROSS_DEG))
    second = strongest(across & (np.abs(length / size - 1) < AS_LONG))
    # Of the two waves along the sides of the checkers the one that is nearer to the x axis.
    waves = np.array([first + second, first - second])
    wave = waves[np.abs(waves[:, 0]).argmax()]
    wave = wave if wave[0] > 0 else -wave
    return np.asarray(wave / (wave @ wave) / shrunk)


def _wide_description(image: Image, step: Float) -> SensorDescription:
    """A description that numbers all corners there may be, looking straight at the pattern."""
    height, width = image.shape
    side, focal = float(np.linalg.norm(step)), focal_px(width, ANGLE_DEG)
    rows, cols = (min(int(extent / side) + 1, parts.MAX_BEYOND_VIEW) for extent in image.shape)
    cosine, sine = step / side
    pose = np.eye(4)
    pose[:2, :2] = [[cosine, -sine], [sine, cosine]]
    pose[2, 3] = focal * PITCH_M / side
    centre = (width - 1) / 2, (height - 1) / 2
    pattern = parts.Pattern(
        rows, cols, PITCH_M, "dark", 2, parts.PatternSurface(), border="beyond_view"
    )
    return SensorDescription(
        name="picture",
        image=parts.ImageSize(width, height),
        camera=parts.Camera("pinhole", focal, focal, *centre, (0.0,) * 5),
        optics=parts.Optics("monocular", pose, ()),
        views={"left": parts.ViewDescription(parts.Roi(0, 0, width, height))},
        pattern=pattern,
        elastomer=assumed_elastomer(pattern),
    )


def assumed_elastomer(pattern: parts.Pattern) -> parts.Elastomer:
    """A gel with a rim around the pattern, of a usual thickness and stiffness."""
    width, height = (
        round((count + RIM) * pattern.pitch, 9) for count in (pattern.cols, pattern.rows)
    )
    layer = parts.ShadingLayer(SKIN_M, YOUNG_PA)
    size = width, height, THICKNESS_M
    return parts.Elastomer(size, YOUNG_PA, POISSON, "linear", layer)


def focal_px(width: int, angle: float) -> float:
    """Focal length, px, for an angle of view, degrees, over a width, px."""
    return float(round(width / 2 / np.tan(np.radians(angle) / 2), 1))


def _part_with_corners(known: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns between the outermost that are seen along most of their length."""
    found = []
    for axis in (1, 0):
        count = known.sum(axis=axis)
        lines = np.flatnonzero(count >= LEAST_SEEN * count.max())
        found.append(slice(int(lines[0]), int(lines[-1]) + 1))
    return found[0], found[1]


def _marker_quality(
    grey: Image, corners: Float, even: bool, known: tuple[float, float]
) -> MarkerQuality:
    """known: noise, grey levels, and the standard deviation of a corner, px."""
    side, blur, contrast, light = [], [], [], []
    for lattice in (corners, corners.swapaxes(0, 1)):
        step, found, levels = _edges(grey, lattice, even)
        side.append(step)
        blur.append(found)
        contrast.append(float(np.nanmean(levels[1] - levels[0])))
        light.append(levels[1])
    bright = np.concatenate([levels.ravel() for levels in light])
    saturated = float(np.mean(bright[np.isfinite(bright)] >= SATURATED))
    noise, std = known
    return MarkerQuality(
        float(np.mean(side)), max(blur), float(np.mean(contrast)), saturated, noise, std
    )


def _edges(grey: Image, lattice: Float, even: bool) -> tuple[float, float, Float]:
    """Of the edges between neighbours along j: side and blur, px; grey levels (2, R, C - 1) in the
    middles of the dark and light checkers beside them, NaN where unknown.

    The share of the contrast at a small distance from an edge grows with the blur's square root of
    variance: it is that of a square wave with Gaussian blur.
    """
    rows, cols = lattice.shape[:2]
    middle = (lattice[:, :-1] + lattice[:, 1:]) / 2
    along, steps = np.diff(lattice, axis=1), np.gradient(lattice, axis=0)
    across = (steps[:, :-1] + steps[:, 1:]) / 2
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    apart = (normal * across).sum(axis=-1)
    # Beyond an even corner the checker at (+, +) is dark.
    dark = np.where((np.indices((rows, cols - 1)).sum(axis=0) % 2 == 0) == even, 1.0, -1.0)
    near = NEAR_PX * (np.sign(apart) * dark)[..., None] * normal
    far = 0.5 * dark[..., None] * across
    q = np.stack([middle + near, middle - near, middle + far, middle - far])
    places = np.nan_to_num(q[..., ::-1], nan=-1.0)
    levels = map_coordinates(
        grey, np.moveaxis(places, -1, 0), output=np.float64, order=1, cval=np.nan
    )
    whole = np.nanmean(levels[3] - levels[2])
    side = float(np.nanmedian(np.abs(apart)))
    share = np.nanmean(levels[1] - levels[0]) / whole if whole > 0 else 0.0
    expected = _square_wave(NEAR_PX / side) / _square_wave(0.5)
    blur = side * float(np.interp(-share, -expected, BLURS))
    return side, float(np.sqrt(max(blur**2 - SAMPLING_PX2, 0.0))), levels[2:]


def _square_wave(place: float) -> Float:
    """A square wave of period 2 after each of BLURS, so far from an edge; all in sides."""
    waves = np.pi * HARMONICS
    kept = np.exp(-0.5 * (waves * BLURS[:, None]) ** 2)
    return np.asarray((kept * np.sin(waves * place) * 4 / waves).sum(axis=1))
