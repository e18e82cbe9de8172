"""Tac3D sensors: their recordings, a folder of arrays for each, and the frames of a running one.

Lengths in them are mm, forces N, moments N mm, times s.  Marker (0, 0) is the one of largest y and
x; the gel frame has it the other way round, and begins at the gel's apex.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.sources.markers import LEAST_KNOWN, MarkerRecording, median_known
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import PatternSurface

Array = NDArray[np.float64]

POSITIONS, DISPLACEMENTS, FORCES = "3D_Positions", "3D_Displacements", "3D_Forces"
RESULTANT, MOMENT, STAMPS, INDEX = (
    "3D_ResultantForce",
    "3D_ResultantMoment",
    "sendTimestamp",
    "index",
)
REQUIRED = (POSITIONS, DISPLACEMENTS, STAMPS)
MILLI = 1e-3
# Markers are so far apart, mm; else lengths are in another unit.
PITCH_MM = 0.1, 20.0
# Of positions less displacements, all but some lie within this of the markers at rest.
MOST_LEFT_MM, USUAL_SHARE = 0.2, 0.99
# The surface is flat where its radius is larger, m.
LARGEST_RADIUS_M = 1.0
SPHERE_STEPS = 4


@dataclass(frozen=True)
class Tac3dRecording(MarkerRecording):
    """A recording of one sensor, named by its serial number.

    force (n, rows, cols, 3) N, wrench (n, 6) N and N m about the gel frame's origin: what the
    sensor itself says, NaN where it does not.
    """

    force: Array
    wrench: Array

    @property
    def pitch(self) -> float:
        """Mean distance of neighbouring markers at rest, m."""
        along_x = np.diff(self.reference[..., 0], axis=1)
        along_y = np.diff(self.reference[..., 1], axis=0)
        return float(np.mean([np.nanmean(along_x), np.nanmean(along_y)]))

    def described(self, sensor: SensorDescription) -> SensorDescription:
        """The description with grid, pitch and surface of this sensor, from its markers at rest."""
        rest = self.reference.reshape(-1, 3)
        x, y, z = rest[np.isfinite(rest).all(axis=1)].T
        # Depth of a sphere below its apex: q = s / 2R + s^2 / 8R^3, s = x^2 + y^2.
        s, bend = x**2 + y**2, 0.0
        for _ in range(SPHERE_STEPS):
            terms = np.column_stack([np.ones_like(s), s / 2 + s**2 * bend**2 / 8])
            bend = float(-np.linalg.lstsq(terms, z, rcond=None)[0][1])
        surface = PatternSurface()
        if bend > 1 / LARGEST_RADIUS_M:
            surface = PatternSurface("sphere_cap", round(1 / bend, 5))
        rows, cols = self.reference.shape[:2]
        pattern = replace(
            sensor.pattern, rows=rows, cols=cols, pitch=round(self.pitch, 7), surface=surface
        )
        return replace(sensor, name=self.name, pattern=pattern)


def tac3d_folders(folder: Path) -> list[Path]:
    """The recordings of single sensors in a folder, or the folder itself where it is one.

    Raises FrameSourceError where there is none.
    """
    if (folder / f"{POSITIONS}.npy").exists():
        return [folder]
    found = sorted(path.parent for path in folder.glob(f"*/{POSITIONS}.npy"))
    if not found:
        there = ", ".join(sorted(path.name for path in folder.glob("*"))[:6]) or "nothing"
        msg = f"{folder}: found {there}, expected {POSITIONS}.npy, or folders that contain it"
        raise FrameSourceError(msg)
    return found


def read_tac3d(folder: Path) -> Tac3dRecording:
    """The recording of one sensor.

    Raises FrameSourceError, which names file, found and expected, where an array is missing, cannot
    be read, or has another shape or unit.
    """
    names = (*REQUIRED, FORCES, RESULTANT, MOMENT, INDEX)
    arrays = {name: _load(folder, name) for name in names}
    frames, markers = _checked_shapes(folder, arrays)
    side = round(markers**0.5)
    if side**2 != markers:
        raise _error(folder, POSITIONS, f"{markers} markers", "a square number, as 400")
    by_time = np.argsort(arrays[STAMPS].ravel(), kind="stable")
    stamps = np.rint(arrays[STAMPS].ravel()[by_time] * 1e9).astype(np.int64)
    new = np.append(True, np.diff(stamps) > 0)
    order, stamps = by_time[new], stamps[new]

    def on_grid(name: str) -> Array:
        return _turned(arrays[name].reshape(frames, -1, 3)[order], (side, side))

    moved = on_grid(DISPLACEMENTS)
    at_rest = on_grid(POSITIONS) - moved
    rest = median_known(at_rest)
    wrong = _wrong_at_rest(rest) or _wrong_motion(at_rest - rest)
    if wrong:
        raise FrameSourceError(f"{folder / POSITIONS}.npy: {wrong}")
    origin = _origin(rest)
    force, moment = arrays[RESULTANT].reshape(-1, 3)[order], arrays[MOMENT].reshape(-1, 3)[order]
    return Tac3dRecording(
        name=folder.resolve().name,
        stamp_ns=stamps,
        lost=_lost(arrays[INDEX].ravel()[by_time]),
        reference=MILLI * (rest - origin),
        displacement=MILLI * moved,
        force=on_grid(FORCES),
        wrench=_wrench(force, moment, origin),
    )


class RunningTac3d:
    """Turns the frames of a running sensor into the gel frame; the first one says where that is.

    shape: rows, cols of markers.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self._origin: Array | None = None
        self._reference = np.zeros(0)

    def read(self, frame: Mapping[str, Any]) -> tuple[Array, Array, Array]:
        """Markers at rest and now, (rows, cols, 3) m, and the sensor's own wrench (6,) N and N m.

        The wrench is NaN where the frame has none.  Raises FrameSourceError for a frame that lacks
        markers, or has another number of them.
        """
        position, moved = (self._markers(frame, name) for name in (POSITIONS, DISPLACEMENTS))
        if self._origin is None:
            rest = position - moved
            # Others would count from markers that are missing.
            wrong = _wrong_at_rest(rest, least=1.0)
            if wrong:
                raise FrameSourceError(f"frame: {POSITIONS}: {wrong}")
            self._origin = _origin(rest)
            self._reference = MILLI * (rest - self._origin)
        force, moment = (self._vector(frame.get(name)) for name in (RESULTANT, MOMENT))
        return (
            self._reference,
            self._reference + MILLI * moved,
            _wrench(force, moment, self._origin),
        )

    @staticmethod
    def _vector(value: Any) -> Array:
        known = value is not None and np.size(value) == 3
        return np.ravel(np.asarray(value, dtype=np.float64)) if known else np.full(3, np.nan)

    def _markers(self, frame: Mapping[str, Any], name: str) -> Array:
        values = np.asarray(frame.get(name, ()), dtype=np.float64)
        expected = (self._shape[0] * self._shape[1], 3)
        if values.shape != expected:
            msg = f"frame: {name}: found shape {values.shape}, expected {expected}"
            raise FrameSourceError(msg)
        return _turned(values, self._shape)


