"""A first description of a sensor, from one picture of its pattern at rest.

Size and direction of the checkers are read from the picture's spectrum, which needs no knowledge of
either; then the tracker counts the corners.  Where the camera is follows from these and an assumed
angle of view: in the plane of the pattern the scale is right whatever that is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.image.prefilter import Prefilter
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor import parts
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.corners.evidence import blur_evidence
from cmp_tactile_processing.tracking.numbering.pattern_border import border_sides
from cmp_tactile_processing.tracking.tracker import GridTracker

Float = NDArray[np.float64]
Image = NDArray[np.uint8]

# The spectrum has so many samples along a side; light that changes over so many px is taken out.
SAMPLES, LIGHT_PX = 1024, 25.0
# Checkers are looked for from this many px a side to a quarter of the picture.
SMALLEST_SIDE_PX = 4.0
# The second direction of the diagonals is across the first one to so many degrees, and as long to
# such a share.
ACROSS_DEG, AS_LONG = 25.0, 0.4
# A line of corners counts where so large a share of it is seen.
LEAST_SEEN = 0.5
# With fewer corners, or where the description that is made finds fewer of them again, it is none.
FEWEST_CORNERS, FOUND_AGAIN = 36, 0.9
# Angles of view that are tried, the usual one first: another one must be so much nearer.
USUAL_ANGLES_DEG, NEARER = (60.0, *range(20, 125, 5)), 0.7
# What is not to be seen in a picture.
THICKNESS_M, SKIN_M, YOUNG_PA, POISSON, RIM = 0.005, 0.0003, 5e5, 0.48, 4


@dataclass(frozen=True)
class Proposal:
    """A description, and what the picture is worth.

    grid: what its tracker finds in the picture.  side_px: of a checker.  sharpness: 1 for sharp
    edges, 0.45 where grey levels are a sine wave; contrast: grey levels between light and dark;
    noise: grey levels; std_m: median standard deviation of a corner in the pattern's plane.
    """

    sensor: SensorDescription
    grid: Grid
    side_px: float
    sharpness: float
    contrast: float
    noise: float
    std_m: float


def propose(image: Image, pitch: float, name: str, angle_of_view: float | None = None) -> Proposal:
    """The proposal for a picture (H, W) uint8 of a pattern with checkers of a known pitch, m.

    angle_of_view: of the camera, horizontally, degrees; where it is not given, the one that best
    explains how the pattern is tilted, or the usual one where it is not.
    Raises FrameError where no checkers are seen, or too few.
    """
    step = lattice_step(image)
    side = float(np.linalg.norm(step))
    wide = _wide_description(image, step, pitch, name)
    grid = GridTracker(wide).track(image)
    known = np.isfinite(grid.corners[..., 0])
    if np.count_nonzero(known) < FEWEST_CORNERS:
        msg = (
            f"picture: found {np.count_nonzero(known)} corners of checkers of {side:.0f} px "
            f"({grid.reason}), expected at least {FEWEST_CORNERS}: sharp, evenly lit, the pattern "
            "nearly upright and as large as possible in the picture"
        )
        raise FrameError(msg)
    part = _part_with_corners(known)
    corners, dark = grid.corners[part], wide.pattern.corner_checker == "dark"
    even = dark == ((part[0].start + part[1].start) % 2 == 0)
    prepared = Prefilter(image.shape, side).prepare(image)
    sides = border_sides(prepared, corners, even, corners.shape[:2])
    angles = USUAL_ANGLES_DEG if angle_of_view is None else (angle_of_view,)
    ends = all(side.ends for side in sides)
    sensor = _described(wide, corners, even=even, ends=ends, angles=angles)
    found = GridTracker(sensor).track(image)
    share = found.found_fraction
    if share < FOUND_AGAIN:
        rows, cols = found.shape.corners
        msg = (
            f"picture: found {rows} x {cols} corners, of which a sensor that is described so finds "
            f"{share:.0%} again ({found.reason}), expected {FOUND_AGAIN:.0%}"
        )
        raise FrameError(msg)
    sharpness, _ = blur_evidence(prepared.grey, corners, even)
    side = float(np.nanmedian(np.linalg.norm(np.diff(corners, axis=1), axis=-1)))
    std_px = np.nan if found.corner_std is None else float(np.nanmedian(found.corner_std))
    noise, std = prepared.noise, std_px * pitch / side
    return Proposal(sensor, found, side, sharpness, prepared.contrast, noise, std)


def lattice_step(image: Image) -> Float:
    """The way, (2,) px, from a corner to the next one along the rows of a checkerboard.

    A checkerboard's strongest waves run along the diagonals of its checkers; the sum of two that
    cross is the wave along its rows.  Raises FrameError where there are none.
    """
    grey = image.astype(np.float32)
    grey -= cv2.GaussianBlur(grey, (0, 0), LIGHT_PX)
    window = np.outer(np.hanning(image.shape[0]), np.hanning(image.shape[1]))
    power = np.abs(np.fft.rfft2(grey * window, (SAMPLES, SAMPLES)))
    fy, fx = np.fft.fftfreq(SAMPLES)[:, None], np.fft.rfftfreq(SAMPLES)[None]
    length = np.hypot(fx, fy)
    longest = np.sqrt(0.5) / SMALLEST_SIDE_PX
    shortest = np.sqrt(0.5) / (min(image.shape) / 4)
    power[(length < shortest) | (length > longest)] = 0.0
    power = cv2.GaussianBlur(power, (0, 0), 2.0)

    def strongest(allowed: NDArray[np.bool_]) -> Float:
        y, x = np.unravel_index(np.where(allowed, power, 0.0).argmax(), power.shape)
        return np.array([fx[0, x], fy[y, 0]])

    first = strongest(np.ones_like(power, dtype=bool))
    size = float(np.hypot(*first))
    if not size:
        msg = "picture: found no pattern that repeats, expected checkers"
        raise FrameError(msg)
    along = (fx * first[0] + fy * first[1]) / np.maximum(length * size, 1e-12)
    across = np.abs(along) < np.sin(np.radians(ACROSS_DEG))
    second = strongest(across & (np.abs(length / size - 1) < AS_LONG))
    # Of the two waves along the sides of the checkers the one that is nearer to the x axis.
    waves = np.array([first + second, first - second])
    wave = waves[np.abs(waves[:, 0]).argmax()]
    wave = wave if wave[0] > 0 else -wave
    return np.asarray(wave / (wave @ wave))


def _wide_description(image: Image, step: Float, pitch: float, name: str) -> SensorDescription:
    """A description that numbers all corners there may be, looking straight at the pattern."""
    height, width = image.shape
    side, focal = float(np.linalg.norm(step)), _focal(width, USUAL_ANGLES_DEG[0])
    rows, cols = (min(int(extent / side) + 2, parts.MAX_BEYOND_VIEW) for extent in image.shape)
    cosine, sine = step / side
    pose = np.eye(4)
    pose[:2, :2] = [[cosine, -sine], [sine, cosine]]
    pose[2, 3] = focal * pitch / side
    centre = (width - 1) / 2, (height - 1) / 2
    pattern = parts.Pattern(
        rows, cols, pitch, "dark", 2, parts.PatternSurface(), border="beyond_view"
    )
    return SensorDescription(
        name=name,
        image=parts.ImageSize(width, height),
        camera=parts.Camera("pinhole", focal, focal, *centre, (0.0,) * 5),
        optics=parts.Optics("monocular", pose, ()),
        views={"left": parts.ViewDescription(parts.Roi(0, 0, width, height))},
        pattern=pattern,
        elastomer=_elastomer(rows, cols, pitch),
    )


def _elastomer(rows: int, cols: int, pitch: float) -> parts.Elastomer:
    size = round((cols + RIM) * pitch, 9), round((rows + RIM) * pitch, 9), THICKNESS_M
    layer = parts.ShadingLayer(SKIN_M, YOUNG_PA)
    return parts.Elastomer(size, YOUNG_PA, POISSON, "linear", layer)


def _part_with_corners(known: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns between the outermost that are seen along most of their length."""
    found = []
    for axis in (1, 0):
        count = known.sum(axis=axis)
        lines = np.flatnonzero(count >= LEAST_SEEN * count.max())
        found.append(slice(int(lines[0]), int(lines[-1]) + 1))
    return found[0], found[1]


