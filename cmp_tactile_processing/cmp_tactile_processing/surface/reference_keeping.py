"""Keeps the reference: takes one when the gel rests, and watches the gel drift away from it.

Whether the gel is still, and whether something touches it, is determined from the markers alone.
Still: over a number of frames no marker shakes and none creeps, within what noise explains.
Untouched: the markers lie as on the nominal surface, but for a rigid motion, a scale, and local
errors of the print.  A touch flatter than that tolerance, or one that drags the whole pattern less
than `rest_shift`, is taken for none; a sensor with a description that does not fit seems touched.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ReferenceFramesError
from cmp_tactile_processing.geometry.rigid_motion import fit_motion, largest_local_mean, local_mean
from cmp_tactile_processing.measured import Markers3D, Status
from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_processing.surface.displacement import Reference

# The share of the markers that must keep a limit: a few may flicker at the rim of the light.
MOST_MARKERS = 0.95
# What noise may make of a figure, in standard deviations.
DEVIATIONS = 5.0
# Nine markers are averaged where one's creep is measured.
NEIGHBOURS = 9
# Another scale is another sensor, or a press from rim to rim.
LARGEST_SCALE = 0.03
# Standard deviation of normal noise per median of its absolute value.
MAD_TO_STD = 1.4826
# Standard deviation of the median of normal noise per that of its mean.
MEDIAN_TO_MEAN = 1.2533
NS_PER_S = 1_000_000_000


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
    moved = np.linalg.norm(local_mean(_median(stack[-half:]) - _median(stack[:half])), axis=-1)
    return float(np.nanmax(moved)) if np.isfinite(moved).any() else math.nan


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


@dataclass(frozen=True)
class DriftParameters(Parameters, section="drift"):
    """What drift of the gel at rest is followed and reported."""

    drift_time: float = parameter(
        10.0, "time constant of the average of the drift at rest", unit="s", within=(0.0, 3600.0)
    )
    drift_limit: float = parameter(
        15e-6,
        "drift of the gel at rest since the reference, of the whole gel or of neighbouring "
        "markers, above which a warning is given",
        unit="m",
        within=(1e-7, 1e-2),
    )


@dataclass(frozen=True)
class Drift:
    """Drift of the gel at rest since the reference, low-passed.

    shift: of the whole, m; turn: of the whole, rad; shape: most that neighbouring markers moved
    together beyond that, m; largest: most that neighbouring markers moved in all, m.
    """

    shift: float
    turn: float
    shape: float
    largest: float


class DriftMonitor:
    """Averages the displacement of frames at rest; frames in contact or in motion do not count.

    A frame counts that is still, and has a shape that is the nominal surface's or the reference's.
    """

    def __init__(self, rest: RestParameters, parameters: DriftParameters) -> None:
        self._rest, self._parameters = rest, parameters
        self._reference: Reference | None = None
        self._mean: NDArray[np.float64] | None = None
        self._stamp_ns = 0
        self.drift: Drift | None = None

    def add(self, judged: FramesJudged, reference: Reference, stamp_ns: int) -> Drift | None:
        """The drift as it is now known; None before any frame at rest since the reference."""
        if reference is not self._reference:
            self._reference, self._mean, self.drift = reference, None, None
        if not judged.still or not (judged.untouched or self._like(judged, reference)):
            return self.drift
        moved = judged.position - reference.position
        if self._mean is None or stamp_ns < self._stamp_ns:
            mean = moved
        else:
            share = self._share((stamp_ns - self._stamp_ns) / NS_PER_S)
            # Where a marker was not known before, or is not now, the other value stands.
            mean = self._mean + share * (moved - self._mean)
            mean = np.where(np.isnan(mean), np.where(np.isnan(moved), self._mean, moved), mean)
        self._mean, self._stamp_ns = mean, stamp_ns
        self.drift = _drift(reference.position, mean) or self.drift
        return self.drift

    def warning(self) -> str:
        """What is wrong and what to do; empty where drift is below its limit or not known."""
        limit = self._parameters.drift_limit
        if self.drift is None or not self.drift.largest > limit:
            return ""
        return (
            f"the gel at rest has drifted by {self.drift.largest * 1e6:.0f} um since the "
            f"reference, expected at most {limit * 1e6:.0f} um: zero again while nothing touches "
            "the gel; if it drifts again, check the mounting of gel and camera, and calibrate"
        )

    def _like(self, judged: FramesJudged, reference: Reference) -> bool:
        shape = rest_shape(reference.position, judged.position)
        if shape is None:
            return False
        rest = self._rest
        return shape.bump <= rest.rest_tolerance and shape.shift <= rest.rest_shift

    def _share(self, elapsed_s: float) -> float:
        if self._parameters.drift_time <= 0:
            return 1.0
        return 1 - math.exp(-elapsed_s / self._parameters.drift_time)


def _drift(reference: NDArray[np.float64], moved: NDArray[np.float64]) -> Drift | None:
    motion = fit_motion(reference, reference + moved)
    if motion is None:
        return None
    return Drift(
        shift=float(np.sqrt(np.nansum(motion.shift**2))),
        turn=float(np.linalg.norm(motion.turn)),
        shape=largest_local_mean(motion.residual),
        largest=largest_local_mean(moved),
    )


@dataclass(frozen=True)
class ZeroParameters(Parameters, section="reference"):
    """When a reference is taken without being asked for."""

    auto_reference: str = parameter(
        "when_still",
        "when the node takes a reference: as soon as the gel is still and untouched "
        "(when_still), only if it is so in the first frames (at_start), or never",
        choices=("when_still", "at_start", "never"),
    )
    auto_rezero: bool = parameter(
        False,
        "take a new reference automatically if the gel, still and untouched, has drifted beyond "
        "drift_limit",
    )


class ReferenceKeeper:
    """Holds the `reference`, at first the nominal surface.

    `waiting`: a reference is still to be taken by itself.  `reason`: why none has been so far.
    """

    def __init__(self, nominal: Reference) -> None:
        self._nominal = nominal
        self.reference = nominal
        self.waiting = True
        self.reason = ""
        self._doubt = ""
        self.judged: FramesJudged | None = None
        self._zero = ZeroParameters()
        self.watch(RestParameters(), DriftParameters())

    def zero(self, parameters: ZeroParameters) -> None:
        """When to take a reference by itself; where that is new, waits for it, unless never."""
        if parameters.auto_reference != self._zero.auto_reference:
            self.waiting, self.reason = parameters.auto_reference != "never", ""
        self._zero = parameters

    def watch(self, rest: RestParameters, drift: DriftParameters) -> None:
        """What rest and drift are; both are judged again from now on."""
        self._rest, self._drift_parameters = rest, drift
        self._stillness = StillnessWatch(self._nominal.position, rest)
        self._drift = DriftMonitor(rest, drift)

    @property
    def drift(self) -> Drift | None:
        """Drift of the gel at rest since the reference; None while it was not seen at rest."""
        return self._drift.drift

    def take(self, frames: Sequence[Markers3D], stamp_ns: int) -> str:
        """Measure against the mean of these frames from now on; what is to be said of it.

        Raises ReferenceFramesError where they cannot serve; all then stays as it was.
        """
        reference = Reference.average(frames, self.reference.id + 1, stamp_ns)
        return self._use(reference, self._why_touched(reference), len(frames))

    def _why_touched(self, reference: Reference) -> str:
        return why_touched(rest_shape(self._nominal.position, reference.position), self._rest)

    def _use(self, reference: Reference, doubt: str, frames: int) -> str:
        left_out = f" of {frames}" if reference.frames < frames else ""
        said = f"reference {reference.id} is the mean of {reference.frames}{left_out} frames"
        self.reference, self.waiting, self.reason = reference, False, ""
        self._doubt = doubt
        self._drift = DriftMonitor(self._rest, self._drift_parameters)
        return f"{said}; but {doubt}" if doubt else said

    def add(self, markers: Markers3D, stamp_ns: int) -> str:
        """Take a frame into account; what is to be said where it led to a new reference."""
        judged = self._stillness.add(markers, stamp_ns)
        if judged is None:
            return ""
        self.judged = judged
        if self.waiting:
            return self._awaited(judged, stamp_ns)
        self._drift.add(judged, self.reference, stamp_ns)
        if self._zero.auto_rezero and self._drift.warning() and judged.at_rest:
            # What drifted is reported until frames can serve.
            with contextlib.suppress(ReferenceFramesError):
                return self._taken(judged, stamp_ns)
        return ""

    def warning(self) -> str:
        """What is wrong with the reference and what to do; empty where nothing is."""
        if self._zero.auto_reference != "never" and self.reason:
            later = "it is taken when this has ended" if self.waiting else "none was taken at start"
            number = self.reference.id
            kept = f"new reference yet, displacement is relative to reference {number}"
            if not number:
                kept = "reference yet, displacement is relative to the nominal surface"
            return f"no {kept}: {self.reason}; {later}, or when you zero"
        if self._doubt:
            return (
                f"reference {self.reference.id} is doubtful: {self._doubt}; zero again "
                "while nothing touches the gel, or calibrate"
            )
        return self._drift.warning()

    def _taken(self, judged: FramesJudged, stamp_ns: int) -> str:
        reference = Reference.average(judged.frames, self.reference.id + 1, stamp_ns)
        doubt = self._why_touched(reference)
        if doubt:
            raise ReferenceFramesError(doubt)
        return self._use(reference, "", len(judged.frames)) + ", taken automatically"

    def _awaited(self, judged: FramesJudged, stamp_ns: int) -> str:
        self.reason = judged.reason
        if judged.at_rest:
            try:
                return self._taken(judged, stamp_ns)
            except ReferenceFramesError as error:
                self.reason = str(error)
        if judged.seen and self._zero.auto_reference == "at_start":
            self.waiting = False
        return ""