def _turned(values: Array, shape: tuple[int, int]) -> Array:
    """Values of markers (..., n, 3) on the grid (..., rows, cols, 3), y and x growing."""
    return np.asarray(values.reshape(*values.shape[:-2], *shape, 3)[..., ::-1, ::-1, :])


def _origin(rest: Array) -> Array:
    """The gel frame's origin, (3,) mm in the sensor's: amid the markers, at the apex."""
    i, j = rest.shape[0] // 2, rest.shape[1] // 2
    origin = np.nanmean(rest, axis=(0, 1))
    # The highest where none of the middle is known.
    middle = rest[i - 1 : i + 1, j - 1 : j + 1, 2]
    origin[2] = np.nanmean(middle) if np.isfinite(middle).any() else np.nanmax(rest[..., 2])
    return np.asarray(origin)


def _wrench(force: Array, moment: Array, origin: Array) -> Array:
    """Wrench (..., 6) N and N m about the gel frame's origin; moment: N mm about the sensor's."""
    return np.concatenate([force, MILLI * (moment - np.cross(origin, force))], axis=-1)


def _load(folder: Path, name: str) -> Array:
    """An array; NaN for one that need not be there and is not."""
    path = folder / f"{name}.npy"
    if not path.exists() and name not in REQUIRED:
        return np.full(0, np.nan)
    try:
        # What an array of objects holds would be run.
        return np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
    except FileNotFoundError:
        raise _error(folder, name, "no such file", "the file of a recording") from None
    except (OSError, ValueError, EOFError, TypeError) as error:
        raise _error(folder, name, f"a file without an array ({error})", "numbers") from None


