"""Determines from the markers alone whether the gel is still and whether something touches it.

Still: over a number of frames no marker shakes and none creeps, within what noise explains.
Untouched: the markers lie as on the nominal surface, but for a rigid motion, a scale, and local
errors of the print.  A touch flatter than that tolerance, or one that drags the whole pattern less
than `rest_shift`, is taken for none; a sensor with a description that does not fit seems touched.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from cmp_tactile_processing.geometry.rigid_motion import (
    NEIGHBOURS,
    fit_motion,
    largest_local_mean,
    local_mean,
)
from cmp_tactile_processing.measured import MAD_TO_STD, Markers3D, Status
from cmp_tactile_processing.sensor.parameters import Parameters, parameter

# The share of the markers that must keep a limit: a few may flicker at the rim of the light.
MOST_MARKERS = 0.95
# What noise may make of a figure, in standard deviations.
DEVIATIONS = 5.0
# Motion below this is none, m: a tenth of the least that a load of interest makes.
LEAST_MOTION = 3e-6
# A dent of a single frame below this is none, m.  In a fifth of the frames of a reference it would
# shift the zero by 5 mN (sample_rig, ball of 10 mm).
LEAST_DENT = 15e-6
# Another scale is another sensor, or a press from rim to rim.
LARGEST_SCALE = 0.03
# Standard deviation of the median of normal noise per that of its mean.
MEDIAN_TO_MEAN = 1.2533


@dataclass(frozen=True)
class RestParameters(Parameters, section="rest"):
    """When the gel counts as still and untouched."""

    rest_frames: int = parameter(
        20, "number of frames in which the gel must be still", within=(4, 1000)
    )
    rest_min_tracked: float = parameter(
        0.9, "share of the markers that must be measured in these frames", within=(0.1, 1.0)
    )
    rest_shake: float = parameter(
        20e-6,
        "the gel shakes if a marker's standard deviation over frames exceeds this, unless "
        "the markers' covariance explains it",
        unit="m",
        within=(1e-8, 1e-3),
    )
    rest_creep: float = parameter(
        3e-6,
        "the gel creeps if neighbouring markers move more than this from the first to the "
        "second half of these frames, unless noise explains it",
        unit="m",
        within=(1e-8, 1e-3),
    )
    rest_tolerance: float = parameter(
        40e-6,
        "largest distance of neighbouring markers from the nominal surface, without rigid "
        "motion and scale, that counts as untouched; a worn print alone causes 20 um",
        unit="m",
        within=(1e-7, 1e-3),
    )
    rest_shift: float = parameter(
        5e-4,
        "largest shift of the whole pattern from the nominal surface that counts as untouched",
        unit="m",
        within=(1e-6, 1e-2),
    )


@dataclass(frozen=True)
class RestShape:
    """How markers differ from a surface at rest.

    shift: length of that of the whole, m; scale: 1 where the sizes agree; bump: most that
    neighbouring markers are off together, m, at the marker `place` (row, column).
    """

    shift: float
    scale: float
    bump: float
    place: tuple[int, int]


@dataclass(frozen=True)
class FramesJudged:
    """What a number of frames in a row said.

    seen: enough markers were measured; still, untouched: the verdicts, False where not seen;
    reason: why not both, empty where both.
    frames: those judged, in order.  shake, creep: m, NaN where too few markers were seen.
    shape: against the nominal surface, None where too few markers were seen.
    position (rows, cols, 3): median over the frames, m.
    """

    seen: bool
    still: bool
    untouched: bool
    reason: str
    frames: tuple[Markers3D, ...]
    shake: float
    creep: float
    shape: RestShape | None
    position: NDArray[np.float64]

    @property
    def at_rest(self) -> bool:
        """Whether the gel was still and nothing seemed to touch it."""
        return self.still and self.untouched


def rest_shape(rest: NDArray[np.float64], position: NDArray[np.float64]) -> RestShape | None:
    """Markers (rows, cols, 3) m against a surface at rest; None where too few are known."""
    motion = fit_motion(rest, position, scaled=True)
    if motion is None:
        return None
    bump = np.linalg.norm(local_mean(motion.residual), axis=-1)
    if np.isnan(bump).all():
        return None
    row, col = np.unravel_index(int(np.nanargmax(bump)), bump.shape)
    shift = float(np.sqrt(np.nansum(motion.shift**2)))
    return RestShape(shift, motion.scale, float(bump[row, col]), (int(row), int(col)))


def dents_of_frames(stack: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """How far neighbouring markers of each frame are together off the median of all, at most, m.

    stack (F, rows, cols, 3) m.  Returns these (F,), 0 where too few markers are known, and the
    limit above which it is a touch and not noise.  A rigid motion, as of a camera that shakes, and
    a scale are left out, and so are single markers that jump.
    """
    middle, off = _median(stack), np.full(stack.shape, np.nan)
    for frame, residual in zip(stack, off, strict=True):
        motion = fit_motion(middle, frame, scaled=True)
        if motion is not None:
            residual[:] = motion.residual
    together = median_filter(np.nan_to_num(off), size=(1, 3, 3, 1))
    dents = np.linalg.norm(together, axis=-1).max(axis=(1, 2))
    # Noise is what differs from neighbour to neighbour, also in three frames of which one is
    # touched; that of the half of the frames with the smallest dents.
    quiet = np.argsort(dents)[: (len(stack) + 1) // 2]
    apart = np.nansum((off[quiet] - together[quiet]) ** 2, axis=-1)
    known = np.isfinite(off[quiet, ..., 0])
    mean = np.where(known, apart, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    seen = mean[known.any(axis=0)]
    variance = float(np.quantile(seen, MOST_MARKERS)) / (NEIGHBOURS - 1) if len(seen) else 0.0
    return dents, max(LEAST_DENT, DEVIATIONS * MEDIAN_TO_MEAN * math.sqrt(variance))


def motion_limit(position: NDArray[np.float64]) -> float:
    """Motion between two frames, as `largest_motion` has it, that noise does not explain, m.

    position (n, rows, cols, 3) m.  From differences of second order, which steady motion leaves
    at 0, over all frames: most of a recording may move.
    """
    second = np.diff(position, n=2, axis=0)
    known = np.abs(second[np.isfinite(second[..., :2]).all(axis=-1)])
    if not known.size:
        return LEAST_MOTION
    deviation = MAD_TO_STD * np.nan_to_num(np.median(known, axis=0)) / math.sqrt(6)
    noise = float(np.sqrt((deviation**2).sum())) * math.sqrt(2 / NEIGHBOURS)
    return max(LEAST_MOTION, DEVIATIONS * noise)


def largest_motion(before: NDArray[np.float64], after: NDArray[np.float64]) -> float:
    """Most that neighbouring markers moved together, m; positions (rows, cols, 3), NaN if unknown.

    Infinite where too few markers are known.
    """
    moved = largest_local_mean(after - before)
    return math.inf if math.isnan(moved) else moved


class StillnessWatch:
    """Judges frames, `rest_frames` of them at a time.

    nominal (rows, cols, 3): the surface at rest, gel frame, m.
    """

    def __init__(self, nominal: NDArray[np.float64], parameters: RestParameters) -> None:
        self._nominal, self._parameters = nominal, parameters
        self._frames: list[Markers3D] = []
        self._last_stamp_ns = 0

    def add(self, markers: Markers3D, stamp_ns: int) -> FramesJudged | None:
        """Take a frame; the verdict where it was the last one needed.

        Stamps that go back begin again: the frames before them belong to another recording.
        """
        if stamp_ns < self._last_stamp_ns:
            self._frames.clear()
        self._last_stamp_ns = stamp_ns
        self._frames.append(markers)
        if len(self._frames) < self._parameters.rest_frames:
            return None
        frames, self._frames = tuple(self._frames), []
        return judge_frames(frames, self._nominal, self._parameters)


def judge_frames(
    frames: tuple[Markers3D, ...], nominal: NDArray[np.float64], parameters: RestParameters
) -> FramesJudged:
    """Whether the gel was still and untouched in these frames, at least four of them."""
    stack = np.stack([item.position for item in frames])
    measured = np.stack([item.status for item in frames]) == int(Status.MEASURED)
    tracked = float(np.median(measured.mean(axis=(1, 2))))
    position = _median(stack)
    known = np.isfinite(position[..., :2]).all(axis=-1)
    shake, creep, creep_limit = math.nan, math.nan, parameters.rest_creep
    if known.any():
        shake, creep = _shake(stack), _creep(stack)
        # The largest of all is judged: the noisiest markers, not the usual ones, set its limit.
        noise = MEDIAN_TO_MEAN * shake * math.sqrt(4 / len(frames) / NEIGHBOURS)
        creep_limit = max(creep_limit, DEVIATIONS * noise)
    shape = rest_shape(nominal, position)
    unseen = _unseen(tracked, parameters)
    moving = unseen or _moving(shake, creep, (_shake_limit(frames, parameters), creep_limit))
    touched = unseen or why_touched(shape, parameters)
    return FramesJudged(
        seen=not unseen,
        still=not moving,
        untouched=not touched,
        reason=moving or touched,
        frames=frames,
        shake=shake,
        creep=creep,
        shape=shape,
        position=position,
    )


def _median(stack: NDArray[np.float64]) -> NDArray[np.float64]:
    """Median over the frames (F, rows, cols, 3); NaN where a marker is in fewer than half."""
    # Sorted here, as numpy's nanmedian is ten times slower; what is not known comes last.
    ordered = np.sort(stack, axis=0)
    count = np.isfinite(stack).sum(axis=0, keepdims=True)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis=0)
    high = np.take_along_axis(ordered, np.minimum(count // 2, len(stack) - 1), axis=0)
    return np.asarray(np.where(2 * count >= len(stack), (low + high) / 2, np.nan)[0])


def _shake(stack: NDArray[np.float64]) -> float:
    """What most markers keep below from frame to frame, m; NaN where none was in three in a row.

    Standard deviation of x, y and z together, from second differences, which a steady motion
    leaves at 0; one bad frame changes little.
    """
    deviation = MAD_TO_STD * _median(np.abs(np.diff(stack, n=2, axis=0))) / math.sqrt(6)
    known = deviation[np.isfinite(deviation[..., :2]).all(axis=-1)]
    if not len(known):
        return math.nan
    return float(np.quantile(np.sqrt(np.nansum(known**2, axis=-1)), MOST_MARKERS))


def _creep(stack: NDArray[np.float64]) -> float:
    """Most that neighbouring markers moved together from the first to the last half, m."""
    half = len(stack) // 2
    return largest_local_mean(_median(stack[-half:]) - _median(stack[:half]))


def _shake_limit(frames: tuple[Markers3D, ...], parameters: RestParameters) -> float:
    explained = _usual_std(frames[-1].covariance)
    return max(parameters.rest_shake, DEVIATIONS * explained)


def _usual_std(covariance: NDArray[np.float64]) -> float:
    """Median over the markers of the standard deviation of x, y and z together, m; 0 of none."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    known = variance[np.isfinite(variance[..., :2]).all(axis=-1)]
    return math.sqrt(np.median(np.nansum(known, axis=-1))) if len(known) else 0.0