def _described(
    wide: SensorDescription,
    corners: Float,
    *,
    even: bool,
    ends: bool,
    angles: Sequence[float],
) -> SensorDescription:
    """The description for corners (rows, cols, 2) px.

    even: whether the dark checkers touch corner (0, 0) along the diagonal (-, -) to (+, +); ends:
    whether the pattern does on all sides; angles: of view that come into question.
    """
    if not ends:
        # Corners at the rim of the picture leave it as soon as the gel moves.
        corners = corners[1:-1, 1:-1]
    rows, cols = corners.shape[:2]
    pattern = replace(
        wide.pattern,
        rows=rows,
        cols=cols,
        corner_checker="dark" if even else "light",
        border="in_view" if ends else "beyond_view",
        points_per_segment=6,
    )
    least, camera, pose = _camera(wide.image, pattern, corners, angles[0])
    usual = least
    for angle in angles[1:]:
        off, other, its_pose = _camera(wide.image, pattern, corners, angle)
        if off < min(least, NEARER * usual):
            least, camera, pose = off, other, its_pose
    optics = replace(wide.optics, T_camera_gel=pose)
    elastomer = _elastomer(rows, cols, pattern.pitch)
    return replace(wide, camera=camera, pattern=pattern, optics=optics, elastomer=elastomer)


def _camera(
    image: parts.ImageSize, pattern: parts.Pattern, corners: Float, angle: float
) -> tuple[float, parts.Camera, Float]:
    """A camera of some angle of view, degrees: by how many px it misses the corners, its pose."""
    focal, centre = _focal(image.width, angle), ((image.width - 1) / 2, (image.height - 1) / 2)
    matrix = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    known = np.isfinite(corners[..., 0])
    points = pattern.corners()[known]
    _, turn, shift = cv2.solvePnP(points, corners[known], matrix, None)
    missed = cv2.projectPoints(points, turn, shift, matrix, None)[0][:, 0] - corners[known]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    camera = parts.Camera("pinhole", focal, focal, *centre, (0.0,) * 5)
    return float(np.sqrt((missed**2).mean())), camera, pose


def _focal(width: int, angle: float) -> float:
    """Focal length, px, for an angle of view, degrees, over a width, px."""
    return float(round(width / 2 / np.tan(np.radians(angle) / 2), 1))