def _checked_shapes(folder: Path, arrays: dict[str, Array]) -> tuple[int, int]:
    """Numbers of frames and markers; what is not there is filled with NaN."""
    shape = arrays[POSITIONS].shape
    if len(shape) != 3 or shape[2] != 3 or not shape[0]:
        raise _error(folder, POSITIONS, f"shape {shape}", "(frames, markers, 3)")
    frames, markers = shape[:2]
    sizes = {POSITIONS: 3 * markers, DISPLACEMENTS: 3 * markers, FORCES: 3 * markers}
    sizes |= {RESULTANT: 3, MOMENT: 3, STAMPS: 1, INDEX: 1}
    for name, values in arrays.items():
        size = frames * sizes[name]
        if not values.size:
            arrays[name] = np.full(size, np.nan)
        elif values.size != size or len(values) != frames:
            expected = f"{frames} frames of {sizes[name]} numbers, as in {POSITIONS}"
            raise _error(folder, name, f"shape {values.shape}", expected)
    if not np.isfinite(arrays[STAMPS]).all() or arrays[STAMPS].min() < 0:
        raise _error(
            folder, STAMPS, "times that are negative or not numbers", "times of at least 0 s"
        )
    return frames, markers


def _wrong_at_rest(rest: Array, least: float = LEAST_KNOWN) -> str:
    """What is wrong with markers (rows, cols, 3) mm at rest; empty where nothing is.

    least: share of them that must be known.
    """
    steps = rest[:, 1:, 0] - rest[:, :-1, 0], rest[1:, :, 1] - rest[:-1, :, 1]
    every = np.concatenate([step.ravel() for step in steps])
    known = every[np.isfinite(every)]
    if len(known) < least * len(every):
        return (
            f"found {np.isfinite(rest).all(axis=-1).sum()} of {rest[..., 0].size} markers with "
            f"numbers at rest, expected at least {least:.0%}"
        )
    low, high = PITCH_MM
    if not (known.min() >= low and known.max() <= high):
        return (
            f"found steps of {known.min():.4g} to {known.max():.4g} between neighbours along x "
            f"and y, expected {low:g} to {high:g} mm, with x and y falling from the first marker "
            "to the last"
        )
    return ""


def _wrong_motion(left: Array) -> str:
    """What is wrong where displacements leave so much (..., 3) mm of the motion; or empty."""
    most = float(np.nanquantile(np.abs(left), USUAL_SHARE))
    if most <= MOST_LEFT_MM:
        return ""
    return (
        f"found positions minus {DISPLACEMENTS} that change by {most:.2g} mm, expected the "
        f"markers at rest (to {MOST_LEFT_MM} mm): are both in mm?"
    )


def _lost(index: Array) -> int:
    """Frames that are missing between those of some numbers (n,), which may be NaN."""
    steps = np.diff(index)
    return int(np.sum(steps[steps > 1] - 1))


def _error(folder: Path, name: str, found: str, expected: str) -> FrameSourceError:
    return FrameSourceError(f"{folder / name}.npy: found {found}, expected {expected}")
