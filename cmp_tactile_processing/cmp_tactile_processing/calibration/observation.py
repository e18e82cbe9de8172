"""Where frames of the gel show the corners of its pattern, one by one and on average."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.geometry.rigid_motion import largest_local_mean
from cmp_tactile_processing.measured import Grid, Status
from cmp_tactile_processing.processes import OnProgress, no_progress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.tracking.views import ViewTrackers

# A corner's mean is not believed to be better than this, px: interpolation has its own errors.
LEAST_STD = 2e-3
# A gap of the rays that is never exceeded, m.
WIDEST_GAP_M = 1e-2


@dataclass(frozen=True)
class ViewObservation:
    """The corners that the usable frames show in one view.

    corners (rows, cols, 2) px of the view: mean over the frames, NaN where too few show one;
    std (rows, cols) px of that mean, per coordinate.  frames (F, rows, cols, 2) px: each one's,
    NaN where not measured; grids: what each shows; numbers (F,): which of all frames they are.
    """

    view: str
    corners: NDArray[np.float64]
    std: NDArray[np.float64]
    frames: NDArray[np.float64]
    grids: tuple[Grid, ...]
    numbers: NDArray[np.intp]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which corners (rows, cols) have a mean."""
        return np.asarray(np.isfinite(self.corners[..., 0]))

    @property
    def noise(self) -> float:
        """Standard deviation of a corner in one frame, px: the median of what the tracker gives."""
        stds = [grid.corner_std for grid in self.grids if grid.corner_std is not None]
        known = np.concatenate([np.empty(0), *(std[np.isfinite(std)] for std in stds)])
        return float(np.median(known)) if known.size else LEAST_STD

    @property
    def motion(self) -> NDArray[np.float64]:
        """How far, px (F,), parts of each frame's pattern lie from where most frames have them."""
        ever = np.isfinite(self.frames[..., 0]).any(axis=0)
        usual = np.full(self.frames.shape[1:], np.nan)
        usual[ever] = np.nanmedian(self.frames[:, ever], axis=0)
        largest = [largest_local_mean(frame - usual) for frame in self.frames]
        return np.asarray(np.nan_to_num(largest))


def track_frames(
    sensor: SensorDescription,
    frames: Sequence[NDArray[np.uint8]],
    on_progress: OnProgress = no_progress,
) -> dict[str, list[Grid]]:
    """Grids of all frames, (H, W) or (H, W, 3) uint8, by view.

    Raises CalibrationError without frames, FrameError that names a frame of another size,
    InputError for a sensor with its pattern in none of the views.
    """
    if not len(frames):
        msg = f"{sensor.name}: found no frames, expected at least one of the gel"
        raise CalibrationError(msg)
    on_progress("preparing the trackers", 0.0)
    trackers = ViewTrackers(sensor)
    grids: dict[str, list[Grid]] = {name: [] for name in sensor.views}
    for number, frame in enumerate(frames, 1):
        for name, grid in trackers.track(frame, f"frame {number} of {len(frames)}").items():
            grids[name].append(grid)
        on_progress("tracking", number / len(frames))
    return grids


def require_grids(sensor: SensorDescription, grids: Mapping[str, Sequence[Grid]]) -> None:
    """Raise CalibrationError unless there are grids of the pattern, as many of each view."""
    counts = {name: len(view) for name, view in grids.items()}
    if (
        counts.keys() != sensor.views.keys()
        or len(set(counts.values())) != 1
        or not any(counts.values())
    ):
        found = ", ".join(f"{count} of {name}" for name, count in counts.items()) or "none"
        wanted = " and ".join(sensor.views)
        msg = (
            f"{sensor.name}: grids: found {found}, expected at least one, and the same number of "
            f"{wanted}"
        )
        raise CalibrationError(msg)
    shape = sensor.pattern.shape
    for grid in (grid for view in grids.values() for grid in view if grid.shape != shape):
        msg = f"{sensor.name}: grids: found {grid.shape}, expected {shape}"
        raise CalibrationError(msg)


def observed(view: str, grids: Sequence[Grid], usable: NDArray[np.bool_]) -> ViewObservation:
    """Mean corners of the usable ones (F,) of a view's grids.

    A corner counts where at least half of them measured it.
    """
    kept = tuple(grid for grid, use in zip(grids, usable, strict=True) if use)
    frames = np.stack([_measured(grid) for grid in kept])
    count = np.isfinite(frames[..., 0]).sum(axis=0)
    enough = count >= max(1, len(kept) / 2)
    with np.errstate(invalid="ignore"):
        mean = np.nansum(frames, axis=0) / np.maximum(count, 1)[..., None]
        off = np.where(np.isfinite(frames), frames - mean, 0.0)
        scatter = np.sqrt((off**2).sum(axis=(0, -1)) / np.maximum(2 * (count - 1), 1))
    reported = np.stack([_reported_std(grid) for grid in kept])
    one = np.fmax(reported.mean(axis=0), scatter)
    std = np.sqrt(one**2 / np.maximum(count, 1) + LEAST_STD**2)
    return ViewObservation(
        view=view,
        corners=np.where(enough[..., None], mean, np.nan),
        std=np.where(enough, std, np.nan),
        frames=frames,
        grids=kept,
        numbers=np.flatnonzero(usable),
    )


def usual_complaint(grids: Sequence[Grid]) -> str:
    """What most of these grids say of why corners are missing, in words."""
    reasons: Mapping[str, int] = {
        grid.reason: sum(other.reason == grid.reason for other in grids) for grid in grids
    }
    return max(reasons, key=lambda reason: (bool(reason), reasons[reason])) or "no pattern seen"


def _measured(grid: Grid) -> NDArray[np.float64]:
    return np.where((grid.corner_status == Status.MEASURED)[..., None], grid.corners, np.nan)


def _reported_std(grid: Grid) -> NDArray[np.float64]:
    if grid.corner_std is None:
        return np.full(grid.corner_status.shape, LEAST_STD)
    known = np.isfinite(grid.corner_std)
    usual = float(np.median(grid.corner_std[known])) if known.any() else LEAST_STD
    return np.where(known, grid.corner_std, usual)


def rig_for_any_gap(sensor: SensorDescription) -> StereoRig:
    """The sensor's rig, which leaves out no marker for its gap: gaps are what is looked for."""
    wide = replace(sensor.triangulation, max_ray_gap=WIDEST_GAP_M)
    return StereoRig(replace(sensor, triangulation=wide))