def _unseen(tracked: float, parameters: RestParameters) -> str:
    if tracked >= parameters.rest_min_tracked:
        return ""
    return f"found {tracked:.0%} of the markers, expected {parameters.rest_min_tracked:.0%}"


def _moving(shake: float, creep: float, limits: tuple[float, float]) -> str:
    for what, found, limit in (("shakes", shake, limits[0]), ("moves", creep, limits[1])):
        if math.isnan(found):
            return (
                "found the markers in too few consecutive frames to decide whether the gel is still"
            )
        if not found <= limit:
            return f"the gel {what} by {found * 1e6:.1f} um, expected at most {limit * 1e6:.1f} um"
    return ""


def why_touched(shape: RestShape | None, parameters: RestParameters) -> str:
    """Why something seems to touch a gel of that shape; empty where nothing does."""
    if shape is None:
        return "found too few markers to determine the gel's shape"
    if shape.bump > parameters.rest_tolerance:
        return (
            f"markers around {shape.place} are {shape.bump * 1e6:.0f} um off the shape at rest, "
            f"expected at most {parameters.rest_tolerance * 1e6:.0f} um: something touches the "
            "gel, or the sensor description is wrong"
        )
    if shape.shift > parameters.rest_shift:
        return (
            f"the pattern is shifted by {shape.shift * 1e6:.0f} um, expected at most "
            f"{parameters.rest_shift * 1e6:.0f} um: something drags the gel, or the sensor "
            "description is wrong"
        )
    if abs(shape.scale - 1) > LARGEST_SCALE:
        return (
            f"the pattern is {shape.scale:.3f} times its described size, expected 1 +- "
            f"{LARGEST_SCALE:g}: check the sensor description"
        )
    return ""
